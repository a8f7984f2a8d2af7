"""Play a record: pass the recorded inputs to the reference core or to the agent core, forward or back.

The result is the same each time. To go back, the player restores a checkpoint and plays forward from this checkpoint.
The alternative was rejected: to reverse single steps, each handler would need an inverse.
"""

from bisect import bisect_left
from collections.abc import Iterable, Iterator
from copy import copy
from dataclasses import dataclass, field
from itertools import islice

from harness.archive.vocabulary import IGNORED_KINDS, first_unknown, unknown_names
from harness.checker.reference.algorithms import ON_TIMER
from harness.checker.reference.state import ReferenceState
from harness.checker.steps import end_of_record, wrongly_dropped
from harness.checker.steps.deviation import StepDeviation
from harness.checker.steps.follower import OptionalTraceFields, StepComparer
from harness.checker.steps.implementation import REFERENCE, CoreImplementation
from harness.checker.steps.single_line import JOINED, LINES_AFTER, damage_that_explains
from harness.field.replay._agent_record import RecordedTrace, RecordEntry
from harness.field.replay._ignored_messages import ignored_messages
from harness.field.replay._resumption import ClockChangeDetector, ResumptionSearch
from harness.field.replay.replay_names import RecordedBlocks
from ucp.messages import Message
from ucp.trace import HandlerRun

CHECKPOINT_STEPS = 1000
"""Number of steps between two checkpoints. To go back, the player replays half of these steps on average, which takes
some milliseconds.
"""

MAX_DOUBTS = 3
"""Maximum number of places at which a damaged line may explain a deviation. If there are more such places, the replay
assumes that the agent made the mistakes.
"""
MAX_TRIED = 20
"""Maximum number of deviations for which damage to a line is tried as an explanation."""

PERHAPS = "perhaps"
"""The word that marks an uncertain reason for a step that was not judged, as in "perhaps a line is missing"."""

_OF_TIMERS = frozenset(handler.name for handler in ON_TIMER.values())


@dataclass
class ReplayResult:
    """The result of the replay up to the current entry."""

    steps: int = 0
    """Number of handler runs that were compared with the reference."""
    unjudged: int = 0
    """Number of handler runs that could not be compared."""
    lost: list[str] = field(default_factory=list)
    """Reasons why handler runs could not be compared, as sentences."""
    deviations: list[StepDeviation] = field(default_factory=list)
    positions: list[int] = field(default_factory=list)
    """The positions of the deviations in the record. If a step is missing, its deviation is at the position of the next
    entry.
    """

    def copy(self) -> "ReplayResult":
        return ReplayResult(self.steps, self.unjudged, list(self.lost), list(self.deviations), list(self.positions))

    def add(self, position: int, deviations: Iterable[StepDeviation]) -> None:
        for deviation in deviations:
            self.deviations.append(deviation)
            self.positions.append(position)

    def insert(self, position: int, deviation: StepDeviation) -> None:
        """Insert a deviation into the list of deviations, which is ordered by position."""
        number = bisect_left(self.positions, position)
        self.deviations.insert(number, deviation)
        self.positions.insert(number, position)

    @property
    def first(self) -> StepDeviation | None:
        return self.deviations[0] if self.deviations else None


@dataclass(frozen=True)
class _PlayerCheckpoint:
    follower: StepComparer
    incarnation: int
    result: ReplayResult


