"""What secured agents of one simulated mission work out once for all of them.

Five agents hear the same bytes, and what they work out of them is a function of keys and bytes alone: the header, the
sender's keys, the plaintext, the signature. So it is remembered, for these very arguments: a receiver with another
secret, another public key or other bytes asks for something that nobody remembers, and gets what its own arguments
give. What depends on the receiver (what is fresh, which epoch it is, what it has asked, who is revoked) is in no
function here, and each works it out for itself.

A signature that was made here, with the private key whose public key it is verified with, over these very bytes, is
good: Ed25519 verifies whatever it signs. So it need not be verified, but one of `VERIFIED_EVERY` is, to find a library
that does not. Every other claim is verified. A memory that is full forgets, which costs time and nothing else.
"""

from functools import lru_cache
from itertools import count

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from ucp.secure.crypto_suite import SenderKeys, SignatureClaim, verify
from ucp.secure.envelope import read_clear_header
from ucp.secure.sealed_datagrams import CryptoFunctions, decrypt, parse_body

DATAGRAMS_REMEMBERED = 1024
SIGNATURES_REMEMBERED = 4096
SENDERS_REMEMBERED = 256
KEYSTREAMS_REMEMBERED = 64
"""Of each sender's."""
VERIFIED_EVERY = 128


def remembered() -> CryptoFunctions:
    """Return the cached cryptographic functions of all sessions of a mission."""
    signatures = Signatures()
    return CryptoFunctions(
        read=lru_cache(DATAGRAMS_REMEMBERED)(read_clear_header),
        sender_keys=lru_cache(SENDERS_REMEMBERED)(RememberingSenderKeys),
        decrypt=lru_cache(DATAGRAMS_REMEMBERED)(decrypt),
        parse_body=lru_cache(DATAGRAMS_REMEMBERED)(parse_body),
        signer=signatures.signer,
        verify=lru_cache(SIGNATURES_REMEMBERED)(signatures.verified),
    )


class RememberingSenderKeys(SenderKeys):
    """A sender masks with what all who hear it unmask with."""

    __slots__ = ("_keystreams",)

    def __init__(self, epoch_secret: bytes, mission: bytes, epoch: int, sender: int, boot: bytes) -> None:
        super().__init__(epoch_secret, mission, epoch, sender, boot)
        self._keystreams = lru_cache(KEYSTREAMS_REMEMBERED)(super().keystream)

    def keystream(self, sequence: int) -> int:
        return self._keystreams(sequence)


class Signatures:
    """Those that were made in this process, by whoever has a `signer` of them."""

    def __init__(self) -> None:
        self._made: dict[bytes, tuple[bytes, bytes]] = {}
        """Signature -> the public key that belongs to the private one, and what it is of."""
        self._number = count(1)

    def signer(self, private_key: bytes) -> "RememberingSigner":
        return RememberingSigner(private_key, self._made)

    def verified(self, claim: SignatureClaim) -> bool:
        """As `ucp.secure.crypto_suite.verify`."""
        made_here = self._made.get(claim.signature) == (claim.public_key, claim.signed)
        return (made_here and next(self._number) % VERIFIED_EVERY != 0) or verify(claim)


class RememberingSigner:
    """Signs, and takes down what it has signed."""

    def __init__(self, private_key: bytes, made: dict[bytes, tuple[bytes, bytes]]) -> None:
        self._private_key = Ed25519PrivateKey.from_private_bytes(private_key)
        self._public_key = self._private_key.public_key().public_bytes_raw()
        self._made = made

    def sign(self, data: bytes) -> bytes:
        signature = self._private_key.sign(data)
        if len(self._made) >= SIGNATURES_REMEMBERED:
            del self._made[next(iter(self._made))]
        self._made[signature] = self._public_key, data
        return signature
