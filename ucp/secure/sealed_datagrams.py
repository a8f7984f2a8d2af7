"""What a sealed datagram says, and whether its sender says it: functions of bytes alone, which know of no receiver.

Whoever plays many vehicles in one process may remember what these gave for the same bytes under the same keys
(`Arithmetic`). What is fresh, asked for, or of a sender that is not revoked each session decides for itself.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from ucp.messages import Datagram, MalformedDatagramError, decode_body
from ucp.secure.crypto_suite import SenderKeys, Signed, verify
from ucp.secure.envelope import (
    BOOT_BYTES,
    CLEAR,
    REQUEST,
    REQUEST_OF,
    SIGNATURE_BYTES,
    WITH_BLOCK,
    Clear,
    read_clear,
)
from ucp.trace import Recorded

_DATAGRAM = b"UCP datagram\0"


class Request(NamedTuple):
    """A datagram that asks something, as a response names it."""

    sender: int
    boot: bytes
    sequence: int


NOTHING_ASKED = Request(0, bytes(BOOT_BYTES), 0)
"""What a response names that answers nothing. No request is like that."""


class Opened(NamedTuple):
    """What a datagram said that proved authentic."""

    clear: Clear
    said: Datagram
    recorded: Recorded
    """The datagram of version 1 that says the same."""
    request: Request | None
    """What it answers; None if it is no response."""
    block_signature: bytes


def domain_of(mission: bytes) -> bytes:
    """What stands before all that is signed of a datagram of this mission."""
    return _DATAGRAM + mission


def decrypted(
    keys: SenderKeys, datagram: bytes, clear: Clear, domain: bytes, public_key: bytes
) -> tuple[bytes, Signed]:
    """What was sealed, and the signature that is still to be verified.

    Raises MalformedDatagramError if the keys do not open it.
    """
    signed, signature = datagram[:-SIGNATURE_BYTES], datagram[-SIGNATURE_BYTES:]
    body = keys.decrypt(clear.sequence, signed[CLEAR.size :], signed[: CLEAR.size])
    if body is None:
        raise MalformedDatagramError("not authentic")
    return body, Signed(public_key, keys.masked(clear.sequence, signature), domain + signed)


def understood(clear: Clear, body: bytes) -> Opened:
    """What a body says that was sealed. Raises MalformedDatagramError for one that no message has."""
    request, block_signature = None, b""
    if clear.type in REQUEST_OF:
        if len(body) < REQUEST.size:
            raise MalformedDatagramError("wrong length")
        request, body = Request(*REQUEST.unpack_from(body)), body[REQUEST.size :]
    if clear.type in WITH_BLOCK:
        if len(body) < SIGNATURE_BYTES:
            raise MalformedDatagramError("wrong length")
        body, block_signature = body[:-SIGNATURE_BYTES], body[-SIGNATURE_BYTES:]
    said = Datagram(clear.sender, clear.sequence, decode_body(clear.type, body))
    return Opened(clear, said, Recorded(None, said), request, block_signature)


class Signer(Protocol):
    """Who has a private key."""

    def sign(self, data: bytes, /) -> bytes:
        """The signature of these bytes, 64 bytes."""


@dataclass(frozen=True)
class Arithmetic:
    """What a session works out of bytes alone; each has the arguments of the function that stands here."""

    read: Callable[[bytes], Clear] = read_clear
    sender_keys: Callable[[bytes, bytes, int, int, bytes], SenderKeys] = SenderKeys
    decrypted: Callable[[SenderKeys, bytes, Clear, bytes, bytes], tuple[bytes, Signed]] = decrypted
    understood: Callable[[Clear, bytes], Opened] = understood
    signer: Callable[[bytes], Signer] = Ed25519PrivateKey.from_private_bytes
    verified: Callable[[Signed], bool] = verify


ARITHMETIC = Arithmetic()
