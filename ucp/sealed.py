"""Find out whether a mission encrypts its event data. If so, the inception block ends with the public key of the depot.

This module only reads and writes this key. The module `ucp.secure.sealing` encrypts.
"""

DEPOT_TAG = b"UCP depot key"
DEPOT_KEY_BYTES = 32
SEAL_BYTES = 48
"""Number of bytes by which sealed event data is longer: an ephemeral public key in front, and a tag at the end."""


def sealed_to(initial_data: bytes) -> bytes | None:
    """Return the depot's public key (X25519) in the data of an inception block. Return None if event data are not
    encrypted.
    """
    key = initial_data[-DEPOT_KEY_BYTES:]
    return key if initial_data[:-DEPOT_KEY_BYTES].endswith(DEPOT_TAG) else None


def seal_to(initial_data: bytes, depot: bytes) -> bytes:
    """Return inception block data with this public key, so that the mission encrypts its event data."""
    return initial_data + DEPOT_TAG + depot