class RecordPlayer:
    """A player of a record, which gives the recorded inputs to an agent core up to mission second `until_s`.

    The agent core is `implementation`: the reference, which judges agents, or the installed core
    (`harness.checker.steps.core_in_use`).
    """

    def __init__(
        self, record: RecordedTrace, until_s: float | None = None, implementation: CoreImplementation = REFERENCE
    ) -> None:
        self.record = record
        self._implementation = implementation
        entries = record.entries
        self.entries = entries if until_s is None else entries[: _later_than(entries, until_s)]
        self.position = 0
        """The number of trace entries that were played."""
        self.result = ReplayResult()
        """The result of the played entries."""
        self._parts = OptionalTraceFields.of(record.trace)
        self._unknown = unknown_names(record.trace.runs)
        self._blocks = RecordedBlocks(record)
        self._clock_set = ClockChangeDetector(record)
        self._resumption = ResumptionSearch(record, self._blocks)
        self.resumed_at: int | None = None
        """The state of the agent is unknown after a gap. This is the position from which on the state is known again
        after the last gap. None if the replay has not passed such a position.
        """
        self._follower, self._incarnation = self._new_follower(), 1
        self._checkpoints = {0: _PlayerCheckpoint(self._follower.copy(), 1, self.result.copy())}

    @property
    def state(self) -> ReferenceState:
        """The state of the agent after the last played entry."""
        return self._follower.state

    @property
    def lost(self) -> str | None:
        """The reason why the state of the agent is unknown at this position, or None if the state is known."""
        return self._follower.lost

    @property
    def entry(self) -> RecordEntry | None:
        """The trace entry that was played last, or None if no entry was played."""
        return self.entries[self.position - 1] if self.position else None

    @property
    def at_end(self) -> bool:
        return self.position == len(self.entries)

    def deviations_here(self) -> list[StepDeviation]:
        """Return the deviations at the last played entry. Some of them, such as a missing message, are known only
        because of the next entry.
        """
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

    def forward(self, *, into_debugger: bool = False) -> RecordEntry:
        """Play the next entry. If `into_debugger` is true, call `breakpoint()` directly before its handler runs."""
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
            self._checkpoints[self.position] = _PlayerCheckpoint(
                self._follower.copy(), self._incarnation, self.result.copy()
            )
        return entry

    def to(self, position: int, *, replay: bool = False) -> None:
        """Go forward or back to a position. If `replay` is true, play the entry at this position again if the player is
        already there.
        """
        position = max(0, min(position, len(self.entries)))
        if position < self.position or replay:
            nearest = max(known for known in self._checkpoints if known <= position)
            checkpoint = self._checkpoints[nearest]
            self._follower, self._incarnation = checkpoint.follower.copy(), checkpoint.incarnation
            self.result, self.position = checkpoint.result.copy(), nearest
        while self.position < position:
            self.forward()

    def to_end(self) -> ReplayResult:
        """Play all remaining entries. The result includes steps that are missing after the last line, and messages that
        the agent ignored.
        """
        self.to(len(self.entries))
        result = self.result.copy()
        whole = len(self.entries) == len(self.record.entries) and self._incarnation == self.record.incarnations
        if whole and (until_s := self.record.present_until_s) is not None:
            follower = self._follower.copy()
            follower.end(until_s)
            result.add(self.position, follower.deviations)
        elif whole:
            self._judge_end(result)
        if self.record.arrivals and (ignored := ignored_messages(self.record, self._earlier().at)) is not None:
            result.insert(*ignored)
        return result

    def _judge_end(self, result: ReplayResult) -> None:
        """If the agent did not end regularly, add the reason to the result."""
        record = self.record
        if record.flight.record is not None:
            recorded = record.flight.record.agents.get(str(record.agent_id))
            crashed = end_of_record.crashes(record.trace, recorded)
            result.add(self.position, crashed)
            if not crashed and (why := end_of_record.failure(recorded)) is not None:
                result.lost.append(why)
                result.unjudged += 1
        elif self._follower.lost is None and (sentence := record.ends_open(self._follower)) is not None:
            result.lost.append(sentence)
            result.unjudged += 1

    def at(self, position: int) -> "RecordPlayer":
        """Go to a position in the record, and return this player."""
        self.to(position)
        return self

    def _earlier(self) -> "RecordPlayer":
        """Return a copy of this player at the beginning of the record."""
        earlier = copy(self)
        earlier.to(0, replay=True)
        return earlier

    def has_effect(self, sender: int, message: Message, at_s: float) -> bool:
        """Return true if the agent would react to a message that arrives at the current position."""
        return self._follower.copy().has_effect(sender, message, at_s)

    def handler_of(self, message: Message) -> str:
        """Return the name of the handler for a message."""
        return str(self._implementation.on_message[type(message)].name)

    def _follow(self, entry: RecordEntry, run: HandlerRun) -> None:
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
                self.resumed_at = self.position + 1
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

    def _excuse(self, deviations: list[StepDeviation]) -> str | None:
        """Return a reason why the deviations may not be mistakes of the agent, such as missing lines. Return None if no
        such reason exists.
        """
        if (why := self.record.unrecorded.get(self.position)) is not None:
            return f"{why},"
        of_timers = any(deviation.run is None and deviation.handler in _OF_TIMERS for deviation in deviations)
        if of_timers and (change := self._clock_set.change_near(self.position)) is not None:
            self.record.clock_changes.setdefault(change.position, change.reason)
            return change.reason
        return self._doubt(deviations)

    def _doubt(self, deviations: list[StepDeviation]) -> str | None:
        """Return the damage to a single line that would also explain the deviations at this position. Return None if no
        damage explains them.

        Such damage is rare. If it would explain more than `MAX_DOUBTS` places in a record, the deviations count as
        mistakes of the agent. Damage that joins two lines counts only if the record has no unexplained deviation.
        """
        if self.record.is_counted:
            return None
        if self.record.doubts is None:
            doubting = _DoubtingPlayer(self.record)
            doubting.to(len(doubting.entries))
            whys = doubting.found.values()
            found = {
                position: why
                for position, why in doubting.found.items()
                if why is not None and not (JOINED in why and None in whys)
            }
            self.record.doubts = found if len(found) <= MAX_DOUBTS else {}
        return self.record.doubts.get(self.position)

    def _new_follower(self) -> StepComparer:
        return StepComparer(self.record.header, self._parts, self._blocks, self.record.was_paused, self._implementation)


