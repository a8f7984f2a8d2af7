"""Cache cryptographic results for all agents of a simulated mission.

All agents receive the same bytes. The header, the sender's keys, the plaintext and the validity of the signature depend
only on the keys and on the bytes of the datagram. The cache therefore stores these results by keys and bytes. A
receiver with a different secret, public key or datagram never uses the cached result of another receiver. Checks that
depend on the receiver are not cached: freshness, the current epoch, its own queries, and revocations.

A signature is valid if it was made in this process over the same bytes with the private key of the same key pair. The
cache does not verify such a signature again. The exception is one of every `VERIFIED_EVERY` signatures, because this
check detects a library that cannot verify its own signatures. All other signatures are verified. A full cache drops its
oldest entries. The dropped results are then computed again.
"""

from functools import lru_cache
from itertools import count

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from ucp.secure.crypto_suite import SenderKeys, UnverifiedSignature, verify
from ucp.secure.envelope import read_clear_header
from ucp.secure.sealed_datagrams import CryptoFunctions, decrypt, parse_body

DATAGRAMS_CACHED = 1024
SIGNATURES_CACHED = 4096
SENDERS_CACHED = 256
VERIFIED_EVERY = 128


def cached_crypto() -> CryptoFunctions:
    """Return the cryptographic functions for all agents of a mission. The functions cache their results."""
    signatures = RecordedSignatures()
    return CryptoFunctions(
        read=lru_cache(DATAGRAMS_CACHED)(read_clear_header),
        sender_keys=lru_cache(SENDERS_CACHED)(SenderKeys),
        decrypt=lru_cache(DATAGRAMS_CACHED)(decrypt),
        parse_body=lru_cache(DATAGRAMS_CACHED)(parse_body),
        signer=signatures.signer,
        verify=lru_cache(SIGNATURES_CACHED)(signatures.verified),
    )


class RecordedSignatures:
    """A record of all signatures made in this process. To verify such a signature, the process usually only searches
    this record.
    """

    def __init__(self) -> None:
        self._made: dict[bytes, tuple[bytes, bytes]] = {}
        """Signature -> the signed bytes, and the public key of the key pair that signed them."""
        self._number = count(1)

    def signer(self, private_key: bytes) -> "RecordingSigner":
        return RecordingSigner(private_key, self._made)

    def verified(self, claim: UnverifiedSignature) -> bool:
        """Return true if the signature is valid, as `ucp.secure.crypto_suite.verify` does."""
        made_here = self._made.get(claim.signature) == (claim.public_key, claim.signed)
        return (made_here and next(self._number) % VERIFIED_EVERY != 0) or verify(claim)


class RecordingSigner:
    """A signing key that records its signatures."""

    def __init__(self, private_key: bytes, made: dict[bytes, tuple[bytes, bytes]]) -> None:
        self._private_key = Ed25519PrivateKey.from_private_bytes(private_key)
        self._public_key = self._private_key.public_key().public_bytes_raw()
        self._made = made

    def sign(self, data: bytes) -> bytes:
        signature = self._private_key.sign(data)
        if len(self._made) >= SIGNATURES_CACHED:
            del self._made[next(iter(self._made))]
        self._made[signature] = self._public_key, data
        return signature
