"""Import records of any format. Adapters read the records, and this module writes them into one directory as files of
the harness.

The import uses only recorded data. If the handler runs of an agent were recorded, the import writes a trace. If only
the datagrams of an agent were recorded, it writes a capture.
"""

import json
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field
from rich.markup import escape

from harness.archive.bounded_file import BoundedFile
from harness.archive.directory import PUBLIC_KEYS_FILE, claim
from harness.archive.exports import SUFFIX as EXPORT_SUFFIX
from harness.archive.exports import Export
from harness.archive.packets.capture_files import DIRECTORY as CAPTURES
from harness.archive.packets.pcap import PCAPNG_MAGIC
from harness.archive.trace_files import SUFFIX as TRACE_SUFFIX
from harness.archive.traces import Trace, TraceGap, gap_line
from harness.checker.records.contradiction import ROUNDED_S, mission_s
from harness.errors import MachineError, RunDirectoryError
from harness.field.adapters.adapter import (
    BEGINNING_BYTES,
    Adapter,
    ChainExport,
    Datagram,
    Observation,
    TraceLine,
    Unusable,
)
from harness.field.depot.mission_files import SUFFIX as MISSION_SUFFIX
from harness.field.ingest._file_owners import files_of, summarise_capture
from harness.field.ingest._ingest import FileRemark, Flight, IngestResult, UnusedPart
from harness.field.ingest._sorting import SUFFIX as LOGGED_SUFFIX
from harness.field.ingest._sorting import EventLine, RecordSorter
from harness.field.ingest._trace_incarnations import TraceReader
from harness.gc_pause import gc_paused
from harness.scenario.strict_model import VehicleKey
from netem.frames import udp_broadcast
from netem.pcapng import PcapngFile, header
from ucp.block import MAX_AGENT_ID
from ucp.events import LoggableEvent
from ucp.messages import PORT, MalformedDatagramError, decode
from ucp.plain_file import open_plain_file

FILE = "import.json"


class ImportedAgent(BaseModel):
    """The imported files of one agent. The file names are relative to the directory of the flight. `trace_from` lists
    the source files of the trace. `handler_runs`, `lives` (incarnations), `gaps` and `clock_jumps` are counts of these
    items in the trace.
    """

    trace: str | None = None
    handler_runs: int = 0
    lives: int = 0
    gaps: int = 0
    clock_jumps: int = 0
    trace_from: list[str] = []
    export: str | None = None
    capture: str | None = None
    events: str | None = None
    flight_logs: list[str] = []


class ImportedFlight(BaseModel):
    """One imported flight. `directory` is relative to the directory of the import, and `initial_data` is in base64."""

    directory: str
    initial_data: str | None
    epoch_us: int | None
    roster: list[int]
    agents: dict[VehicleKey, ImportedAgent]
    more_captures: list[str] = []
    mission_files: list[str] = []


class ImportRemark(BaseModel):
    """A remark on a source file or on a part of it. `counts` names the unit in which positions in the file are counted,
    such as lines. `why` is the text of the remark, which completes a sentence.
    """

    path: str
    line: int | None
    counts: str
    why: str

    @property
    def sentence(self) -> str:
        return FileRemark(Path(self.path), self.why, self.line, self.counts).sentence


class ImportRecord(BaseModel):
    """The result of an import: the flights (the largest is first), the omitted files, and remarks on the imported
    files.
    """

    model_config = ConfigDict(extra="ignore")

    schema_: Annotated[Literal["ucp-import/1"], Field(alias="schema")] = "ucp-import/1"
    sources: list[str]
    flights: list[ImportedFlight]
    left_out: list[ImportRemark]
    remarks: list[ImportRemark]

    def to_json(self) -> dict[str, object]:
        return self.model_dump(mode="json", by_alias=True)


AGENTS = "agents"
FLIGHT_LOGS = "flight-logs"
INCOMPLETE_LINE = '{"lost_lines":'
"""The beginning of a trace line that reports lost lines. If a trace ends within a line, the import writes only this
beginning as the last line, so that the imported trace also ends within a line.
"""
_COPY_BYTES = 1024 * 1024


