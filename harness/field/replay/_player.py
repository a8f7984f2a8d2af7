"""Plays a record: the reference core is given what the agent was given, forward and back, always the same.

Going back is exact: it plays again, from a checkpoint shortly before.
"""

from bisect import bisect_left
from collections.abc import Iterable
from dataclasses import dataclass, field

from harness.archive.vocabulary import IGNORED_KINDS, first_unknown, unknown_names
from harness.checker.reference.algorithms import ON_TIMER
from harness.checker.reference.state import State
from harness.checker.steps import wrongly_dropped
from harness.checker.steps.deviation import Deviation
from harness.checker.steps.follower import Follower, Tells
from harness.checker.steps.implementation import REFERENCE, Implementation
from harness.field.replay._agent_record import Entry, Record
from harness.field.replay._resumption import ClockSet, Resumption
from harness.field.replay.replay_names import RecordedBlocks
from ucp.trace import HandlerRun

CHECKPOINT_STEPS = 1000
"""Between two checkpoints. Going back plays half as many steps in the mean: some milliseconds."""

_OF_TIMERS = frozenset(handler.name for handler in ON_TIMER.values())


@dataclass
class Found:
    """What has come of playing so far."""

    steps: int = 0
    """Handler runs that were held against the reference's."""
    unjudged: int = 0
    """Handler runs that could not be."""
    lost: list[str] = field(default_factory=list)
    """Why not: sentences."""
    deviations: list[Deviation] = field(default_factory=list)
    positions: list[int] = field(default_factory=list)
    """After which entry each of these was found: what is missing shows when the next comes."""

    def copy(self) -> "Found":
        return Found(self.steps, self.unjudged, list(self.lost), list(self.deviations), list(self.positions))

    def differ(self, position: int, deviations: Iterable[Deviation]) -> None:
        for deviation in deviations:
            self.deviations.append(deviation)
            self.positions.append(position)

    @property
    def first(self) -> Deviation | None:
        return self.deviations[0] if self.deviations else None


@dataclass(frozen=True)
class _Checkpoint:
    follower: Follower
    life: int
    found: Found


