"""Where an agent can be followed again that was lost: as soon as it is idle, and what it holds is known.

An idle agent holds its chain and the block that it builds, and waits for nothing. Its chain is told by the top chain
hash, if the records of the flight have every step from the inception block to that; the block that it builds by the
block that it becomes.
"""

from collections.abc import Iterator
from functools import cached_property
from itertools import islice

from harness.archive.traces import Trace
from harness.checker.steps.follower import Follower
from harness.checker.steps.recorded_inputs import NotOnRecordError, event_of
from harness.field.replay.agent_record import Entry, Record
from harness.field.replay.known_blocks import RecordedBlocks
from ucp.block import HASH_BYTES, Block, InceptionBlock, next_chain_hash
from ucp.events import MalformedEventsError
from ucp.trace import HandlerRun

_Below = dict[bytes, tuple[bytes, str]]
"""Chain hash -> the chain hash below it, and the block between."""


class Resumption:
    """Knows all chains that any record of the flight shows."""

    def __init__(self, record: Record, blocks: RecordedBlocks) -> None:
        self._record = record
        self._blocks = blocks
        self._inception = InceptionBlock(record.header.initial_data).chain_hash

    def goes_on(self, newborn: Follower, position: int) -> bool:
        """Put a follower that has followed nothing into the state after the entry at `position`, if that is known."""
        entry = self._record.entries[position]
        run = entry.what
        if not isinstance(run, HandlerRun):
            return False
        state = run.state
        if not state.idle or state.reconciling or state.deque or state.stack:
            return False
        try:
            chain = self._chain(state.top, self._own)
            if chain is None:
                chain = self._chain(state.top, self._everybody)
            building = self._building(position)
        except (NotOnRecordError, MalformedEventsError):
            return False
        if chain is None or len(chain) != state.chain or building is None:
            return False
        if len({block.block_hash for block in chain}) < len(chain):
            return False  # no chain of the reference's holds a block twice
        newborn.begin_at(chain, building, self._sequence(position))
        return True

    def _chain(self, top: str, below: _Below) -> list[Block] | None:
        """The blocks of the chain with this top chain hash, oldest first. Raises NotOnRecordError."""
        blocks: list[Block] = []
        chain_hash = bytes.fromhex(top) if len(top) == 2 * HASH_BYTES and _is_hex(top) else b""
        while chain_hash != self._inception:
            if chain_hash not in below:
                return None
            chain_hash, block_hash = below[chain_hash]
            blocks.append(self._blocks.get(block_hash))
        return blocks[::-1]

    @cached_property
    def _own(self) -> _Below:
        """By the record itself, and by exports."""
        steps: _Below = {}
        for export in self._record.beside.exports.values():
            below = self._inception
            for block in export.chain:
                chain_hash = next_chain_hash(below, bytes.fromhex(block.block_hash))
                steps[chain_hash] = below, block.block_hash
                below = chain_hash
        self._take_down(self._record.trace, steps)
        return steps

    @cached_property
    def _everybody(self) -> _Below:
        """By all records, which takes a while to read."""
        steps = self._own.copy()
        for trace in self._record.beside.traces.values():
            self._take_down(trace, steps)
        return steps

    def _take_down(self, trace: Trace, steps: _Below) -> None:
        for life in trace.lives():
            top: bytes | None = self._inception
            for _, run in life:
                for operation, block_hash in run.changes:
                    if top is None or not _is_hex(block_hash):
                        continue
                    if operation == "chain+":
                        chain_hash = next_chain_hash(top, bytes.fromhex(block_hash))
                        steps.setdefault(chain_hash, (top, block_hash))
                        top = chain_hash
                    elif operation == "chain-":
                        top = steps[top][0] if top in steps else None
                top = bytes.fromhex(run.state.top) if _is_hex(run.state.top) else None

    def _building(self, position: int) -> bytes | None:
        """The block that is being built after an entry, by the events that follow; None if nobody can know it."""
        logged = bytearray()
        for _, run in self._rest(position):
            if run.handler != "build_data_block" or "event" not in run.trigger:
                continue
            logged += event_of(run.input).encode()
            completed = next((block for operation, block in run.changes if operation == "complete"), None)
            if completed is not None:
                data = self._blocks.get(completed).event_data
                return data[: -len(logged)] if data.endswith(logged) else None
        return b""  # it is never full, so it makes no difference

    def _sequence(self, position: int) -> int:
        """The number of the next message that the agent sends after an entry; any, if it sends none."""
        return next((run.sent[0].seq for _, run in self._rest(position) if run.sent), 0)

    def _rest(self, position: int) -> Iterator[tuple[Entry, HandlerRun]]:
        """What follows of the same life, up to where something is missing."""
        life = self._record.entries[position].life
        for entry in islice(self._record.entries, position + 1, None):
            if isinstance(entry.what, HandlerRun):
                if entry.gap is not None or entry.life != life:
                    return
                yield entry, entry.what


def _is_hex(text: str) -> bool:
    try:
        bytes.fromhex(text)
    except ValueError:
        return False
    return True