def write_import(result: IngestResult, sources: Sequence[Path], out: Path) -> ImportRecord:
    """Write the largest flight to `out`, and every other flight to a directory in `out`. Return the record of the
    import. Raises RunDirectoryError.
    """
    claim(out)
    try:
        flights = []
        for number, flight in enumerate(result.flights, 1):
            directory = out if number == 1 else out / f"flight-{number}"
            flights.append(_write(flight, directory, "." if number == 1 else directory.name))
        record = ImportRecord(
            sources=[str(source) for source in sources],
            flights=flights,
            left_out=[_remark(left_out) for left_out in result.left_out],
            remarks=[_remark(remark) for remark in result.remarks],
        )
        text = json.dumps(record.to_json(), indent=1) + "\n"
        (out / FILE).write_text(text, encoding="utf-8")
    except OSError as error:
        raise RunDirectoryError(f"{out} cannot be written: {error.strerror}; choose another -o") from None
    return record


def _remark(remark: FileRemark) -> ImportRemark:
    return ImportRemark(path=_printable(remark.path), line=remark.line, counts=remark.counts, why=remark.why)


def _printable(path: Path) -> str:
    return str(path).encode("utf-8", "replace").decode()


def _write(flight: Flight, directory: Path, name: str) -> ImportedFlight:
    agents = {agent_id: ImportedAgent() for agent_id in flight.agents}
    (directory / AGENTS).mkdir(parents=True)
    for agent_id, trace in flight.traces.items():
        agent = agents[agent_id]
        agent.trace = f"{AGENTS}/{agent_id}{TRACE_SUFFIX}"
        with (directory / agent.trace).open("w", encoding="utf-8", errors="replace") as file:
            file.writelines(_trace_lines(trace, survived_trace=_survived_trace(trace, flight.exports.get(agent_id))))
        agent.handler_runs, agent.lives = len(trace.runs), len(trace.starts) + 1
        agent.gaps, agent.clock_jumps = len(trace.gaps), len(trace.jumps)
        agent.trace_from = [_printable(path) for path in flight.sources.get(agent_id, ())]
    for agent_id, export in flight.exports.items():
        agents[agent_id].export = path = f"{AGENTS}/{agent_id}{EXPORT_SUFFIX}"
        text = json.dumps(export.model_dump(mode="json", by_alias=True), indent=1)
        (directory / path).write_text(text + "\n", encoding="utf-8")
    for agent_id, events in flight.logged.items():
        agents[agent_id].events = path = f"{AGENTS}/{agent_id}{LOGGED_SUFFIX}"
        with (directory / path).open("w", encoding="utf-8") as file:
            file.writelines(EventLine.of(agent_id, event).to_line() for event in events)
    if flight.captures or flight.more_captures:
        (directory / CAPTURES).mkdir()
    for agent_id, capture in flight.captures.items():
        agents[agent_id].capture = _copy_capture(capture, directory, str(agent_id))
    for number, log in enumerate(dict.fromkeys(match.log.path for match in flight.flight_logs), 1):
        copy = _copy_flight_log(log, directory, number)
        for match in flight.flight_logs:
            if match.log.path == log and match.agent_id is not None:
                agents.setdefault(match.agent_id, ImportedAgent()).flight_logs.append(copy)
    for agent_id, mission_file in flight.mission_files.items():
        _copy_file(mission_file, directory / AGENTS / f"{agent_id}{MISSION_SUFFIX}")
    if flight.public_keys is not None:
        from ucp.secure.bundle import write_public

        write_public(directory / PUBLIC_KEYS_FILE, flight.public_keys)
    return ImportedFlight(
        directory=name,
        initial_data=next((trace.header.initial_data for trace in flight.traces.values()), None)
        or next((export.inception.block_data for export in flight.exports.values()), None),
        epoch_us=flight.epoch_us,
        roster=[*flight.roster],
        agents=agents,
        more_captures=[
            _copy_capture(capture, directory, f"more-{number}")
            for number, capture in enumerate(flight.more_captures, 1)
        ],
        mission_files=[f"{AGENTS}/{agent_id}{MISSION_SUFFIX}" for agent_id in flight.mission_files],
    )


def _survived_trace(trace: Trace, export: Export | None) -> bool:
    """Return true if the agent was still running after the end of its trace. This is so if its export was written later
    than the last line of its trace.
    """
    if export is None:
        return False
    at_s = mission_s(export.exported_at_us, trace.header)
    return at_s is None or not trace.runs or at_s > trace.runs[-1].t + ROUNDED_S


