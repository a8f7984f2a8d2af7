"""One agent's record as it is played: its lines in order, and what is known beside it."""

from bisect import bisect_right
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Protocol

from harness.archive.exports import Export
from harness.archive.run_record import JudgedRecord
from harness.archive.traces import Trace
from harness.checker.evidence import Evidence
from harness.checker.steps.trace_header import CheckedHeader, ImpossibleHeaderError, checked
from harness.errors import FieldError
from ucp.clock import MICROSECONDS
from ucp.trace import Commanded, Dropped, HandlerRun

JUMPS, JUMPING = 3, 0.1
"""More jumps in the numbers of messages than this, and in more than this share, are the agent's way to count."""


@dataclass(frozen=True, slots=True)
class Entry:
    """A line of the record; lines, and lives of the agent, count from 1.

    `gap` says what is missing right before it, such as "2 lines are damaged"; None where nothing is.
    """

    line: int
    life: int
    what: HandlerRun | Dropped | Commanded
    gap: str | None = None


class Beside(Protocol):
    """What is known of a flight; each is read when it is first asked for."""

    @property
    def exports(self) -> Mapping[int, Export]: ...

    @property
    def traces(self) -> Mapping[int, Trace]: ...

    @property
    def record(self) -> JudgedRecord | None:
        """What a run says of itself; no flight in the field does."""


class Record:
    """The trace of one agent; `path` is where it is from, and `named` how the command line names it.

    Raises FieldError if nothing of it can be played.
    """

    def __init__(self, path: Path, named: str, trace: Trace, beside: Beside, problems: list[str]) -> None:
        self.path = path
        self.named = named
        self.trace = trace
        self.beside = beside
        self.problems = problems
        self.agent_id = trace.header.agent_id
        self.lives = len(trace.starts) + 1
        if not trace.header.has_inputs:
            raise FieldError(
                f"{path}: it has the version ucp-trace/1, which lacks received messages; agents must write ucp-trace/2"
            )
        try:
            self.header: CheckedHeader = checked(trace.header)
        except ImpossibleHeaderError as error:
            raise FieldError(f"{path}: {error}; it cannot be played") from None
        self.entries = list(_entries(trace))
        if not self.entries:
            raise FieldError(f"{path}: it has no handler runs of agent {self.agent_id}, so there is nothing to play")

    def position_of_line(self, line: int) -> int:
        """How many entries stand before this line of the file."""
        return next((number for number, entry in enumerate(self.entries) if entry.line >= line), len(self.entries))

    def position_of_second(self, at_s: float) -> int:
        """How many entries stand before the first that is not before this mission second."""
        return next((number for number, entry in enumerate(self.entries) if entry.what.t >= at_s), len(self.entries))

    @cached_property
    def unwritten(self) -> dict[int, str]:
        """Entries before which lines are missing without a sign, by the numbers of what the agent sent; and why.

        Of the entries since it sent anything before that, nobody knows before which. An agent whose numbers often jump
        counts wrongly: then nothing is missing.
        """
        unwritten: dict[int, str] = {}
        life, expected, sent_at = 0, None, 0
        sendings = jumps = 0
        for position, entry in enumerate(self.entries):
            if entry.life != life or entry.gap is not None:
                life, expected = entry.life, None
            if isinstance(entry.what, HandlerRun) and entry.what.sent:
                first = entry.what.sent[0].seq
                sendings += 1
                if expected is not None and expected < first:
                    jumps += 1
                    why = f"lines are missing (no line has its message{_numbers(expected, first - 1)})"
                    unwritten.update(dict.fromkeys(range(sent_at, position + 1), why))
                expected, sent_at = entry.what.sent[-1].seq + 1, position + 1
        return unwritten if jumps <= max(JUMPS, sendings * JUMPING) else {}

    @property
    def ends_s(self) -> float:
        """The mission second of its last line."""
        return self.entries[-1].what.t

    @cached_property
    def was_there_until_s(self) -> float | None:
        """When the agent was there for certain after its last line, so that what is overdue by then is missing.

        In mission seconds; None if nobody knows that it was.
        """
        if self.trace.cut_off or self.trace.problem or self.agent_id not in self.beside.exports:
            return None
        if self.beside.record is not None:
            return self.beside.record.end_of(self.agent_id)
        epoch_us = self.trace.header.clock.get("epoch_us")
        if not isinstance(epoch_us, int):
            return None
        exported_s = (self.beside.exports[self.agent_id].exported_at_us - epoch_us) / MICROSECONDS
        exported_s = (exported_s - self.header.offset_s) / self.header.rate
        return exported_s if exported_s >= self.ends_s else None

    def was_paused(self, since: float, until: float) -> bool:
        """Whether the agent stood still at any time between two mission seconds, or may have.

        Where no run's record tells, its own lines do: one that is not heard of while a timer ends, and that catches up
        as soon as it is heard of again, may have stood still.
        """
        if self.beside.record is not None:
            return Evidence({}, record=self.beside.record).was_paused(self.agent_id, since, until)
        after = bisect_right(self._times, since)
        awake_s = self._times[after] if after < len(self._times) else until
        return since + self.header.late_s < awake_s and until <= awake_s + self.header.late_s

    @cached_property
    def _times(self) -> list[float]:
        return sorted(entry.what.t for entry in self.entries)


def _entries(trace: Trace) -> Iterator[Entry]:
    """The lines of a trace in their order."""
    missing = {gap.position: _missing(gap.lines) for gap in trace.gaps}
    missing |= dict.fromkeys(trace.jumps, "the agent's clock was set")
    asides = deque(zip((position for position, _ in trace.asides), trace.numbered_asides(), strict=True))
    position = 0
    for life, of_life in enumerate(trace.incarnations(), 1):
        for line, run in of_life:
            while asides and asides[0][0] <= position:
                yield Entry(asides[0][1][0], life, asides.popleft()[1][1])
            yield Entry(line, life, run, missing.get(position))
            position += 1
    for _, (line, aside) in asides:
        yield Entry(line, len(trace.starts) + 1, aside)


def _numbers(first: int, last: int) -> str:
    return f" {first}" if first == last else f"s {first} to {last}"


def _missing(lines: int) -> str:
    return "lines are missing" if not lines else "a line is damaged" if lines == 1 else f"{lines} lines are damaged"
