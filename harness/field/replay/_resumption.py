"""Find a place after a gap in a trace at which the state of the agent is known. Also detect changes of the agent's
clock.

The state of an idle agent consists of its chain and its current block. The top chain hash identifies the chain if the
records of the flight contain every chain hash from the inception block up to it. The content of the current block is
known from the block that the agent later completes.

Each message between two agents shows the difference of their clocks, apart from the time that the message takes. If
this difference changes by the same amount for most other agents, the clock of this agent was changed.
"""

from collections.abc import Iterator
from functools import cached_property
from itertools import islice
from statistics import median
from typing import NamedTuple

from harness.archive.traces import Trace
from harness.checker.recorded_inputs import NotOnRecordError, event_of
from harness.checker.steps.follower import StepComparer
from harness.field.replay._agent_record import RecordedTrace, RecordEntry
from harness.field.replay._peer_messages import PeerMessages
from harness.field.replay.replay_names import RecordedBlocks
from ucp.block import HASH_BYTES, Block, InceptionBlock, next_chain_hash
from ucp.events import MalformedEventsError
from ucp.trace import HandlerRun
from ucp.trigger import EventTrigger, LocalTrigger

_ChainSteps = dict[bytes, tuple[bytes, str]]
"""Chain hash -> the chain hash before its last block, and the block hash of this block."""


class ResumptionSearch:
    """A search for known agent states after missing lines. It uses the chains in all records of the flight."""

    def __init__(self, record: RecordedTrace, blocks: RecordedBlocks) -> None:
        self._record = record
        self._blocks = blocks
        self._inception = InceptionBlock(record.header.initial_data).chain_hash

    def resume(self, follower: StepComparer, position: int) -> bool:
        """Set a new `StepComparer` to the agent's state after the entry at `position`. Return false if the agent's
        state is unknown there.
        """
        entry = self._record.entries[position]
        run = entry.content
        if not isinstance(run, HandlerRun):
            return False
        state = run.state
        if not state.idle or state.reconciling or state.deque or state.stack:
            return False
        _, following = next(self._following_runs(position), (None, None))
        if following is not None and isinstance(following.trigger, LocalTrigger):
            return False
        try:
            chain = self._chain(state.top, self._own_steps)
            if chain is None:
                chain = self._chain(state.top, self._all_steps)
            block_in_progress = self._block_in_progress(position)
        except (NotOnRecordError, MalformedEventsError):
            return False
        if chain is None or len(chain) != state.chain or block_in_progress is None:
            return False
        if len({block.block_hash for block in chain}) < len(chain):
            return False  # No chain of the reference holds a block twice.
        follower.begin_at(chain, block_in_progress, self._sequence(position))
        return True

    def _chain(self, top: str, predecessors: _ChainSteps) -> list[Block] | None:
        """Return the blocks of the chain with this top chain hash, the oldest first. Return None if `predecessors` does
        not contain the whole chain. Raises NotOnRecordError if the content of a block is unknown.
        """
        blocks: list[Block] = []
        chain_hash = bytes.fromhex(top) if len(top) == 2 * HASH_BYTES and _is_hex(top) else b""
        while chain_hash != self._inception:
            if chain_hash not in predecessors:
                return None
            chain_hash, block_hash = predecessors[chain_hash]
            blocks.append(self._blocks.get(block_hash))
        return blocks[::-1]

    @cached_property
    def _own_steps(self) -> _ChainSteps:
        """The pairs of successive chain hashes in the exports and in the trace of this agent."""
        steps: _ChainSteps = {}
        for export in self._record.flight.exports.values():
            predecessors = self._inception
            for block in export.chain:
                chain_hash = next_chain_hash(predecessors, bytes.fromhex(block.block_hash))
                steps[chain_hash] = predecessors, block.block_hash
                predecessors = chain_hash
        self._add_steps(self._record.trace, steps)
        return steps

    @cached_property
    def _all_steps(self) -> _ChainSteps:
        """The pairs of successive chain hashes in all records. The computation of the pairs takes some time, because it
        reads every trace.
        """
        steps = self._own_steps.copy()
        for trace in self._record.flight.traces.values():
            self._add_steps(trace, steps)
        return steps

    def _add_steps(self, trace: Trace, steps: _ChainSteps) -> None:
        for incarnation in trace.incarnations():
            top: bytes | None = self._inception
            for _, run in incarnation:
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

    def _block_in_progress(self, position: int) -> bytes | None:
        """Return the content of the block under construction after an entry. The content is computed from the following
        events. Return None if the content is unknown.
        """
        logged = bytearray()
        for _, run in self._following_runs(position):
            if run.handler != "build_data_block" or not isinstance(run.trigger, EventTrigger):
                continue
            logged += event_of(run.input).encode()
            completed = next((block for operation, block in run.changes if operation == "complete"), None)
            if completed is not None:
                data = self._blocks.get(completed).event_data
                return data[: -len(logged)] if data.endswith(logged) else None
        return b""  # The block is never completed, so its content has no effect.

    def _sequence(self, position: int) -> int:
        """Return the sequence number of the first message that the agent sends after an entry. Return 0 if the agent
        sends no further message.
        """
        return next((run.sent[0].seq for _, run in self._following_runs(position) if run.sent), 0)

    def _following_runs(self, position: int) -> Iterator[tuple[RecordEntry, HandlerRun]]:
        """Yield the handler runs after an entry, up to a gap or a restart."""
        incarnation = self._record.entries[position].incarnation
        for entry in islice(self._record.entries, position + 1, None):
            if isinstance(entry.content, HandlerRun):
                if entry.gap is not None or entry.incarnation != incarnation:
                    return
                yield entry, entry.content