def _trace_lines(trace: Trace, *, survived_trace: bool) -> Iterator[str]:
    """Yield the lines of a trace. Each gap becomes one line, which reports the lost lines.

    If a trace ends within a line, the agent was probably killed while it wrote this line, so the last yielded line is
    incomplete, too. If the agent was still running after this line, a line about a gap replaces the incomplete line.
    """
    for entry in trace.entries():
        yield gap_line(entry) if isinstance(entry, TraceGap) else entry.to_line()
    if trace.cut_off:
        yield gap_line(TraceGap(len(trace.runs), 1, 0)) if survived_trace else INCOMPLETE_LINE


def _copy_capture(capture: Path, directory: Path, name: str) -> str:
    with BoundedFile(capture) as file:
        suffix = "pcapng" if file.peek(4)[:4] == PCAPNG_MAGIC else "pcap"
        path = f"{CAPTURES}/{name}.{suffix}"
        with (directory / path).open("wb") as copy:
            while part := file.read(_COPY_BYTES):
                copy.write(part)
    return path


def _copy_flight_log(log: Path, directory: Path, number: int) -> str:
    (directory / FLIGHT_LOGS).mkdir(exist_ok=True)
    path = f"{FLIGHT_LOGS}/{number}-{log.name}"
    _copy_file(log, directory / path)
    return path


def _copy_file(source: Path, path: Path) -> None:
    with open_plain_file(source) as file, path.open("wb") as copy:
        shutil.copyfileobj(file, copy, _COPY_BYTES)


MAX_AGENTS = 1000
LAST_NS = 2**63 - 1
MAX_REJECTED = 200_000
"""Maximum number of unusable parts of a source. A source with more of them probably contains no records."""
_MAX_LISTED = 10


@gc_paused()
def import_records(
    sources: Sequence[Path],
    adapters: Iterable[Adapter],
    out: Path,
    report_progress: Callable[[str], object] = str,
    *,
    by_content: bool = True,
) -> ImportRecord:
    """Read `sources` with `adapters`, and write all flights in them to `out`, which is an empty or new directory.

    A file that no adapter recognises is read as a file of the harness. If `by_content` is false, the first adapter
    reads all files. `report_progress` receives a text at each step. Raises FieldError if a source does not exist or
    nothing is usable, and RunDirectoryError if `out` cannot be written.
    """
    left_out: list[UnusedPart] = []
    adapters = [*adapters]
    sorter = RecordSorter(left_out)
    streams: dict[Path, _RecordingReader] = {}
    with TemporaryDirectory(prefix="ucp-import-") as scratch:
        for path in files_of(sources, left_out):
            report_progress(f"reading {escape(path.name)}")
            adapter = _adapter_for(path, adapters) if by_content else adapters[0]
            if adapter is None:
                sorter.add_file(path)
                continue
            recording = adapter.part_of(path)
            if recording not in streams:
                directory = Path(scratch) / str(len(streams))
                directory.mkdir()
                streams[recording] = _RecordingReader(recording, adapter, directory, left_out)
            streams[recording].read_file(path, sorter)
        for stream in streams.values():
            stream.end(sorter)
        report_progress("grouping the records by flight")
        result = sorter.result()
        result.largest()
        report_progress("writing")
        return write_import(result, sources, out)


def _adapter_for(path: Path, adapters: Iterable[Adapter]) -> Adapter | None:
    try:
        with BoundedFile(path) as file:
            beginning = file.peek(BEGINNING_BYTES)[:BEGINNING_BYTES]
    except OSError:
        return None  # The reader of the file reports the error.
    return next((adapter for adapter in adapters if adapter.recognises(path, beginning)), None)


