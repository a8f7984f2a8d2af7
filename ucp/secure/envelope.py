"""The clear header of a secured datagram, version 2, and what a receiver can tell from it before it computes anything.

    "UC" | version u8 = 2 | type u8 | sender u32 | sequence u32 | length u16 | epoch u32 | boot | revocations u16

Then come the ciphertext with its tag and the sender's masked signature; of type 10, a revocation, its body. All of the
header is authenticated with what follows it. CONTRACT.md has every byte.
"""

from typing import NamedTuple

from ucp.block import MAX_AGENT_ID
from ucp.messages import (
    HEADER,
    HEADER_FIELDS,
    MAGIC,
    MAX_DATAGRAM_BYTES,
    TYPE_CODES,
    MalformedDatagramError,
    Message,
    datagram_bytes,
)
from ucp.messages import VERSION as PLAIN_VERSION
from ucp.wire import Kind, struct_of

VERSION = 2
BOOT_BYTES = 16
TAG_BYTES = 16
SIGNATURE_BYTES = 64
CLEAR_FIELDS = {**HEADER_FIELDS, "epoch": Kind.U32, "boot": Kind.BOOT, "revocations": Kind.U16}
CLEAR = struct_of(CLEAR_FIELDS)
SEAL_BYTES = TAG_BYTES + SIGNATURE_BYTES
"""What sealing adds behind the header, whatever is sealed."""
LAST_SEQUENCE = 2**32 - 1
REVOCATION = 10
"""The type that says which keys are revoked; it is signed by the authority and not encrypted."""
TYPES = frozenset(range(1, REVOCATION + 1))

NAMES = {code: message.NAME for message, code in TYPE_CODES.items()}
"""Type of a message -> its name, in clear as its type is."""

REQUEST_FIELDS = {"request_sender": Kind.U32, "request_boot": Kind.BOOT, "request_sequence": Kind.U32}
"""Sealed before the body of a response: the request that it answers."""
REQUEST = struct_of(REQUEST_FIELDS)
REQUEST_OF = {2: 1, 5: 4, 7: 6, 9: 8}
"""Type of a response -> type of the request that it answers."""
REQUESTS = frozenset(REQUEST_OF.values())
WITH_BLOCK = frozenset((3, 9))
"""Types of the messages that carry a block, and behind it, sealed too, its maker's signature."""


class Clear(NamedTuple):
    """What the header says, which nobody vouches for by itself."""

    type: int
    sender: int
    sequence: int
    epoch: int
    boot: bytes
    revocations: int

    def pack(self, length: int) -> bytes:
        """The header of a datagram with so many bytes behind it."""
        code, sender, sequence, *rest = self
        return CLEAR.pack(MAGIC, VERSION, code, sender, sequence, length, *rest)


def read_clear(datagram: bytes) -> Clear:
    """The header of a secured datagram. Raises MalformedDatagramError for anything else."""
    if len(datagram) < 4:
        raise MalformedDatagramError("truncated")
    if len(datagram) > MAX_DATAGRAM_BYTES:
        raise MalformedDatagramError("oversized")
    if datagram[:2] != MAGIC:
        raise MalformedDatagramError("wrong magic")
    if datagram[2] != VERSION:
        raise MalformedDatagramError("not secured" if datagram[2] == PLAIN_VERSION else "wrong version")
    if len(datagram) < CLEAR.size:
        raise MalformedDatagramError("truncated")
    _, _, code, sender, sequence, length, *rest = CLEAR.unpack_from(datagram)
    if not 1 <= sender <= MAX_AGENT_ID:
        raise MalformedDatagramError("impossible sender")
    if length != len(datagram) - CLEAR.size:
        raise MalformedDatagramError("wrong length")
    if code not in TYPES:
        raise MalformedDatagramError("unknown type")
    if code != REVOCATION and length < SEAL_BYTES:
        raise MalformedDatagramError("wrong length")
    return Clear(code, sender, sequence, *rest)


ADDED_BYTES: dict[str, int] = {
    message.NAME: CLEAR.size
    - HEADER.size
    + SEAL_BYTES
    + (REQUEST.size if code in REQUEST_OF else 0)
    + (SIGNATURE_BYTES if code in WITH_BLOCK else 0)
    for message, code in TYPE_CODES.items()
}
"""By how much a message's secured datagram is longer than its plain one, by the message's name."""


def sealed_bytes(message: Message) -> int:
    """Length of the secured datagram of `message`."""
    return datagram_bytes(message) + ADDED_BYTES[message.NAME]
