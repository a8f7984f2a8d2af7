"""Find the records at a path: a trace, the directory of a run, or a directory with any files.

In the directory of a run, the files have known names, and only the needed files are read. In every other directory, all
files are read first.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path

from harness.archive.archive import RunArchive
from harness.archive.exports import RUN_FILE, Export, agents_directory
from harness.archive.packets.pcap import MAGICS
from harness.archive.run_record import JudgedRecord
from harness.archive.trace_files import SUFFIX, trace_file, trace_files
from harness.archive.traces import HEADER, MAX_LINE_BYTES, Trace, read_trace
from harness.checker.evidence import check_variant
from harness.errors import CaptureError, FieldError, RunDirectoryError
from harness.field._vehicle_captures import AgentCapture, read_capture
from harness.field.ingest import Flight, IngestResult, ingest_files
from harness.field.replay._agent_record import RecordedTrace
from harness.gc_pause import gc_paused
from ucp.plain_file import open_plain_file

AGENTS = "agents"
"""Name of the directory with the agents' files in a run directory."""


class _RunRecords:
    """The records in the directory of a run."""

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

    def capture(self, agent_id: int) -> None:
        """Return None. Captures are not needed for a run, because counters in its record show whether an agent ignored
        messages.
        """


class _DirectoryRecords:
    """The records in the directory of a trace that belong to the same mission as the trace."""

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
        own_flights = self._header.initial_data
        return {agent_id: export for agent_id, export in exports.items() if export.inception.block_data == own_flights}

    @cached_property
    def _flight(self) -> Flight:
        flights = ingest_files([self._directory]).flights
        own_flights = (
            flight for flight in flights if self._header in (trace.header for trace in flight.traces.values())
        )
        return next(own_flights, Flight(None))

    @property
    def traces(self) -> Mapping[int, Trace]:
        return self._flight.traces

    def capture(self, agent_id: int) -> AgentCapture | None:
        return _capture(self._flight, agent_id)


class IngestedRecords:
    """The records of a flight that `ingest_files` has already read."""

    record = None

    def __init__(self, flight: Flight) -> None:
        self.exports = flight.exports
        self.traces = flight.traces
        self._flight = flight

    def capture(self, agent_id: int) -> AgentCapture | None:
        return _capture(self._flight, agent_id)


def _capture(flight: Flight, agent_id: int) -> AgentCapture | None:
    path = flight.captures.get(agent_id)
    try:
        return None if path is None else read_capture(path, agent_id, flight.epoch_us)
    except CaptureError:
        return None


def open_record(path: Path, agent_id: int | None = None) -> RecordedTrace:
    """Return the record in a trace file, or the record of an agent in a directory. Raises FieldError if no record can
    be played.
    """
    records = open_records(path, agent_id)
    if len(records) > 1:
        names = ", ".join(str(record.agent_id) for record in records)
        raise FieldError(f"{path}: several records: choose one with --agent: {names}")
    return records[0]


def open_records(path: Path, agent_id: int | None = None) -> list[RecordedTrace]:
    """Return all records in a trace file or a directory. If `agent_id` is given, return only the records of this agent.
    Raises FieldError if no record can be played.
    """
    files = _files_in(path, agent_id) if path.is_dir() else [path]
    directory = path if path.is_dir() else _directory_of(path)
    traces = [trace for file in files if (trace := _read(file)) and not trace.problem and not trace.cut_off]
    if len(traces) < len(files):
        return _open_ingested(path, agent_id, files) or _open_ingested(path, agent_id, [path])
    if not files:
        return _open_ingested(path, agent_id, [path])
    if agent_id is not None and traces[0].header.agent_id != agent_id:
        raise FieldError(f"{files[0]}: the trace belongs to agent {traces[0].header.agent_id}, not to agent {agent_id}")
    run_records = _RunRecords(directory) if (directory / RUN_FILE).is_file() else None
    records_to_open = []
    for file, trace in zip(files, traces, strict=True):
        argument = _command_argument(path, trace.header.agent_id if path.is_dir() else None)
        records_to_open.append(
            partial(RecordedTrace, file, argument, trace, run_records or _DirectoryRecords(trace, file.parent), [])
        )
    return _playable(records_to_open)


