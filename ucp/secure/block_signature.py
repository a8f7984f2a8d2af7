"""A block's signature by its maker: beside the block, not hashed into it, so that hashes and chains stay as they are.

Ed25519 (RFC 8032) over a domain tag, the mission's ID and BD (eq. 3.5): nothing that is signed for anything else, or in
another mission, passes for it.
"""

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from ucp.secure.suite import Signed, verify

_TAG = b"UCP block\0"


def sign_block(maker: Ed25519PrivateKey, mission: bytes, block_data: bytes) -> bytes:
    """The signature of the block with this BD, 64 bytes."""
    return maker.sign(_TAG + mission + block_data)


def claim_of_block(public_key: bytes, mission: bytes, block_data: bytes, signature: bytes) -> Signed:
    """That the maker with this public key signed the block with this BD in this mission."""
    return Signed(public_key, signature, _TAG + mission + block_data)


def is_signed(signature: bytes, public_key: bytes, mission: bytes, block_data: bytes) -> bool:
    """Whether the maker with this public key signed the block in this mission. Never raises, whatever the bytes are."""
    return verify(claim_of_block(public_key, mission, block_data, signature))
