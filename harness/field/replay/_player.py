"""Play a record: the reference core receives the recorded inputs, forward and back, with the same result each time.

To go back, the player restores a checkpoint and plays forward from there. Reversing single steps instead would need an
inverse of each handler.
"""

from bisect import bisect_left
from collections.abc import Iterable
from dataclasses import dataclass, field

from harness.archive.vocabulary import IGNORED_KINDS, first_unknown, unknown_names
from harness.checker.reference.algorithms import ON_TIMER
from harness.checker.reference.state import State
from harness.checker.steps import wrongly_dropped
from harness.checker.steps.deviation import Deviation
from harness.checker.steps.follower import Follower, OptionalParts
from harness.checker.steps.implementation import REFERENCE, Implementation
from harness.field.replay._agent_record import Entry, Record
from harness.field.replay._resumption import ClockSet, Resumption
from harness.field.replay.replay_names import RecordedBlocks
from ucp.trace import HandlerRun

CHECKPOINT_STEPS = 1000
"""Number of steps between checkpoints. Going back plays half of them on average, which takes some milliseconds."""

_OF_TIMERS = frozenset(handler.name for handler in ON_TIMER.values())


@dataclass
class ReplayResult:
    """The result of the played entries."""

    steps: int = 0
    """Number of handler runs that were compared with the reference."""
    unjudged: int = 0
    """Number of handler runs that could not be compared."""
    lost: list[str] = field(default_factory=list)
    """Reasons why they could not be compared, as sentences."""
    deviations: list[Deviation] = field(default_factory=list)
    positions: list[int] = field(default_factory=list)
    """The position at which each deviation was found. A missing step is found at the next entry."""

    def copy(self) -> "ReplayResult":
        return ReplayResult(self.steps, self.unjudged, list(self.lost), list(self.deviations), list(self.positions))

    def add(self, position: int, deviations: Iterable[Deviation]) -> None:
        for deviation in deviations:
            self.deviations.append(deviation)
            self.positions.append(position)

    @property
    def first(self) -> Deviation | None:
        return self.deviations[0] if self.deviations else None


@dataclass(frozen=True)
class _Checkpoint:
    follower: Follower
    incarnation: int
    result: ReplayResult


