"""Finds the records in what a user names: a trace, the directory of a run, or one of files in any state.

What a run left has its place there, and nothing else is read; all else is sorted out first.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path

from harness.archive.archive import RunArchive
from harness.archive.exports import RUN_FILE, Export, agents_directory
from harness.archive.packets.pcap import MAGICS
from harness.archive.run_record import JudgedRecord
from harness.archive.traces import HEADER, MAX_LINE_BYTES, SUFFIX, Trace, read_trace
from harness.checker.evidence import check_variant
from harness.errors import FieldError, RunDirectoryError
from harness.field.ingest import Flight, Homecoming, sort_out
from harness.field.replay._agent_record import Record
from harness.gc_pause import gc_paused

AGENTS = "agents"
"""Directory in a run's with what the agents left."""


class _Run:
    """What the directory of a run holds."""

    def __init__(self, directory: Path) -> None:
        self._archive = RunArchive(directory)
        check_variant(self._archive)

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
        raise FieldError(f"{path}: several records: choose one with --agent: {names}")
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
        raise FieldError(f"{files[0]}: the trace belongs to agent {traces[0].header.agent_id}, not to agent {agent_id}")
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
        raise FieldError(f"{path}: no trace here can be played{why}; give a trace, or a directory of traces")
    whose = sorted({agent for flight in flights for agent in flight.traces})
    if agent_id is not None and agent_id not in whose:
        raise FieldError(f"{path}: no trace of agent {agent_id}; choose one of {', '.join(map(str, whose))}")
    chosen = whose if agent_id is None else [agent_id]
    directory = path if path.is_dir() else _directory_of(path)
    run = _Run(directory) if (directory / RUN_FILE).is_file() else None
    records = []
    for agent in chosen:
        flown = [flight for flight in flights if agent in flight.traces]
        trace, file = flown[0].traces[agent], flown[0].sources[agent][0]
        problems = [*_remarks(homecoming, agent)]
        if len(flown) > 1:
            problems.append(f"{path}: agent {agent} has {len(flown)} flights; the one with the most files is played")
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
