"""One agent's record as it is played: its lines in order, and what lies beside it."""

from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Protocol

from harness.archive.archive import RunArchive
from harness.archive.exports import RUN_FILE, Export, agents_directory
from harness.archive.record import JudgedRecord
from harness.archive.traces import HEADER, MAX_LINE_BYTES, SUFFIX, Trace, read_trace
from harness.checker.evidence import Evidence
from harness.checker.steps.header import CheckedHeader, ImpossibleHeaderError, checked
from harness.errors import FieldError, RunDirectoryError
from harness.field.homecoming import Flight, Homecoming, sort_out
from harness.gc_pause import gc_paused
from harness.packets.pcap import MAGICS
from ucp.clock import MICROSECONDS
from ucp.trace import Commanded, Dropped, HandlerRun

AGENTS = "agents"
"""Directory in a run's with what the agents left."""


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
    for life, of_life in enumerate(trace.lives(), 1):
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


class _Run:
    """What the directory of a run holds."""

    def __init__(self, directory: Path) -> None:
        self._archive = RunArchive(directory)

    @property
    def exports(self) -> Mapping[int, Export]:
        return self._archive.exports.by_agent

    @property
    @gc_paused()
    def traces(self) -> Mapping[int, Trace]:
        return self._archive.traces

    @property
    def record(self) -> JudgedRecord | None:
        return self._archive.judged_record


class _Around:
    """What lies around a trace in its directory, of the same mission."""

    record = None

    def __init__(self, trace: Trace, directory: Path) -> None:
        self._header = trace.header
        self._directory = directory

    @cached_property
    def exports(self) -> Mapping[int, Export]:
        try:
            exports = RunArchive(self._directory).exports.by_agent
        except RunDirectoryError:
            return {}
        ours = self._header.initial_data
        return {agent_id: export for agent_id, export in exports.items() if export.inception.block_data == ours}

    @cached_property
    def traces(self) -> Mapping[int, Trace]:
        flights = sort_out([self._directory]).flights
        ours = (flight for flight in flights if self._header in (trace.header for trace in flight.traces.values()))
        return next(ours, Flight(None)).traces


class _OfFlight:
    """What has been sorted out already."""

    record = None

    def __init__(self, flight: Flight) -> None:
        self.exports = flight.exports
        self.traces = flight.traces


def open_record(path: Path, agent_id: int | None = None) -> Record:
    """The record in a trace, or that of an agent in a directory. Raises FieldError if there is none to play."""
    records = open_records(path, agent_id)
    if len(records) > 1:
        names = ", ".join(str(record.agent_id) for record in records)
        raise FieldError(f"{path}: whose record is to be played? Choose with --agent: {names}")
    return records[0]


def open_records(path: Path, agent_id: int | None = None) -> list[Record]:
    """All records in a trace or a directory, or that of an agent. Raises FieldError if there is none to play."""
    files = _files_in(path, agent_id) if path.is_dir() else [path]
    directory = path if path.is_dir() else _directory_of(path)
    traces = [trace for file in files if (trace := _read(file)) and not trace.problem and not trace.cut_off]
    if len(traces) < len(files):
        return _sorted_out(path, agent_id, files) or _sorted_out(path, agent_id, [path])
    if not files:
        return _sorted_out(path, agent_id, [path])
    if agent_id is not None and traces[0].header.agent_id != agent_id:
        raise FieldError(f"{files[0]}: the trace is of agent {traces[0].header.agent_id}, not of agent {agent_id}")
    run = _Run(directory) if (directory / RUN_FILE).is_file() else None
    found = []
    for file, trace in zip(files, traces, strict=True):
        named = _named(path, trace.header.agent_id if path.is_dir() else None)
        found.append(partial(Record, file, named, trace, run or _Around(trace, file.parent), []))
    return _playable(found)


