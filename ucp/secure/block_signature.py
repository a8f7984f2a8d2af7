"""A block's signature by its maker: beside the block, not hashed into it, so that hashes and chains stay as they are.

Ed25519 (RFC 8032) over a domain tag, the mission's ID and BD (eq. 3.5): nothing that is signed for anything else, or in
another mission, passes for it.
"""

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

SIGNATURE_BYTES = 64
_TAG = b"UCP block\0"


def sign_block(maker: Ed25519PrivateKey, mission: bytes, block_data: bytes) -> bytes:
    """The signature of the block with this BD, 64 bytes."""
    return maker.sign(_TAG + mission + block_data)


def is_signed(signature: bytes, public_key: bytes, mission: bytes, block_data: bytes) -> bool:
    """Whether the maker with this public key signed the block in this mission. Never raises, whatever the bytes are."""
    try:
        Ed25519PublicKey.from_public_bytes(public_key).verify(signature, _TAG + mission + block_data)
    except (InvalidSignature, ValueError):
        return False
    return True
