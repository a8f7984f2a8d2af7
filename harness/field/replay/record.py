"""One agent's record as it is played: its lines in order, and what lies beside it."""

from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from heapq import merge
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import Protocol

from harness.archive.archive import RunArchive
from harness.archive.exports import RUN_FILE, Export, agents_directory
from harness.archive.record import JudgedRecord
from harness.archive.traces import SUFFIX, Trace, read_trace, why_none
from harness.checker.evidence import Evidence
from harness.checker.steps.header import CheckedHeader, ImpossibleHeaderError, checked
from harness.errors import FieldError, RunDirectoryError
from harness.gc_pause import gc_paused
from ucp.clock import MICROSECONDS
from ucp.trace import Commanded, Dropped, HandlerRun


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
    """The trace of one agent; `path` is where it is from. Raises FieldError if nothing of it can be played."""

    def __init__(self, path: Path, trace: Trace, beside: Beside, problems: list[str]) -> None:
        self.path = path
        self.trace = trace
        self.beside = beside
        self.problems = problems
        self.agent_id = trace.header.agent_id
        self.lives = len(trace.starts) + 1
        if not trace.header.has_inputs:
            raise FieldError(
                f"{path}: it is of ucp-trace/1, which lacks what the agent received; agents are to write ucp-trace/2"
            )
        try:
            self.header: CheckedHeader = checked(trace.header)
        except ImpossibleHeaderError as error:
            raise FieldError(f"{path}: {error}; nothing of it can be played") from None
        self.entries = list(_entries(trace))
        if not self.entries:
            raise FieldError(f"{path}: agent {self.agent_id} did nothing in it: there is nothing to play")

    def position_of_line(self, line: int) -> int:
        """How many entries stand before this line of the file."""
        return bisect_left(self.entries, line, key=attrgetter("line"))

    def position_of_second(self, at_s: float) -> int:
        """How many entries stand before the first that is not before this mission second."""
        return next((number for number, entry in enumerate(self.entries) if entry.what.t >= at_s), len(self.entries))

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
            return self.beside.record.mission_s
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
    gaps = {gap.position: gap.lines for gap in getattr(trace, "gaps", ())}
    positions = [0, *trace.starts, len(trace.runs)]
    runs = (
        Entry(line, life, run, _missing(gaps[position]) if position in gaps else None)
        for life, ((start, _), of_life) in enumerate(zip(pairwise(positions), trace.lives(), strict=True), 1)
        for position, (line, run) in enumerate(of_life, start)
    )
    asides = (Entry(line, 0, aside) for line, aside in trace.numbered_asides())
    return merge(runs, asides, key=attrgetter("line"))


def _missing(lines: int) -> str:
    return "lines are missing" if not lines else "a line is damaged" if lines == 1 else f"{lines} lines are damaged"


class _InDirectory:
    """What lies in the directory of a run, or beside a trace."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory

    @cached_property
    def _archive(self) -> RunArchive | None:
        try:
            return RunArchive(self._directory)
        except RunDirectoryError:
            return None

    @property
    def exports(self) -> Mapping[int, Export]:
        return self._archive.exports.by_agent if self._archive else {}

    @cached_property
    def traces(self) -> Mapping[int, Trace]:
        read = (_read(path) for path in agents_directory(self._directory).glob(f"*{SUFFIX}"))
        return {trace.header.agent_id: trace for trace in read if trace is not None}

    @property
    def record(self) -> JudgedRecord | None:
        return self._archive.judged_record if self._archive else None


def open_record(path: Path, agent_id: int | None = None) -> Record:
    """The record in a trace file, or that of an agent in a directory. Raises FieldError if there is none to play."""
    if path.is_dir():
        file = _file_of(path, agent_id)
        directory = path
    else:
        file = path
        run = path.parent.parent
        directory = run if (run / RUN_FILE).is_file() and path.parent.name == "agents" else path.parent
    trace = _read(file)
    if trace is None:
        raise FieldError(f"{file}: {why_none(file)}; give a trace (*{SUFFIX}), or a directory of them and --agent")
    if agent_id is not None and trace.header.agent_id != agent_id:
        raise FieldError(f"{file}: the trace is of agent {trace.header.agent_id}, not of agent {agent_id}")
    problems = [f"{file}: {trace.problem}; what is before that is played"] if trace.problem else []
    if trace.cut_off:
        problems.append(f"{file}: it ends in half a line, which is left out")
    return Record(file, trace, _InDirectory(directory), problems)


@gc_paused()
def _read(path: Path) -> Trace | None:
    return read_trace(path)


def _file_of(directory: Path, agent_id: int | None) -> Path:
    agents = agents_directory(directory)
    there = sorted(
        (path for path in agents.glob(f"*{SUFFIX}") if path.is_file()), key=lambda path: (len(path.name), path.name)
    )
    if not there:
        raise FieldError(f"{directory}: it has no traces (*{SUFFIX}): give a trace, or a directory of them")
    if agent_id is None and len(there) == 1:
        return there[0]
    names = ", ".join(path.name.removesuffix(SUFFIX) for path in there)
    if agent_id is None:
        raise FieldError(f"{directory}: whose record is to be played? Choose with --agent: {names}")
    path = agents / f"{agent_id}{SUFFIX}"
    if path not in there:
        raise FieldError(f"{directory}: there is no trace of agent {agent_id}, but of {names}")
    return path