class Player:
    """A player of a record. `position` is the number of played entries, and `result` their result.

    `until_s` is the last mission second to play. `implementation` plays the record: the reference, which judges agents,
    or the core in use (`harness.checker.steps.core_in_use`).
    """

    def __init__(
        self, record: Record, until_s: float | None = None, implementation: Implementation = REFERENCE
    ) -> None:
        self.record = record
        self._implementation = implementation
        entries = record.entries
        self.entries = entries if until_s is None else entries[: _later_than(entries, until_s)]
        self.position = 0
        self.result = ReplayResult()
        self._parts = OptionalParts.of(record.trace)
        self._unknown = unknown_names(record.trace.runs)
        self._blocks = RecordedBlocks(record)
        self._clock_set = ClockSet(record)
        self._resumption = Resumption(record, self._blocks)
        self._follower, self._incarnation = self._new_follower(), 1
        self._checkpoints = {0: _Checkpoint(self._follower.copy(), 1, self.result.copy())}

    @property
    def state(self) -> State:
        """The current state of the agent."""
        return self._follower.state

    @property
    def lost(self) -> str | None:
        """The reason why the state of the agent is currently unknown, else None."""
        return self._follower.lost

    @property
    def entry(self) -> Entry | None:
        """The entry played last."""
        return self.entries[self.position - 1] if self.position else None

    @property
    def at_end(self) -> bool:
        return self.position == len(self.entries)

    def deviations_here(self) -> list[Deviation]:
        """Return the deviations of the last entry, including those that the next entry will reveal."""
        result = self.result
        here = result.deviations[bisect_left(result.positions, self.position) :]
        upcoming = None if self.at_end else self.entries[self.position]
        if (
            upcoming is None
            or not isinstance(upcoming.content, HandlerRun)
            or upcoming.incarnation != self._incarnation
            or upcoming.gap
        ):
            return here
        if self.position in self.record.unrecorded:
            return here
        return here + self._follower.foresee(upcoming.line, upcoming.content)

    def forward(self, *, into_debugger: bool = False) -> Entry:
        """Play the next entry. `into_debugger` calls `breakpoint()` directly before its handler runs."""
        entry = self.entries[self.position]
        if isinstance(entry.content, HandlerRun):
            if entry.incarnation != self._incarnation:
                self._follower, self._incarnation = self._new_follower(), entry.incarnation
            self._follower.stops_before_handler = into_debugger
            try:
                self._follow(entry, entry.content)
            finally:
                self._follower.stops_before_handler = False
        elif (deviation := wrongly_dropped(self.record.header, entry.line, entry.content)) is not None:
            self.result.add(self.position + 1, [deviation])
        self.position += 1
        if self.position % CHECKPOINT_STEPS == 0 and self.position not in self._checkpoints:
            self._checkpoints[self.position] = _Checkpoint(self._follower.copy(), self._incarnation, self.result.copy())
        return entry

    def to(self, position: int, *, replay: bool = False) -> None:
        """Go to a position, forward or back. With `replay`, entries are played again even at the same position."""
        position = max(0, min(position, len(self.entries)))
        if position < self.position or replay:
            nearest = max(known for known in self._checkpoints if known <= position)
            checkpoint = self._checkpoints[nearest]
            self._follower, self._incarnation = checkpoint.follower.copy(), checkpoint.incarnation
            self.result, self.position = checkpoint.result.copy(), nearest
        while self.position < position:
            self.forward()

    def to_end(self) -> ReplayResult:
        """Play the rest. The result includes steps that are missing after the last line."""
        self.to(len(self.entries))
        result = self.result.copy()
        whole = len(self.entries) == len(self.record.entries) and self._incarnation == self.record.incarnations
        if whole and (until_s := self.record.present_until_s) is not None:
            follower = self._follower.copy()
            follower.end(until_s)
            result.add(self.position, follower.deviations)
        return result

    def _follow(self, entry: Entry, run: HandlerRun) -> None:
        follower, result = self._follower, self.result
        if entry.gap is not None and follower.lost is None:
            follower.lost = (
                f"before line {entry.line} {entry.gap}, and the state of the agent at that time is not recorded"
            )
            result.lost.append(follower.lost)
        if follower.lost is not None:
            result.unjudged += 1
            new_follower = self._new_follower()
            if self._resumption.resume(new_follower, self.position):
                result.lost[-1] += (
                    f"; continues after line {entry.line}, where the agent was idle with a recorded chain"
                )
                self._follower = new_follower
            return
        unknown = unknown_names([run]) if self._unknown else {}
        if unknown:
            result.unjudged += 1
            if unknown.keys() - IGNORED_KINDS:
                follower.lost = f"line {entry.line} has unknown words: {first_unknown(unknown)}"
                result.lost.append(follower.lost)
                return
            sentence = f"line {entry.line} is compared without its unknown words: {first_unknown(unknown)}"
            if sentence not in result.lost:
                result.lost.append(sentence)
        else:
            result.steps += 1
        follower.follow(entry.line, run)
        if follower.deviations and (why := self._excuse(follower.deviations)) is not None:
            follower.deviations.clear()
            follower.lost = f"before line {entry.line} {why} and the state of the agent at that time is not recorded"
            if not unknown:
                result.steps, result.unjudged = result.steps - 1, result.unjudged + 1
        if follower.deviations:
            result.add(self.position + 1, follower.deviations)
            follower.deviations.clear()
        if follower.lost is not None:
            result.lost.append(follower.lost)

    def _excuse(self, deviations: list[Deviation]) -> str | None:
        """Return a reason for the deviations other than the agent, such as missing lines. None if there is none."""
        if (why := self.record.unrecorded.get(self.position)) is not None:
            return f"{why},"
        if any(deviation.run is None and deviation.handler in _OF_TIMERS for deviation in deviations):
            return self._clock_set.shift_near(self.position)
        return None

    def _new_follower(self) -> Follower:
        return Follower(self.record.header, self._parts, self._blocks, self.record.was_paused, self._implementation)


def _later_than(entries: Iterable[Entry], until_s: float) -> int:
    """Return the number of entries before the first one that is later."""
    count = 0
    for entry in entries:
        if entry.content.t > until_s:
            break
        count += 1
    return count
