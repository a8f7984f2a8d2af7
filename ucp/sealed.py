"""Which missions seal event data: the depot's public key ends their inception block, where all agents have it.

Nothing here takes a key to anything; that does `ucp.secure.sealing`.
"""

DEPOT_TAG = b"UCP depot key"
DEPOT_KEY_BYTES = 32
SEAL_BYTES = 48
"""So much longer than events is what they are sealed to: an ephemeral public key before them, a tag behind."""


def sealed_to(initial_data: bytes) -> bytes | None:
    """The depot's public key (X25519) in an inception block's data; None where event data is not sealed."""
    key = initial_data[-DEPOT_KEY_BYTES:]
    return key if initial_data[:-DEPOT_KEY_BYTES].endswith(DEPOT_TAG) else None


def seal_to(initial_data: bytes, depot: bytes) -> bytes:
    """The inception block's data of a mission that seals event data to the depot with this public key."""
    return initial_data + DEPOT_TAG + depot
