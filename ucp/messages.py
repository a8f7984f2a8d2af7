"""Define the nine network messages of the protocol and their encoding.

Every datagram is broadcast and begins with one header, big-endian:

    magic "UC" | version u8 | type u8 | sender u32 | sequence u32 | body length u16

The sender's sequence number identifies a datagram in traces and captures. The protocol does not use it. A datagram that
is not exactly one well-formed message raises MalformedDatagramError.

The attribute WIRE of a message class declares the fields of the message in their order. `ucp.scapy` makes its layers
from these declarations. `body` and `from_body` are written by hand for speed, and tests compare them with WIRE.

Treat messages as immutable. They are not frozen, because creating a frozen object takes three times as long.
"""

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

from ucp._dataclass import dataclass
from ucp.block import BLOCK_HEADER, HASH_BYTES, MAX_AGENT_ID, MAX_EVENT_DATA_BYTES, Block
from ucp.wire import VARIABLE, FieldKind, Fields, struct_of

PORT = 14600
"""Default UDP port. The mission file of an agent can name a different port."""
MAGIC = b"UC"
VERSION = 1
HEADER_FIELDS = {
    "magic": FieldKind.MAGIC,
    "version": FieldKind.U8,
    "type": FieldKind.U8,
    "sender": FieldKind.U32,
    "sequence": FieldKind.U32,
    "length": FieldKind.U16,
}
HEADER = struct_of(HEADER_FIELDS)
MAX_DATAGRAM_BYTES = 1472
"""Maximum size of a datagram: one UDP datagram without IP fragmentation at an MTU of 1500 bytes."""


class MalformedDatagramError(ValueError):
    """An error: a datagram does not contain exactly one valid message. `reason` is one of a few fixed texts."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


@dataclass(unsafe_hash=True, slots=True)
class BlockAddRequest:
    """A request for votes: should this block follow the block with this chain hash? (Algorithms 2 and 3)"""

    NAME: ClassVar[str] = "Block Add Request"
    WIRE: ClassVar[Fields] = {"block_hash": FieldKind.HASH, "chain_hash": FieldKind.HASH}
    block_hash: bytes
    chain_hash: bytes

    def body(self) -> bytes:
        return self.block_hash + self.chain_hash

    @classmethod
    def from_body(cls, body: bytes) -> "BlockAddRequest":
        return cls(*_hashes(body, 2))


@dataclass(unsafe_hash=True, slots=True)
class BlockAddResponse:
    """A vote on a proposed block (Algorithms 3 and 4).

    With the setting `vote_names_chain`, `chain_hash` repeats the chain hash of the proposal.
    """

    NAME: ClassVar[str] = "Block Add Response"
    WIRE: ClassVar[Fields] = {
        "approve": FieldKind.FLAG,
        "block_hash": FieldKind.HASH,
        "chain_hash": FieldKind.OPTIONAL_HASH,
    }
    block_hash: bytes
    approve: bool
    chain_hash: bytes | None = None

    def body(self) -> bytes:
        return bytes([self.approve]) + self.block_hash + (self.chain_hash or b"")

    @classmethod
    def from_body(cls, body: bytes) -> "BlockAddResponse":
        approve = _flag(body)
        if len(body) == 1 + HASH_BYTES:
            return cls(body[1:], approve)
        block_hash, chain_hash = _hashes(body[1:], 2)
        return cls(block_hash, approve, chain_hash)


@dataclass(unsafe_hash=True, slots=True)
class CommitBlock:
    """The announcement that the sender has committed a block (Algorithms 5, 6 and 20). `chain_hash` is the chain hash
    of this block in the sender's chain.
    """

    NAME: ClassVar[str] = "Commit Block"
    WIRE: ClassVar[Fields] = {"chain_hash": FieldKind.HASH, "block": FieldKind.BLOCK}
    block: Block
    chain_hash: bytes

    def body(self) -> bytes:
        return self.chain_hash + self.block.block_data()

    @classmethod
    def from_body(cls, body: bytes) -> "CommitBlock":
        (chain_hash,) = _hashes(body[:HASH_BYTES], 1)
        return cls(decode_block(body[HASH_BYTES:]), chain_hash)


@dataclass(unsafe_hash=True, slots=True)
class ChainContainQuery:
    """A query: does the receiver's chain contain this chain hash? (Algorithms 8 and 9)"""

    NAME: ClassVar[str] = "Chain Contain Query"
    WIRE: ClassVar[Fields] = {"chain_hash": FieldKind.HASH}
    chain_hash: bytes

    def body(self) -> bytes:
        return self.chain_hash

    @classmethod
    def from_body(cls, body: bytes) -> "ChainContainQuery":
        return cls(*_hashes(body, 1))


