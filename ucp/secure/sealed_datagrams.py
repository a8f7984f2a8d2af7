"""Functions that decrypt and parse a sealed datagram. Their results depend only on bytes and keys, not on a receiver.

A process that simulates many vehicles may therefore cache the results for all of them (`CryptoFunctions`). Each session
decides on its own whether a datagram is fresh, answers a request, and comes from a sender that is not revoked.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from ucp.messages import Datagram, MalformedDatagramError, decode_body
from ucp.secure.crypto_suite import SenderKeys, UnverifiedSignature, verify
from ucp.secure.envelope import (
    BOOT_BYTES,
    CLEAR,
    REQUEST,
    REQUEST_OF,
    SIGNATURE_BYTES,
    WITH_BLOCK,
    ClearHeader,
    read_clear_header,
)
from ucp.trace import RecordedBytes

_DATAGRAM = b"UCP datagram\0"


class AnsweredRequest(NamedTuple):
    """The request that a response answers. It is identified by its sender, the sender's start (`boot`), and its
    sequence number.
    """

    sender: int
    boot: bytes
    sequence: int


NO_REQUEST = AnsweredRequest(0, bytes(BOOT_BYTES), 0)
"""The value that a response contains if it answers no request. No real request has the sender 0."""


class OpenedDatagram(NamedTuple):
    """An authentic datagram after decryption."""

    clear: ClearHeader
    datagram: Datagram
    recorded: RecordedBytes
    """The plain datagram (version 1) with the same content. The trace records it."""
    request: AnsweredRequest | None
    """The request that this datagram answers. None if it is not a response."""
    block_signature: bytes


def signing_domain(mission: bytes) -> bytes:
    """Return the bytes that precede all signed datagrams of this mission: a tag, and the mission ID."""
    return _DATAGRAM + mission


def decrypt(
    keys: SenderKeys, datagram: bytes, clear: ClearHeader, domain: bytes, public_key: bytes
) -> tuple[bytes, UnverifiedSignature]:
    """Decrypt a datagram. Return its body and its signature, which the caller must still verify.

    Raises MalformedDatagramError if the keys do not decrypt the datagram.
    """
    plain, header = decrypted(keys, datagram, clear), datagram[: CLEAR.size]
    body, signature = plain[:-SIGNATURE_BYTES], plain[-SIGNATURE_BYTES:]
    return body, UnverifiedSignature(public_key, signature, domain + header + body)


def decrypted(keys: SenderKeys, datagram: bytes, clear: ClearHeader) -> bytes:
    """Return the plaintext of a datagram. Raises MalformedDatagramError."""
    plain = keys.decrypt(clear.position, datagram[CLEAR.size :], datagram[: CLEAR.size])
    if plain is None:
        raise MalformedDatagramError("not authentic")
    return plain


def parse_body(clear: ClearHeader, body: bytes) -> OpenedDatagram:
    """Parse a decrypted body. Raises MalformedDatagramError if it is not a valid body of its message type."""
    request, block_signature = None, b""
    if clear.type in REQUEST_OF:
        if len(body) < REQUEST.size:
            raise MalformedDatagramError("wrong length")
        request, body = AnsweredRequest(*REQUEST.unpack_from(body)), body[REQUEST.size :]
    if clear.type in WITH_BLOCK:
        if len(body) < SIGNATURE_BYTES:
            raise MalformedDatagramError("wrong length")
        body, block_signature = body[:-SIGNATURE_BYTES], body[-SIGNATURE_BYTES:]
    datagram = Datagram(clear.sender, clear.sequence, decode_body(clear.type, body))
    return OpenedDatagram(clear, datagram, RecordedBytes(None, datagram), request, block_signature)


class Signer(Protocol):
    """An object that signs with a private key."""

    def sign(self, data: bytes, /) -> bytes:
        """Return the signature of `data` (64 bytes)."""


@dataclass(frozen=True)
class CryptoFunctions:
    """The cryptographic functions that a session calls. Their results depend only on bytes and keys.

    The defaults compute each result. A simulation replaces them by functions that have the same arguments and cache the
    results.
    """

    read: Callable[[bytes], ClearHeader] = read_clear_header
    sender_keys: Callable[[bytes, bytes, int, int, bytes], SenderKeys] = SenderKeys
    decrypt: Callable[[SenderKeys, bytes, ClearHeader, bytes, bytes], tuple[bytes, UnverifiedSignature]] = decrypt
    parse_body: Callable[[ClearHeader, bytes], OpenedDatagram] = parse_body
    signer: Callable[[bytes], Signer] = Ed25519PrivateKey.from_private_bytes
    verify: Callable[[UnverifiedSignature], bool] = verify


CRYPTO_FUNCTIONS = CryptoFunctions()
