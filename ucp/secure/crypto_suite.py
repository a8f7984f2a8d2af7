"""The primitives of secure missions: one suite, named by the contract, and nothing to negotiate.

HKDF-Expand with SHA-256 (RFC 5869), ChaCha20-Poly1305 (RFC 8439) and Ed25519 (RFC 8032). Everything that is derived or
signed begins with a tag of its own and the mission's ID, so that no key or signature means anything elsewhere.
"""

import hmac
from functools import lru_cache
from typing import NamedTuple

from cryptography.exceptions import InvalidSignature, InvalidTag
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305

from ucp.secure.envelope import SIGNATURE_BYTES

KEY_BYTES = 32
NONCE_BYTES = 12
PUBLIC_KEYS_KEPT = 1024

_SENDER = b"UCP sender\0"
_MASK = b"UCP signature mask\0"
_EPOCH = b"UCP epoch\0"


def expand(key: bytes, info: bytes, length: int) -> bytes:
    """HKDF-Expand (RFC 5869, Section 2.3)."""
    output = block = hmac.digest(key, info + b"\1", "sha256")
    counter = 1
    while len(output) < length:
        counter += 1
        block = hmac.digest(key, block + info + bytes((counter,)), "sha256")
        output += block
    return output[:length]


def next_epoch_secret(secret: bytes, mission: bytes) -> bytes:
    """The group secret of the next epoch; there is no way back."""
    return expand(secret, _EPOCH + mission, KEY_BYTES)


class SenderKeys:
    """What one sender's datagrams of one epoch and one life are sealed with; its secrets are never shown."""

    __slots__ = ("_aead", "_iv", "_mask")

    def __init__(self, epoch_secret: bytes, mission: bytes, epoch: int, sender: int, boot: bytes) -> None:
        info = _SENDER + mission + epoch.to_bytes(4, "big") + sender.to_bytes(4, "big") + boot
        derived = expand(epoch_secret, info, 2 * KEY_BYTES + NONCE_BYTES)
        self._aead = ChaCha20Poly1305(derived[:KEY_BYTES])
        self._iv = int.from_bytes(derived[KEY_BYTES : KEY_BYTES + NONCE_BYTES], "big")
        self._mask = derived[KEY_BYTES + NONCE_BYTES :]

    def encrypt(self, sequence: int, body: bytes, clear: bytes) -> bytes:
        """Ciphertext and tag. Whoever calls it uses each sequence once."""
        return self._aead.encrypt(self._nonce(sequence), body, clear)

    def decrypt(self, sequence: int, ciphertext: bytes, clear: bytes) -> bytes | None:
        """The body; None if ciphertext, tag and clear header do not belong together."""
        try:
            return self._aead.decrypt(self._nonce(sequence), ciphertext, clear)
        except InvalidTag:
            return None

    def masked(self, sequence: int, signature: bytes) -> bytes:
        """A signature as it is on the air, or one from the air as it was made."""
        return (int.from_bytes(signature, "big") ^ self.keystream(sequence)).to_bytes(SIGNATURE_BYTES, "big")

    def keystream(self, sequence: int) -> int:
        """What masks the signature of the datagram with this sequence."""
        return int.from_bytes(expand(self._mask, _MASK + sequence.to_bytes(4, "big"), SIGNATURE_BYTES), "big")

    def _nonce(self, sequence: int) -> bytes:
        return (self._iv ^ sequence).to_bytes(NONCE_BYTES, "big")


class Signed(NamedTuple):
    """A signature with what it is of, and whose."""

    public_key: bytes
    signature: bytes
    signed: bytes


def verify(claim: Signed) -> bool:
    """Whether the owner of the public key signed it. Never raises, whatever the bytes are."""
    try:
        _loaded(claim.public_key).verify(claim.signature, claim.signed)
    except (InvalidSignature, ValueError):
        return False
    return True


@lru_cache(PUBLIC_KEYS_KEPT)
def _loaded(public_key: bytes) -> Ed25519PublicKey:
    return Ed25519PublicKey.from_public_bytes(public_key)
