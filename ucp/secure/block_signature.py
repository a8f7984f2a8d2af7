"""Sign a block with the key of the agent that completed it.

The signature accompanies the block and is not part of its hash, so hashes and chains stay the same. It is an Ed25519
signature (RFC 8032) over a domain tag, the mission's ID and BD (eq. 3.5). Because of the tag and the ID, a signature of
other data or of another mission is not valid for a block.
"""

from ucp.secure.crypto_suite import UnverifiedSignature
from ucp.secure.sealed_datagrams import Signer

_TAG = b"UCP block\0"


def sign_block(maker: Signer, mission: bytes, block_data: bytes) -> bytes:
    """Return the signature of a block with this block data, 64 bytes."""
    return maker.sign(_TAG + mission + block_data)


def block_claim(public_key: bytes, mission: bytes, block_data: bytes, signature: bytes) -> UnverifiedSignature:
    """Return the unverified claim that the owner of this public key signed this block data in this mission."""
    return UnverifiedSignature(public_key, signature, _TAG + mission + block_data)
