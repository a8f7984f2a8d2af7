"""Decode the recorded inputs of an agent: datagrams, events, encrypted event data, and the states that the agent stored
on disk.

The module also computes the mission second at which an agent sent a message. The trace of the agent contains only the
time of the handler run that produced the message. With the setting `answer_spread_s`, the agent sends an answer later,
after a wait that CONTRACT.md defines. This module computes the wait independently, because an error of the agent under
test must not affect the check.
"""

import base64
from base64 import b64decode
from binascii import Error
from collections.abc import Iterable, Iterator
from functools import lru_cache
from hashlib import sha256

from harness.archive.exports import ExportedBlock
from harness.archive.traces import Trace
from ucp.block import BLOCK_HEADER, Block
from ucp.events import LoggableEvent, MalformedEventsError, decode_event
from ucp.messages import BlockResponse, CommitBlock, Datagram, MalformedDatagramError, Message, decode
from ucp.trace import HandlerRun, RecordedBytes, SentMessage

KEPT = 4096
"""Maximum number of decoded datagrams in the cache. The cache saves time, because many agents receive the same
datagram.
"""

LENGTH_BYTES = 2


class NotOnRecordError(Exception):
    """An error: the records do not contain a required value. The message is one sentence."""


def decoded(record: RecordedBytes | None) -> Datagram:
    """Decode a recorded datagram. Raises MalformedDatagramError if it is not a valid message."""
    if record is None:
        return _decoded("")
    content = record.content
    return content if isinstance(content, Datagram) else _decoded(record.text)


@lru_cache(KEPT)
def _decoded(text: str) -> Datagram:
    try:
        data = base64.b64decode(text, validate=True)
    except ValueError:
        raise MalformedDatagramError("not base64") from None
    return decode(data)


def event_of(record: RecordedBytes | None) -> LoggableEvent:
    """Decode a recorded event. Raises MalformedEventsError if the bytes are invalid."""
    if record is not None and isinstance(record.content, LoggableEvent):
        return record.content
    try:
        data = base64.b64decode(record.text if record else "", validate=True)
    except ValueError:
        raise MalformedEventsError("the event is not base64") from None
    event, end = decode_event(data, 0)
    if end != len(data):
        raise MalformedEventsError("the event is followed by other data")
    return event


def sealed_of(record: RecordedBytes | None) -> bytes | None:
    """Return the encrypted event data that an agent recorded for a block. Return None if the record contains none, or
    no valid base64.
    """
    try:
        return None if record is None else base64.b64decode(record.text, validate=True)
    except ValueError:
        return None


def stored_blocks(record: RecordedBytes | None) -> Iterator[Block]:
    """Yield the blocks in the stored state of an agent. Raises ValueError if the bytes are invalid."""
    data = base64.b64decode(record.text if record else "", validate=True)
    offset = 0
    while offset < len(data):
        end = offset + LENGTH_BYTES + int.from_bytes(data[offset : offset + LENGTH_BYTES], "big")
        block = data[offset + LENGTH_BYTES : end]
        if len(block) <= BLOCK_HEADER.size or end > len(data):
            raise ValueError("the store is cut off")
        agent_id, timestamp_us = BLOCK_HEADER.unpack_from(block)
        yield Block(agent_id, timestamp_us, block[BLOCK_HEADER.size :])
        offset = end


class BlockIndex:
    """An index of all recorded blocks by their hash. The blocks come from exports and from messages."""

    def __init__(self, exported: Iterable[ExportedBlock]) -> None:
        self._exported = {block.block_hash: block for block in exported}
        self._blocks: dict[str, Block] = {}

    def add(self, block: Block) -> None:
        """Add a block with its content to the index."""
        self._blocks[block.block_hash.hex()] = block

    def add_from(self, message: Message) -> None:
        """Add the block that the message carries, if the message carries a block."""
        if isinstance(message, CommitBlock | BlockResponse):
            self.add(message.block)

    def get(self, block_hash: str) -> Block:
        """Return the block with this hash. Raises NotOnRecordError if no record contains it."""
        block = self._blocks.get(block_hash)
        if block is None and (exported := self._exported.get(block_hash)) is not None:
            block = Block(exported.agent_id, exported.timestamp_us, exported.event_bytes)
        if block is None or block.block_hash.hex() != block_hash:
            raise NotOnRecordError(f"the data of block {block_hash[:12]} is not recorded")
        self._blocks[block_hash] = block
        return block


ANSWERS = frozenset(
    ("Block Add Response", "Chain Contain Response", "Next in Sequence Response", "Block Response"),
)


def spread_of(trace: Trace) -> float:
    """Return the maximum delay of the agent's answers (setting `answer_spread_s`) in mission seconds. Return 0 if the
    trace header has no valid value.
    """
    spread_s = trace.header.settings.get("answer_spread_s", 0.0)
    return float(spread_s) if isinstance(spread_s, int | float) and spread_s > 0 else 0.0


def sent_at(run: HandlerRun, message: SentMessage, spread_s: float) -> float:
    """Return the mission second at which the agent sent a message. `run` is the handler run that produced the
    message.
    """
    if not spread_s or message.message not in ANSWERS or message.datagram is None:
        return run.t
    try:
        datagram = b64decode(message.datagram.text, validate=True)
    except (Error, ValueError):
        return run.t
    return run.t + spread_s * (int.from_bytes(sha256(datagram).digest()[:8], "big") / 2**64)