def _playable(records: Iterable[Callable[[], RecordedTrace]]) -> list[RecordedTrace]:
    """Return the records that can be played.

    The reasons why other records cannot be played are added to the first record. Raises FieldError if no record can be
    played.
    """
    playable, problems = [], []
    for open_record_of in records:
        try:
            playable.append(open_record_of())
        except FieldError as error:
            problems.append(str(error))
    if not playable:
        raise FieldError("; ".join(problems))
    playable[0].problems += problems
    return playable


def _command_argument(path: Path, agent_id: int | None) -> str:
    return f"{path} --agent {agent_id}" if agent_id else f"{path}"


@gc_paused()
def _read(file: Path) -> Trace | None:
    return read_trace(file)


def _directory_of(file: Path) -> Path:
    """Return the directory of the run to which the file belongs. If the file belongs to no run, return the directory of
    the file.
    """
    run_records = file.parent.parent
    return run_records if file.parent.name == AGENTS and (run_records / RUN_FILE).is_file() else file.parent


def _files_in(directory: Path, agent_id: int | None) -> list[Path]:
    """Return the traces of all agents or of one agent, if the file names identify these traces without doubt. Otherwise
    return an empty result, and the caller must read all files, which takes longer.
    """
    agents = agents_directory(directory)
    if (directory / RUN_FILE).is_file():
        files = [trace_file(agents, agent_id)] if agent_id is not None else trace_files(agents)
        return [file for file in files if file.is_file()]
    file = agents / f"{agent_id}{SUFFIX}"
    if agent_id is None or not file.is_file():
        return []
    return [file] if all(_belongs_to_another(path, agent_id) for path in agents.iterdir() if path != file) else []


def _belongs_to_another(path: Path, agent_id: int) -> bool:
    """Return true if the name or the first line of a file shows that it contains no record of the agent."""
    if path.name.endswith((".chain.json", ".mission.json", ".log", ".store")):
        return True
    try:
        with open_plain_file(path) as other:
            beginning = other.readline(MAX_LINE_BYTES)
            return beginning[:4] in MAGICS or HEADER.validate_json(beginning).agent_id != agent_id
    except (OSError, ValueError):
        return False


def _open_ingested(path: Path, agent_id: int | None, sources: Sequence[Path]) -> list[RecordedTrace]:
    """Return the records in files of any kind. Return an empty list if only some of the files were read and they
    contain too few records.
    """
    ingested = ingest_files(sources)
    flights = [flight for flight in ingested.flights if flight.traces]
    if path not in sources and len({agent for flight in flights for agent in flight.traces}) < len(sources):
        return []
    if not flights:
        why = f": {ingested.left_out[0].why}" if ingested.left_out else ""
        raise FieldError(f"{path}: no trace here can be played{why}; give a trace, or a directory of traces")
    recorded_agents = sorted({agent for flight in flights for agent in flight.traces})
    if agent_id is not None and agent_id not in recorded_agents:
        raise FieldError(f"{path}: no trace of agent {agent_id}; choose one of {', '.join(map(str, recorded_agents))}")
    chosen = recorded_agents if agent_id is None else [agent_id]
    directory = path if path.is_dir() else _directory_of(path)
    run_records = _RunRecords(directory) if (directory / RUN_FILE).is_file() else None
    records = []
    for agent in chosen:
        agent_flights = [flight for flight in flights if agent in flight.traces]
        trace, file = agent_flights[0].traces[agent], agent_flights[0].sources[agent][0]
        problems = [*_remarks(ingested, agent)]
        if len(agent_flights) > 1:
            problems.append(
                f"{path}: agent {agent} has {len(agent_flights)} flights; the one with the most files is played"
            )
        flight_records = run_records or (
            IngestedRecords(agent_flights[0])
            if path.is_dir() and path in sources
            else _DirectoryRecords(trace, file.parent)
        )
        argument = _command_argument(path, agent if path.is_dir() or len(recorded_agents) > 1 else None)
        records.append(partial(RecordedTrace, file, argument, trace, flight_records, problems))
    return _playable(records)


def _remarks(ingested: IngestResult, agent_id: int) -> Iterator[str]:
    """Yield the remarks on all files, except on files of other agents."""
    of_others = {
        file
        for flight in ingested.flights
        for agent, sources in flight.sources.items()
        if agent != agent_id
        for file in sources
    }
    for remark in (*ingested.left_out, *ingested.remarks):
        if remark.path not in of_others:
            yield remark.sentence
