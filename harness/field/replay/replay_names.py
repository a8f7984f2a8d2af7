"""Name the blocks in a replay, and find blocks by hash in any record of the flight."""

import re
from collections.abc import Iterator
from functools import cached_property

from harness.archive.exports import name_blocks
from harness.archive.traces import Trace
from harness.checker.recorded_inputs import BlockIndex, NotOnRecordError, decoded
from harness.field.replay._agent_record import RecordedTrace
from ucp.block import Block
from ucp.messages import BlockResponse, CommitBlock, MalformedDatagramError
from ucp.trigger import MessageTrigger

SHOWN = 12
_HASH = re.compile("[0-9a-f]{6,64}")
_NAME = re.compile(r"\d+\.\d+")


def is_block(text: str) -> bool:
    """Return true if a text has the form of a block name or of the beginning of a block hash."""
    return bool(_NAME.fullmatch(text) or (_HASH.fullmatch(text) and not text.isdigit()))


class ReplayNames:
    """The names of blocks by hash, and the hashes by name. The names come from exports. Without exports, they come from
    traces.
    """

    def __init__(self, record: RecordedTrace) -> None:
        self._record = record

    def of(self, block_hash: str) -> str:
        return self._names.get(block_hash) or block_hash[:SHOWN]

    def prefix_of(self, text: str) -> str:
        """Return the hash of the block with this name.

        If no block has this name, return the text itself as the beginning of a hash.
        """
        return self._hashes.get(text, text)

    @cached_property
    def _names(self) -> dict[str, str]:
        names: dict[str, str] = {}
        exports = self._record.flight.exports
        other_traces = () if exports else self._record.flight.traces.values()
        for trace in (self._record.trace, *other_traces):
            completed = dict.fromkeys(trace.completed())
            names.update((block, f"{trace.header.agent_id}.{count}") for count, block in enumerate(completed, 1))
        return names | name_blocks(exports)

    @cached_property
    def _hashes(self) -> dict[str, str]:
        return {name: block_hash for block_hash, name in self._names.items()}


class RecordedBlocks(BlockIndex):
    """All blocks in the records of the flight. They include blocks that occur only after the current position of the
    replay.
    """

    def __init__(self, record: RecordedTrace) -> None:
        super().__init__(())
        self._record = record
        self._unread = self._sources()

    def get(self, block_hash: str) -> Block:
        while True:
            try:
                return super().get(block_hash)
            except NotOnRecordError:
                source = next(self._unread, None)
                if source is None:
                    raise
            for block in source:
                self.add(block)

    def _sources(self) -> Iterator[Iterator[Block]]:
        """Yield the blocks from the trace of the agent, then from the exports, and then from the other traces of the
        flight. The first source is the fastest.
        """
        yield _blocks_of(self._record.trace)
        yield self._of_exports()
        yield from map(_blocks_of, self._record.flight.traces.values())

    def _of_exports(self) -> Iterator[Block]:
        for export in self._record.flight.exports.values():
            for exported in export.blocks():
                yield Block(exported.agent_id, exported.timestamp_us, exported.event_bytes)


def _blocks_of(trace: Trace) -> Iterator[Block]:
    """Yield the blocks in messages that the agent received or sent."""
    for run in trace.runs:
        datagrams = [run.input] if isinstance(run.trigger, MessageTrigger) else []
        for datagram in (*datagrams, *(sent.datagram for sent in run.sent)):
            try:
                message = decoded(datagram).message
            except MalformedDatagramError:
                continue
            if isinstance(message, CommitBlock | BlockResponse):
                yield message.block
