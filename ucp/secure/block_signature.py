"""A block's signature by its maker: beside the block, not hashed into it, so that hashes and chains stay as they are.

Ed25519 (RFC 8032) over a domain tag, the mission's ID and BD (eq. 3.5): nothing that is signed for anything else, or in
another mission, passes for it.
"""

from ucp.secure.crypto_suite import Signed
from ucp.secure.sealed_datagrams import Signer

_TAG = b"UCP block\0"


def sign_block(maker: Signer, mission: bytes, block_data: bytes) -> bytes:
    """The signature of the block with this BD, 64 bytes."""
    return maker.sign(_TAG + mission + block_data)


def claim_of_block(public_key: bytes, mission: bytes, block_data: bytes, signature: bytes) -> Signed:
    """That the maker with this public key signed the block with this BD in this mission."""
    return Signed(public_key, signature, _TAG + mission + block_data)