def _playable(records: Iterable[Callable[[], Record]]) -> list[Record]:
    """Those that can be played; of the others it is said with the first. Raises FieldError if it is none."""
    playable, problems = [], []
    for opened in records:
        try:
            playable.append(opened())
        except FieldError as error:
            problems.append(str(error))
    if not playable:
        raise FieldError("; ".join(problems))
    playable[0].problems += problems
    return playable


def _named(path: Path, agent_id: int | None) -> str:
    return f"{path} --agent {agent_id}" if agent_id else f"{path}"


@gc_paused()
def _read(file: Path) -> Trace | None:
    return read_trace(file)


def _directory_of(file: Path) -> Path:
    """That of the run that left the file, or the one that it is in."""
    run = file.parent.parent
    return run if file.parent.name == AGENTS and (run / RUN_FILE).is_file() else file.parent


def _files_in(directory: Path, agent_id: int | None) -> list[Path]:
    """The traces of all agents, or of one, if they are where a run leaves them and nothing else there can be of these.

    Nothing if all has to be sorted out, which takes as long as reading all.
    """
    agents = agents_directory(directory)
    if (directory / RUN_FILE).is_file():
        files = [agents / f"{agent_id}{SUFFIX}"] if agent_id is not None else agents.glob(f"*{SUFFIX}")
        return sorted((file for file in files if file.is_file()), key=lambda file: (len(file.name), file.name))
    file = agents / f"{agent_id}{SUFFIX}"
    if agent_id is None or not file.is_file():
        return []
    return [file] if all(_is_of_another(path, agent_id) for path in agents.iterdir() if path != file) else []


def _is_of_another(path: Path, agent_id: int) -> bool:
    """Whether a file can be no record of the agent, by its name or its beginning."""
    if path.name.endswith((".chain.json", ".mission.json", ".log", ".store")):
        return True
    try:
        with path.open("rb") as other:
            begins = other.readline(MAX_LINE_BYTES)
            return begins[:4] in MAGICS or HEADER.validate_json(begins).agent_id != agent_id
    except (OSError, ValueError):
        return False


def _sorted_out(path: Path, agent_id: int | None, sources: Sequence[Path]) -> list[Record]:
    """The records in files of any kind and in any state; none if only a part of `path` was looked at, and has none."""
    homecoming = sort_out(sources)
    flights = [flight for flight in homecoming.flights if flight.traces]
    if path not in sources and len({agent for flight in flights for agent in flight.traces}) < len(sources):
        return []
    if not flights:
        why = f": {homecoming.left_out[0].why}" if homecoming.left_out else ""
        raise FieldError(f"{path}: nothing of it is a trace that can be played{why}; give one, or a directory of them")
    whose = sorted({agent for flight in flights for agent in flight.traces})
    if agent_id is not None and agent_id not in whose:
        raise FieldError(f"{path}: there is no trace of agent {agent_id}, but of {', '.join(map(str, whose))}")
    chosen = whose if agent_id is None else [agent_id]
    directory = path if path.is_dir() else _directory_of(path)
    run = _Run(directory) if (directory / RUN_FILE).is_file() else None
    records = []
    for agent in chosen:
        flown = [flight for flight in flights if agent in flight.traces]
        trace, file = flown[0].traces[agent], flown[0].sources[agent][0]
        problems = [*_remarks(homecoming, agent)]
        if len(flown) > 1:
            problems.append(f"{path}: agent {agent} has flown {len(flown)} flights; that with the most files is played")
        beside = run or (_OfFlight(flown[0]) if path.is_dir() and path in sources else _Around(trace, file.parent))
        named = _named(path, agent if path.is_dir() or len(whose) > 1 else None)
        records.append(partial(Record, file, named, trace, beside, problems))
    return _playable(records)


def _remarks(homecoming: Homecoming, agent_id: int) -> Iterator[str]:
    """What is to say of all files but those of other agents."""
    of_others = {
        file
        for flight in homecoming.flights
        for agent, sources in flight.sources.items()
        if agent != agent_id
        for file in sources
    }
    for remark in (*homecoming.left_out, *homecoming.remarks):
        if remark.path not in of_others:
            yield remark.sentence