def _is_hex(text: str) -> bool:
    try:
        bytes.fromhex(text)
    except ValueError:
        return False
    return True


WITHIN = 200
"""Number of trace lines before an entry, and after it, in which the detector searches for a change of the clock."""
MESSAGES = 3
"""Number of messages in a group. To find a change of the clock, the detector compares the median time difference of a
group of messages with that of the following group. If no such groups differ, the detector also tries smaller groups at
the first and the last messages.
"""
MIN_SHIFT_S = 1.0
"""Minimum change of a clock, in seconds, that the detector reports."""


class ClockChange(NamedTuple):
    """A change of an agent's clock. No entry before `position` has the new clock."""

    position: int
    reason: str
    """A text such as "its clock was set by +30.0 s, as its messages show,"."""


class ClockChangeDetector:
    """A detector of changes of the agent's clock. Its first use reads the records of the other agents."""

    def __init__(self, record: RecordedTrace) -> None:
        self._record = record

    def change_near(self, position: int) -> ClockChange | None:
        """Return the change of the clock near this entry. Return None if the clock did not change."""
        if self._record.flight.record is not None:
            return None  # The agents of a run share one clock.
        jumps = [_largest_jump(differences, position) for differences in self._differences]
        known = [jump for jump in jumps if jump is not None]
        least_s = max(MIN_SHIFT_S, self._record.header.late_s)
        shift_s = median(jump.by_s for jump in known) if known else 0.0
        agreeing = [jump for jump in known if abs(jump.by_s - shift_s) <= least_s]
        if abs(shift_s) < least_s or 2 * len(agreeing) <= len(known):
            return None
        first = min(max(jump.last_old for jump in agreeing) + 1, min(jump.first_new for jump in agreeing))
        return ClockChange(first, f"its clock was set by {shift_s:+.1f} s, as its messages show,")

    @cached_property
    def _differences(self) -> list[list[tuple[int, float]]]:
        """One list for each other agent, with the messages between the other agent and this agent. Each message is a
        pair: its position in the trace, and the difference of both clocks in seconds.
        """
        own = self._record.agent_id
        differences = []
        for agent_id, trace in self._record.flight.traces.items():
            if agent_id == own:
                continue
            offsets = []
            for position, delivery in PeerMessages(self._record, trace):
                later_s = delivery.received_s - delivery.sent_s
                offsets.append((position, -later_s if delivery.sender == own else later_s))
            differences.append(offsets)
        return differences


class _Jump(NamedTuple):
    """A change of the difference between two clocks, in seconds, between the trace entries at these two positions."""

    by_s: float
    last_old: int
    first_new: int


def _largest_jump(differences: list[tuple[int, float]], position: int) -> _Jump | None:
    """Return the largest change of the clock difference around an entry. Return None if there are too few messages."""
    near = [message for message in differences if abs(message[0] - position) <= WITHIN]
    offsets = [offset_s for _, offset_s in near]
    groups = [
        (median(offsets[max(number - MESSAGES, 0) : number]), median(offsets[number : number + MESSAGES]), number)
        for number in range(1, len(near))
    ]
    if not groups:
        return None
    full = [group for group in groups[MESSAGES - 1 :] if group[2] <= len(near) - MESSAGES]
    differing = [group for group in full if abs(group[1] - group[0]) >= MIN_SHIFT_S]
    before_s, after_s, middle = max(differing or groups, key=lambda group: abs(group[1] - group[0]))
    first_new = next(
        number
        for number in range(max(middle - MESSAGES, 0), len(near))
        if abs(offsets[number] - after_s) <= abs(offsets[number] - before_s)
    )
    return _Jump(after_s - before_s, near[max(first_new - 1, 0)][0], near[first_new][0])
