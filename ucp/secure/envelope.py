"""The clear header of a secured datagram (version 3), and the checks that need no cryptography.

    "UC" | version u8 = 3 | type u8 | sender u32 | sequence u32 | length u16 | epoch u32 | boot | revocations u16

The ciphertext and its tag follow the header. The plaintext is the body, and then the sender's signature of header and
body. A revocation (type 10) has no signature of its sender, because its body has the signature of the authority.
CONTRACT.md specifies every byte.

The encryption covers the signature, so an attacker without the group secret cannot make a receiver verify one. The
receiver rejects its datagrams in a few microseconds.
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
from ucp.wire import FieldKind, struct_of

VERSION = 3
BOOT_BYTES = 16
TAG_BYTES = 16
SIGNATURE_BYTES = 64
CLEAR_FIELDS = {**HEADER_FIELDS, "epoch": FieldKind.U32, "boot": FieldKind.BOOT, "revocations": FieldKind.U16}
CLEAR = struct_of(CLEAR_FIELDS)
SEAL_BYTES = TAG_BYTES + SIGNATURE_BYTES
"""Number of bytes that the encryption adds to a body: the tag, and the signature of the sender."""
LAST_SEQUENCE = 2**32 - 1
REVOCATION = 10
"""Type of a revocation datagram. The authority signs its body."""
CHALLENGE, ECHO = 11, 12
"""Types of the datagrams with which a receiver finds out whether a sender is active now. `ucp.secure._challenges`
explains them.
"""
CONTROL_POSITION = 2**32
"""Smallest nonce position of a control datagram. Control datagrams have types from 10 on, and contain no message of the
protocol. Messages have smaller positions.
"""
TYPES = frozenset(range(1, ECHO + 1))

CONTROL_NAMES = {REVOCATION: "Revocation", CHALLENGE: "Challenge", ECHO: "Echo"}
"""Type of a control datagram -> its name. A control datagram contains no message of the protocol."""
NAMES = {code: message.NAME for message, code in TYPE_CODES.items()}
"""Type of a message -> its name."""

REQUEST_FIELDS = {"request_sender": FieldKind.U32, "request_boot": FieldKind.BOOT, "request_sequence": FieldKind.U32}
"""Fields that identify the request that a response answers. They come before the response's body, and are encrypted
with it.
"""
REQUEST = struct_of(REQUEST_FIELDS)
REQUEST_OF = {2: 1, 5: 4, 7: 6, 9: 8}
"""Type of a response -> type of the request that it answers."""
REQUESTS = frozenset(REQUEST_OF.values())
WITH_BLOCK = frozenset((3, 9))
"""Types of the messages that carry a block. The signature of the block follows the block, and is encrypted with it."""


class ClearHeader(NamedTuple):
    """The fields of the unencrypted header. They are not authentic until the datagram is decrypted."""

    type: int
    sender: int
    sequence: int
    epoch: int
    boot: bytes
    revocations: int

    @property
    def position(self) -> int:
        """The number from which the nonce of this datagram is computed. Messages and control datagrams have separate
        ranges of numbers.
        """
        return self.sequence if self.type < REVOCATION else CONTROL_POSITION + self.sequence

    def pack(self, length: int) -> bytes:
        """Return the header's bytes. `length` is the number of bytes after the header."""
        code, sender, sequence, *rest = self
        return CLEAR.pack(MAGIC, VERSION, code, sender, sequence, length, *rest)


def read_clear_header(datagram: bytes) -> ClearHeader:
    """Return the header of a secured datagram. Raises MalformedDatagramError if it is not a secured datagram."""
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
    if length < (TAG_BYTES if code == REVOCATION else SEAL_BYTES):
        raise MalformedDatagramError("wrong length")
    return ClearHeader(code, sender, sequence, *rest)


ADDED_BYTES: dict[str, int] = {
    message.NAME: CLEAR.size
    - HEADER.size
    + SEAL_BYTES
    + (REQUEST.size if code in REQUEST_OF else 0)
    + (SIGNATURE_BYTES if code in WITH_BLOCK else 0)
    for message, code in TYPE_CODES.items()
}
"""Name of a message -> number of bytes by which its secured datagram is longer than its plain datagram."""


def sealed_bytes(message: Message) -> int:
    """Return the length in bytes of the secured datagram that carries `message`."""
    return datagram_bytes(message) + ADDED_BYTES[message.NAME]
