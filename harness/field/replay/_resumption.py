"""Where an agent can be followed again after a gap, and whether its clock was set.

An idle agent holds its chain and the block that it builds, and waits for nothing. Its chain is told by the top chain
hash, if the records of the flight have every step from the inception block to that; the block that it builds by the
block that it becomes.

The messages between it and another show by how much their clocks differ, up to the time that a message takes. If that
jumps by the same with most others, it was this agent's clock that was set, and not the others'.
"""

from collections.abc import Iterator
from functools import cached_property
from itertools import islice
from statistics import median

from harness.archive.traces import Trace
from harness.checker.recorded_inputs import NotOnRecordError, event_of
from harness.checker.steps.follower import Follower
from harness.field.replay._agent_record import Entry, Record
from harness.field.replay._peer_messages import Exchanges
from harness.field.replay.replay_names import RecordedBlocks
from ucp.block import HASH_BYTES, Block, InceptionBlock, next_chain_hash
from ucp.events import MalformedEventsError
from ucp.trace import HandlerRun
from ucp.trigger import EventTrigger

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
        for life in trace.incarnations():
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
            if run.handler != "build_data_block" or not isinstance(run.trigger, EventTrigger):
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


WITHIN = 200
"""So many lines before and after are looked at."""
MESSAGES = 3
"""With one agent, before and after: of so many the median is taken."""
LEAST_S = 1.0
"""A jump by less is none."""


class ClockSet:
    """Reads the records of the others when it is first asked."""

    def __init__(self, record: Record) -> None:
        self._record = record

    def near(self, position: int) -> str | None:
        """By how much it was set around this entry, as "its clock was set by +30.0 s"; None if nothing shows that."""
        if self._record.beside.record is not None:
            return None  # the agents of a run share one clock
        jumps = [_largest_jump(differences, position) for differences in self._differences]
        known = [jump for jump in jumps if jump is not None]
        least_s = max(LEAST_S, self._record.header.late_s)
        by_s = median(known) if known else 0.0
        agree = sum(abs(jump - by_s) <= least_s for jump in known)
        if abs(by_s) < least_s or 2 * agree <= len(known):
            return None
        return f"its clock was set by {by_s:+.1f} s, as its messages show,"

    @cached_property
    def _differences(self) -> list[list[tuple[int, float]]]:
        """With each other agent: at which entry, and by how much, our clock shows more than its."""
        own = self._record.agent_id
        differences = []
        for agent_id, trace in self._record.beside.traces.items():
            if agent_id == own:
                continue
            with_it = []
            for position, delivery in Exchanges(self._record, trace):
                later_s = delivery.received_s - delivery.sent_s
                with_it.append((position, -later_s if delivery.sender == own else later_s))
            differences.append(with_it)
        return differences


def _largest_jump(differences: list[tuple[int, float]], position: int) -> float | None:
    """Of what a clock shows more than another, around an entry; None if there are too few messages."""
    near = [more for at, more in differences if abs(at - position) <= WITHIN]
    jumps = (
        median(near[number : number + MESSAGES]) - median(near[number - MESSAGES : number])
        for number in range(MESSAGES, len(near) - MESSAGES + 1)
    )
    return max(jumps, key=abs, default=None)
