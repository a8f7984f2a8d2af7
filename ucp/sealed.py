"""Find out whether a mission encrypts its event data. If so, the inception block ends with the public key of the depot.
This module only reads and writes this key. The module `ucp.secure.sealing` encrypts the event data.
"""

DEPOT_TAG = b"UCP depot key"
DEPOT_KEY_BYTES = 32
SEAL_BYTES = 48
"""Number of bytes that encryption adds to event data: an ephemeral public key before the data, and a tag after it."""


def sealed_to(initial_data: bytes) -> bytes | None:
    """Return the depot's public key (X25519) in the data of an inception block. Return None if event data are not
    encrypted.
    """
    key = initial_data[-DEPOT_KEY_BYTES:]
    return key if initial_data[:-DEPOT_KEY_BYTES].endswith(DEPOT_TAG) else None


def seal_to(initial_data: bytes, depot: bytes) -> bytes:
    """Return the data of an inception block with this public key added. A mission with this data encrypts its event
    data.
    """
    return initial_data + DEPOT_TAG + depot