class Player:
    """At `position` so many entries of the record have been played; `found` is what has come of these.

    `until_s` is the last mission second that is played. `implementation` plays the record: the reference, by which
    agents are judged, or the core in use (`harness.checker.steps.core_in_use`).
    """

    def __init__(
        self, record: Record, until_s: float | None = None, implementation: Implementation = REFERENCE
    ) -> None:
        self.record = record
        self._implementation = implementation
        entries = record.entries
        self.entries = entries if until_s is None else entries[: _later_than(entries, until_s)]
        self.position = 0
        self.found = Found()
        self._tells = Tells.of(record.trace)
        self._unknown = unknown_names(record.trace.runs)
        self._blocks = RecordedBlocks(record)
        self._clock_set = ClockSet(record)
        self._resumption = Resumption(record, self._blocks)
        self._follower, self._life = self._born(), 1
        self._checkpoints = {0: _Checkpoint(self._follower.copy(), 1, self.found.copy())}

    @property
    def state(self) -> State:
        """What the agent holds, asks and counts by now."""
        return self._follower.state

    @property
    def lost(self) -> str | None:
        """Why nobody knows what the agent holds now, if that is so."""
        return self._follower.lost

    @property
    def entry(self) -> Entry | None:
        """What was played last."""
        return self.entries[self.position - 1] if self.position else None

    @property
    def at_end(self) -> bool:
        return self.position == len(self.entries)

    def deviations_here(self) -> list[Deviation]:
        """What the entry played last shows to be wrong, and what the next will show to be wrong of it."""
        found = self.found
        here = found.deviations[bisect_left(found.positions, self.position) :]
        upcoming = None if self.at_end else self.entries[self.position]
        if upcoming is None or not isinstance(upcoming.what, HandlerRun) or upcoming.life != self._life or upcoming.gap:
            return here
        if self.position in self.record.unwritten:
            return here
        return here + self._follower.foresee(upcoming.line, upcoming.what)

    def forward(self, *, into_debugger: bool = False) -> Entry:
        """Play the next entry; `into_debugger` calls `breakpoint()` right before its handler runs."""
        entry = self.entries[self.position]
        if isinstance(entry.what, HandlerRun):
            if entry.life != self._life:
                self._follower, self._life = self._born(), entry.life
            self._follower.stops_before_handler = into_debugger
            try:
                self._follow(entry, entry.what)
            finally:
                self._follower.stops_before_handler = False
        elif (deviation := wrongly_dropped(self.record.header, entry.line, entry.what)) is not None:
            self.found.differ(self.position + 1, [deviation])
        self.position += 1
        if self.position % CHECKPOINT_STEPS == 0 and self.position not in self._checkpoints:
            self._checkpoints[self.position] = _Checkpoint(self._follower.copy(), self._life, self.found.copy())
        return entry

    def to(self, position: int, *, anew: bool = False) -> None:
        """Go there, forward or back; `anew`, by playing again even if it is there already."""
        position = max(0, min(position, len(self.entries)))
        if position < self.position or anew:
            nearest = max(known for known in self._checkpoints if known <= position)
            checkpoint = self._checkpoints[nearest]
            self._follower, self._life = checkpoint.follower.copy(), checkpoint.life
            self.found, self.position = checkpoint.found.copy(), nearest
        while self.position < position:
            self.forward()

    def to_end(self) -> Found:
        """Play the rest; what has come of the whole record, also of what should have come after its last line."""
        self.to(len(self.entries))
        found = self.found.copy()
        whole = len(self.entries) == len(self.record.entries) and self._life == self.record.lives
        if whole and (until_s := self.record.was_there_until_s) is not None:
            follower = self._follower.copy()
            follower.end(until_s)
            found.differ(self.position, follower.deviations)
        return found

    def _follow(self, entry: Entry, run: HandlerRun) -> None:
        follower, found = self._follower, self.found
        if entry.gap is not None and follower.lost is None:
            follower.lost = (
                f"before line {entry.line} {entry.gap}, and the state of the agent at that time is not recorded"
            )
            found.lost.append(follower.lost)
        if follower.lost is not None:
            found.unjudged += 1
            resumed = self._born()
            if self._resumption.goes_on(resumed, self.position):
                found.lost[-1] += f"; continues after line {entry.line}, where the agent was idle with a recorded chain"
                self._follower = resumed
            return
        words = unknown_names([run]) if self._unknown else {}
        if words:
            found.unjudged += 1
            if words.keys() - IGNORED_KINDS:
                follower.lost = f"line {entry.line} has unknown words: {first_unknown(words)}"
                found.lost.append(follower.lost)
                return
            sentence = f"line {entry.line} is compared without its unknown words: {first_unknown(words)}"
            if sentence not in found.lost:
                found.lost.append(sentence)
        else:
            found.steps += 1
        follower.follow(entry.line, run)
        if follower.deviations and (why := self._excused(follower.deviations)) is not None:
            follower.deviations.clear()
            follower.lost = f"before line {entry.line} {why} and the state of the agent at that time is not recorded"
            if not words:
                found.steps, found.unjudged = found.steps - 1, found.unjudged + 1
        if follower.deviations:
            found.differ(self.position + 1, follower.deviations)
            follower.deviations.clear()
        if follower.lost is not None:
            found.lost.append(follower.lost)

    def _excused(self, deviations: list[Deviation]) -> str | None:
        """What is to blame in the place of the agent for what was found at the next entry, if anything is."""
        if (why := self.record.unwritten.get(self.position)) is not None:
            return f"{why},"
        if any(deviation.run is None and deviation.handler in _OF_TIMERS for deviation in deviations):
            return self._clock_set.near(self.position)
        return None

    def _born(self) -> Follower:
        return Follower(self.record.header, self._tells, self._blocks, self.record.was_paused, self._implementation)


def _later_than(entries: Iterable[Entry], until_s: float) -> int:
    """How many entries stand before the first that is later."""
    count = 0
    for entry in entries:
        if entry.what.t > until_s:
            break
        count += 1
    return count
