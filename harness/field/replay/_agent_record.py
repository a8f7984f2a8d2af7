"""The record of one agent for a replay: its lines in order, and the other records of the flight."""

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
from ucp.trace import CommandEntry, DroppedDatagram, HandlerRun

MAX_JUMPS, MAX_JUMP_SHARE = 3, 0.1
"""Limits for jumps in an agent's sequence numbers: their number, and their share. An agent with more jumps numbers
its messages in its own way, so a jump does not prove that lines are missing."""


@dataclass(frozen=True, slots=True)
class Entry:
    """A line of the record. Line numbers and incarnations count from 1.

    `gap` describes missing lines directly before it, such as "2 lines are damaged", else None.
    """

    line: int
    incarnation: int
    content: HandlerRun | DroppedDatagram | CommandEntry
    gap: str | None = None


class FlightRecords(Protocol):
    """The records of a flight. Each is read at its first use."""

    @property
    def exports(self) -> Mapping[int, Export]: ...

    @property
    def traces(self) -> Mapping[int, Trace]: ...

    @property
    def record(self) -> JudgedRecord | None:
        """The record of the run. None for a flight in the field."""


class Record:
    """The trace of one agent. `path` is its file, and `argument` is its name on the command line.

    Raises FieldError if no part of it can be played.
    """

    def __init__(self, path: Path, argument: str, trace: Trace, flight: FlightRecords, problems: list[str]) -> None:
        self.path = path
        self.argument = argument
        self.trace = trace
        self.flight = flight
        self.problems = problems
        self.agent_id = trace.header.agent_id
        self.incarnations = len(trace.starts) + 1
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
        """Return the number of entries before this line of the file."""
        return next((number for number, entry in enumerate(self.entries) if entry.line >= line), len(self.entries))

    def position_of_second(self, at_s: float) -> int:
        """Return the number of entries before this mission second."""
        return next((number for number, entry in enumerate(self.entries) if entry.content.t >= at_s), len(self.entries))

    @cached_property
    def unrecorded(self) -> dict[int, str]:
        """Positions at which lines may be missing without a trace, with the reason.

        A jump in the sequence numbers of sent messages shows that lines are missing, somewhere after the last sent
        message. If an agent's numbers jump often, it numbers its messages in its own way, and no line counts as
        missing.
        """
        unrecorded: dict[int, str] = {}
        incarnation, expected, sent_at = 0, None, 0
        sendings = jumps = 0
        for position, entry in enumerate(self.entries):
            if entry.incarnation != incarnation or entry.gap is not None:
                incarnation, expected = entry.incarnation, None
            if isinstance(entry.content, HandlerRun) and entry.content.sent:
                first = entry.content.sent[0].seq
                sendings += 1
                if expected is not None and expected < first:
                    jumps += 1
                    why = f"lines are missing (no line has its message{_numbers(expected, first - 1)})"
                    unrecorded.update(dict.fromkeys(range(sent_at, position + 1), why))
                expected, sent_at = entry.content.sent[-1].seq + 1, position + 1
        return unrecorded if jumps <= max(MAX_JUMPS, sendings * MAX_JUMP_SHARE) else {}

    @property
    def end_s(self) -> float:
        """The mission second of the last line."""
        return self.entries[-1].content.t

    @cached_property
    def present_until_s(self) -> float | None:
        """A mission second at which the agent certainly still ran, after its last line. None if unknown.

        Steps that were due before this time, but have no line, are missing.
        """
        if self.trace.cut_off or self.trace.problem or self.agent_id not in self.flight.exports:
            return None
        if self.flight.record is not None:
            return self.flight.record.end_of(self.agent_id)
        epoch_us = self.trace.header.clock.get("epoch_us")
        if not isinstance(epoch_us, int):
            return None
        exported_s = (self.flight.exports[self.agent_id].exported_at_us - epoch_us) / MICROSECONDS
        exported_s = (exported_s - self.header.offset_s) / self.header.rate
        return exported_s if exported_s >= self.end_s else None

    def was_paused(self, since: float, until: float) -> bool:
        """Return whether the agent was paused, or may have been, at any time between two mission seconds.

        The record of a run contains the pauses. Without it, an agent may have been paused if it wrote no line while a
        timer was overdue, and caught up with its next line.
        """
        if self.flight.record is not None:
            return Evidence({}, record=self.flight.record).was_paused(self.agent_id, since, until)
        after = bisect_right(self._times, since)
        next_s = self._times[after] if after < len(self._times) else until
        return since + self.header.late_s < next_s and until <= next_s + self.header.late_s

    @cached_property
    def _times(self) -> list[float]:
        return sorted(entry.content.t for entry in self.entries)


def _entries(trace: Trace) -> Iterator[Entry]:
    """Yield the lines of a trace in order."""
    missing = {gap.position: _missing(gap.lines) for gap in trace.gaps}
    missing |= dict.fromkeys(trace.jumps, "the agent's clock was set")
    asides = deque(zip((position for position, _ in trace.asides), trace.numbered_asides(), strict=True))
    position = 0
    for incarnation, numbered_runs in enumerate(trace.incarnations(), 1):
        for line, run in numbered_runs:
            while asides and asides[0][0] <= position:
                yield Entry(asides[0][1][0], incarnation, asides.popleft()[1][1])
            yield Entry(line, incarnation, run, missing.get(position))
            position += 1
    for _, (line, aside) in asides:
        yield Entry(line, len(trace.starts) + 1, aside)


def _numbers(first: int, last: int) -> str:
    return f" {first}" if first == last else f"s {first} to {last}"


def _missing(lines: int) -> str:
    return "lines are missing" if not lines else "a line is damaged" if lines == 1 else f"{lines} lines are damaged"