@dataclass(unsafe_hash=True, slots=True)
class ChainContainResponse:
    """The answer yes or no to a Chain Contain Query (Algorithms 9 and 10)."""

    NAME: ClassVar[str] = "Chain Contain Response"
    WIRE: ClassVar[Fields] = {"contained": FieldKind.FLAG, "chain_hash": FieldKind.HASH}
    chain_hash: bytes
    contained: bool

    def body(self) -> bytes:
        return bytes([self.contained]) + self.chain_hash

    @classmethod
    def from_body(cls, body: bytes) -> "ChainContainResponse":
        contained = _flag(body)
        (chain_hash,) = _hashes(body[1:], 1)
        return cls(chain_hash, contained)


@dataclass(unsafe_hash=True, slots=True)
class ChainHashSuccessorQuery:
    """A query: which block follows this chain hash in the receiver's chain? (Algorithms 12 and 13)"""

    NAME: ClassVar[str] = "Chain Hash Successor Query"
    WIRE: ClassVar[Fields] = {"chain_hash": FieldKind.HASH}
    chain_hash: bytes

    def body(self) -> bytes:
        return self.chain_hash

    @classmethod
    def from_body(cls, body: bytes) -> "ChainHashSuccessorQuery":
        return cls(*_hashes(body, 1))


@dataclass(unsafe_hash=True, slots=True)
class NextInSequenceResponse:
    """The block hash and the timestamp of the successor, in answer to a Chain Hash Successor Query (Algorithms 13 and
    14).

    A `block_hash` of None stands for the reserved answer "Is Top Of Chain". The timestamp is then that of the
    responder's top block.
    """

    NAME: ClassVar[str] = "Next in Sequence Response"
    WIRE: ClassVar[Fields] = {
        "timestamp_us": FieldKind.U64,
        "chain_hash": FieldKind.HASH,
        "block_hash": FieldKind.OPTIONAL_HASH,
    }
    chain_hash: bytes
    block_hash: bytes | None
    timestamp_us: int

    def body(self) -> bytes:
        return self.timestamp_us.to_bytes(8, "big") + self.chain_hash + (self.block_hash or b"")

    @classmethod
    def from_body(cls, body: bytes) -> "NextInSequenceResponse":
        timestamp_us = int.from_bytes(body[:8], "big")
        if len(body) == 8 + HASH_BYTES:
            return cls(body[8:], None, timestamp_us)
        chain_hash, block_hash = _hashes(body[8:], 2)
        return cls(chain_hash, block_hash, timestamp_us)


@dataclass(unsafe_hash=True, slots=True)
class RequestForBlock:
    """A request for the block with this hash (Algorithms 16 and 17)."""

    NAME: ClassVar[str] = "Request for Block"
    WIRE: ClassVar[Fields] = {"block_hash": FieldKind.HASH}
    block_hash: bytes

    def body(self) -> bytes:
        return self.block_hash

    @classmethod
    def from_body(cls, body: bytes) -> "RequestForBlock":
        return cls(*_hashes(body, 1))


@dataclass(unsafe_hash=True, slots=True)
class BlockResponse:
    """The requested block (Algorithms 17 and 18)."""

    NAME: ClassVar[str] = "Block Response"
    WIRE: ClassVar[Fields] = {"block": FieldKind.BLOCK}
    block: Block

    def body(self) -> bytes:
        return self.block.block_data()

    @classmethod
    def from_body(cls, body: bytes) -> "BlockResponse":
        return cls(decode_block(body))


Message = (
    BlockAddRequest
    | BlockAddResponse
    | CommitBlock
    | ChainContainQuery
    | ChainContainResponse
    | ChainHashSuccessorQuery
    | NextInSequenceResponse
    | RequestForBlock
    | BlockResponse
)

TYPE_CODES: dict[type[Message], int] = {
    BlockAddRequest: 1,
    BlockAddResponse: 2,
    CommitBlock: 3,
    ChainContainQuery: 4,
    ChainContainResponse: 5,
    ChainHashSuccessorQuery: 6,
    NextInSequenceResponse: 7,
    RequestForBlock: 8,
    BlockResponse: 9,
}
_FROM_BODY: dict[int, Callable[[bytes], Message]] = {code: message.from_body for message, code in TYPE_CODES.items()}


