"""The cryptographic primitives of secure missions. The agent contract defines one suite, so agents negotiate nothing.

The suite is HKDF-Expand with SHA-256 (RFC 5869), ChaCha20-Poly1305 (RFC 8439) and Ed25519 (RFC 8032). The input of each
derivation and signature contains a tag for its purpose and the mission's ID. A key or signature is therefore valid only
for this purpose in this mission.
"""

import hmac
from functools import lru_cache
from typing import NamedTuple

from cryptography.exceptions import InvalidSignature, InvalidTag
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305

KEY_BYTES = 32
NONCE_BYTES = 12
MAX_CACHED_KEYS = 1024

_SENDER = b"UCP sender\0"
_EPOCH = b"UCP epoch\0"


def expand(key: bytes, info: bytes, length: int) -> bytes:
    """Return `length` bytes of HKDF-Expand (RFC 5869, Section 2.3)."""
    output = block = hmac.digest(key, info + b"\1", "sha256")
    counter = 1
    while len(output) < length:
        counter += 1
        block = hmac.digest(key, block + info + bytes((counter,)), "sha256")
        output += block
    return output[:length]


def next_epoch_secret(secret: bytes, mission: bytes) -> bytes:
    """Return the group secret of the next epoch. The function is one-way."""
    return expand(secret, _EPOCH + mission, KEY_BYTES)


class SenderKeys:
    """The keys that encrypt and authenticate the datagrams of one sender in one epoch and one incarnation. `repr` hides
    them.
    """

    __slots__ = ("_aead", "_iv")

    def __init__(self, epoch_secret: bytes, mission: bytes, epoch: int, sender: int, boot: bytes) -> None:
        info = _SENDER + mission + epoch.to_bytes(4, "big") + sender.to_bytes(4, "big") + boot
        derived = expand(epoch_secret, info, KEY_BYTES + NONCE_BYTES)
        self._aead = ChaCha20Poly1305(derived[:KEY_BYTES])
        self._iv = int.from_bytes(derived[KEY_BYTES:], "big")

    def encrypt(self, position: int, plain: bytes, clear: bytes) -> bytes:
        """Return the ciphertext and its tag. The caller must use each position (and thus each nonce) only once."""
        return self._aead.encrypt(self._nonce(position), plain, clear)

    def decrypt(self, position: int, ciphertext: bytes, clear: bytes) -> bytes | None:
        """Return the plaintext. Return None if the tag does not match the ciphertext and the clear header."""
        try:
            return self._aead.decrypt(self._nonce(position), ciphertext, clear)
        except InvalidTag:
            return None

    def _nonce(self, position: int) -> bytes:
        return (self._iv ^ position).to_bytes(NONCE_BYTES, "big")


class UnverifiedSignature(NamedTuple):
    """The claim, not yet verified, that the owner of a public key signed some bytes with this signature."""

    public_key: bytes
    signature: bytes
    signed: bytes


def verify(claim: UnverifiedSignature) -> bool:
    """Return whether the signature is valid. Return False for malformed keys and signatures."""
    try:
        _load_public_key(claim.public_key).verify(claim.signature, claim.signed)
    except (InvalidSignature, ValueError):
        return False
    return True


@lru_cache(MAX_CACHED_KEYS)
def _load_public_key(public_key: bytes) -> Ed25519PublicKey:
    return Ed25519PublicKey.from_public_bytes(public_key)