class _DoubtingPlayer(RecordPlayer):
    """A player that tries to explain each deviation by damage to a single line."""

    def __init__(self, record: RecordedTrace) -> None:
        super().__init__(record)
        self.found: dict[int, str | None] = {}
        """The damage that explains each deviation, by the position of the deviation. The value is None if no damage
        explains the deviation.
        """

    def _doubt(self, deviations: list[StepDeviation]) -> str | None:
        if self.position not in self.found:
            if len(self.found) > MAX_TRIED or sum(why is not None for why in self.found.values()) > MAX_DOUBTS:
                return None
            before = copy(self)
            before.to(self.position, replay=True)
            entry = self.entries[self.position]
            assert isinstance(entry.content, HandlerRun)
            line, following = (entry.line, entry.content), list(islice(self._following(), LINES_AFTER))
            damage = damage_that_explains(before._follower, deviations[0], line, following, self.record)
            self.found[self.position] = damage and f"{PERHAPS} {damage} (otherwise: {deviations[0].sentence(_short)}),"
        return self.found[self.position]

    def _following(self) -> Iterator[tuple[int, HandlerRun]]:
        """Yield the handler runs after the current entry, up to the next place at which lines are missing."""
        for position, entry in enumerate(self.entries[self.position + 1 :], self.position + 1):
            if entry.gap is not None or entry.incarnation != self._incarnation or position in self.record.unrecorded:
                return
            if isinstance(entry.content, HandlerRun):
                yield entry.line, entry.content


def _short(block_hash: str) -> str:
    return block_hash[:12]


def _later_than(entries: Iterable[RecordEntry], until_s: float) -> int:
    """Return the number of entries up to the mission second `until_s`."""
    count = 0
    for entry in entries:
        if entry.content.t > until_s:
            break
        count += 1
    return count