CARRY_A_BLOCK = frozenset((CommitBlock, BlockResponse))


def block_named(message: Message) -> bytes | None:
    """Return the hash of the block that a message concerns. Return None if it concerns no block."""
    if type(message) in CARRY_A_BLOCK:
        return message.block.block_hash  # type: ignore[union-attr]
    return getattr(message, "block_hash", None)


_FIXED_BYTES: dict[type[Message], int] = {
    message: HEADER.size + struct_of({name: kind for name, kind in message.WIRE.items() if kind not in VARIABLE}).size
    for message in TYPE_CODES
}
"""Type of a message -> length in bytes of its datagram, without the part of variable length."""
_MORE_BYTES: dict[type[Message], Callable[[Any], int]] = {
    BlockAddResponse: lambda message: HASH_BYTES if message.chain_hash else 0,
    CommitBlock: lambda message: BLOCK_HEADER.size + len(message.block.event_data),
    NextInSequenceResponse: lambda message: HASH_BYTES if message.block_hash else 0,
    BlockResponse: lambda message: BLOCK_HEADER.size + len(message.block.event_data),
}
"""Type of a message -> function that returns the length in bytes of the part of variable length."""


def datagram_bytes(message: Message) -> int:
    """Return the length in bytes of the encoded message."""
    kind = type(message)
    more = _MORE_BYTES.get(kind)
    return _FIXED_BYTES[kind] if more is None else _FIXED_BYTES[kind] + more(message)


class Datagram(NamedTuple):
    """A decoded datagram: the sender's agent ID, its sequence number, and the message."""

    sender: int
    sequence: int
    message: Message

    def encode(self) -> bytes:
        return encode(*self)


def encode(sender: int, sequence: int, message: Message) -> bytes:
    """Return a message as a datagram of at most MAX_DATAGRAM_BYTES bytes.

    `sender` is an agent ID. `sequence` counts the sender's datagrams and wraps at 2**32.
    """
    body = message.body()
    code = TYPE_CODES[type(message)]
    return HEADER.pack(MAGIC, VERSION, code, sender, sequence & 0xFFFFFFFF, len(body)) + body


def decode(datagram: bytes) -> Datagram:
    """Return the content of a datagram. Raises MalformedDatagramError if the datagram does not contain exactly one
    valid message.
    """
    if len(datagram) < HEADER.size:
        raise MalformedDatagramError("truncated")
    if len(datagram) > MAX_DATAGRAM_BYTES:
        raise MalformedDatagramError("oversized")
    magic, version, code, sender, sequence, length = HEADER.unpack_from(datagram)
    if magic != MAGIC:
        raise MalformedDatagramError("wrong magic")
    if version != VERSION:
        raise MalformedDatagramError("wrong version")
    if not 1 <= sender <= MAX_AGENT_ID:
        raise MalformedDatagramError("impossible sender")
    if length != len(datagram) - HEADER.size:
        raise MalformedDatagramError("wrong length")
    return Datagram(sender, sequence, decode_body(code, datagram[HEADER.size :]))


def decode_body(code: int, body: bytes) -> Message:
    """Parse the body of a message of type `code`. Raises MalformedDatagramError."""
    from_body = _FROM_BODY.get(code)
    if from_body is None:
        raise MalformedDatagramError("unknown type")
    return from_body(body)


def _hashes(body: bytes, count: int) -> list[bytes]:
    if len(body) != count * HASH_BYTES:
        raise MalformedDatagramError("wrong length")
    return [body[start : start + HASH_BYTES] for start in range(0, len(body), HASH_BYTES)]


def _flag(body: bytes) -> bool:
    if body[:1] not in (b"\0", b"\1"):
        raise MalformedDatagramError("bad vote")
    return body[0] == 1


def decode_block(body: bytes) -> Block:
    """Parse an encoded block. Raises MalformedDatagramError if the bytes are not a valid block."""
    if not BLOCK_HEADER.size < len(body) <= BLOCK_HEADER.size + MAX_EVENT_DATA_BYTES:
        raise MalformedDatagramError("wrong length")
    agent_id, timestamp_us = BLOCK_HEADER.unpack_from(body)
    if not 1 <= agent_id <= MAX_AGENT_ID:
        raise MalformedDatagramError("impossible agent")
    return Block(agent_id, timestamp_us, body[BLOCK_HEADER.size :])