class _RecordingReader:
    """A reader of one recording, which may consist of several files. The reader sorts the observations of the adapter
    by their types.
    """

    def __init__(self, path: Path, adapter: Adapter, scratch: Path, left_out: list[UnusedPart]) -> None:
        self._path = path
        self._adapter = adapter
        self._scratch = scratch
        self._left_out = left_out
        self._readers: dict[int, TraceReader] = {}
        self._captures: dict[int, PcapngFile] = {}
        self._line_counts: Counter[int] = Counter()
        self._earlier_places = 0  # number of places in the earlier files
        self._has_records = False
        self._listed: list[UnusedPart] = []
        self._rejected = 0

    def read_file(self, path: Path, sorter: RecordSorter) -> None:
        """Read the next file of the recording."""
        last = 0
        try:
            for observation in self._adapter.observations(path):
                last = max(last, observation.where or 0)
                if self._rejected > MAX_REJECTED or any(reader.gave_up for reader in self._readers.values()):
                    self._reject(f"there are too many {self._adapter.counts}s without use: the rest is not read", None)
                    break
                self._add_observation(
                    observation, self._earlier_places + observation.where if observation.where else None, sorter
                )
        except MachineError:
            raise
        except Exception as error:  # A user's adapter may raise anything for any input.
            what = error.strerror if isinstance(error, OSError) else f"{type(error).__name__}: {str(error)[:200]}"
            after = f" after {self._adapter.counts} {last}" if last else ""
            self._reject(f"reading failed{after}: {what}", None)
            for reader in self._readers.values():
                reader.add_unknown_gap()
        self._earlier_places += last

    def _add_observation(self, observation: Observation, where: int | None, sorter: RecordSorter) -> None:
        if isinstance(observation, Unusable):
            self._reject(observation.why, where)
            for agent_id, reader in self._readers.items() if observation.of_a_trace else ():
                if observation.agent_id in (None, agent_id):
                    reader.add_unknown_gap()
            return
        self._has_records = True
        if isinstance(observation, ChainExport):
            sorter.add_exports(self._path, _text(observation.text), where, self._adapter.counts)
        elif not 1 <= observation.agent_id <= MAX_AGENT_ID:
            self._reject(f"agent {str(observation.agent_id)[:20]} is not an agent ID: use 1 to {MAX_AGENT_ID}", where)
        elif isinstance(observation, TraceLine):
            self._add_trace_line(observation, where)
        elif not 0 <= observation.time_ns <= LAST_NS:
            self._reject("its time cannot be", where)
        elif isinstance(observation, Datagram):
            self._add_datagram(observation, where)
        else:
            event = LoggableEvent(observation.time_ns // 1000, observation.event_id, observation.data)
            sorter.logged.append((self._path, observation.agent_id, event))

    def _add_trace_line(self, line: TraceLine, where: int | None) -> None:
        reader = self._readers.get(line.agent_id)
        if reader is None:
            reader = self._readers[line.agent_id] = TraceReader(self._path, line.agent_id, self._adapter.counts)
        self._line_counts[line.agent_id] += 1
        text = line.text.encode("utf-8", "replace") if isinstance(line.text, str) else line.text
        reader.add_line(where or self._line_counts[line.agent_id], text)

    def _add_datagram(self, datagram: Datagram, where: int | None) -> None:
        try:
            sender = decode(datagram.data)[0]
        except MalformedDatagramError as malformed:
            self._reject(f"it is not a UCP datagram ({malformed.reason})", where)
            return
        capture = self._captures.get(datagram.agent_id)
        if capture is None:
            if len(self._captures) == MAX_AGENTS:
                self._reject(f"it is of more than {MAX_AGENTS} agents", where)
                return
            path = self._scratch / f"{datagram.agent_id}.pcapng"
            path.write_bytes(header(f"vehicle {datagram.agent_id}", f"from {self._path.name}"))
            capture = self._captures[datagram.agent_id] = PcapngFile(path)
        capture.packet(datagram.time_ns, udp_broadcast(sender, PORT, datagram.data), outbound=datagram.sent)

    def end(self, sorter: RecordSorter) -> None:
        """Pass the records to the sorter. Call this method after the last file was read."""
        for agent_id, capture in self._captures.items():
            capture.close()
            seen = summarise_capture(self._scratch / f"{agent_id}.pcapng", self._left_out)
            sorter.captures += [replace(seen, source=self._path)] if seen else []
        for agent_id, reader in self._readers.items():
            incarnations = reader.finish(self._left_out)
            sorter.incarnations += incarnations
            if not incarnations:
                self._reject(
                    f"its {self._line_counts[agent_id]} line(s) of the trace of agent {agent_id} hold no handler run",
                    None,
                )
        if not self._has_records and not self._rejected:
            self._reject("it contains no records of agents", None)
        self._left_out += self._listed
        if rest := self._rejected - len(self._listed):
            self._left_out.append(UnusedPart(self._path, f"{rest} more places in it hold no usable record"))

    def _reject(self, why: str, where: int | None) -> None:
        self._rejected += 1
        if len(self._listed) < _MAX_LISTED:
            self._listed.append(UnusedPart(self._path, why, where, self._adapter.counts))


def _text(text: str | bytes) -> str:
    return text if isinstance(text, str) else text.decode("utf-8", "replace")
