"""Import records of any kind into one directory: read them with adapters, write the harness's own files.

What an agent did not record is not made up: who left handler runs has a trace, who was only heard has a capture.
"""

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field
from rich.markup import escape

from harness.archive.bounded_file import BoundedFile
from harness.archive.directory import PUBLIC_KEYS_FILE, claim
from harness.archive.exports import SUFFIX as EXPORT_SUFFIX
from harness.archive.exports import Export
from harness.archive.packets.capture_files import DIRECTORY as CAPTURES
from harness.archive.packets.pcap import PCAPNG_MAGIC
from harness.archive.traces import SUFFIX as TRACE_SUFFIX
from harness.archive.traces import Gap, Trace, gap_line
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
from harness.field.ingest._file_owners import glance
from harness.field.ingest._file_search import files_of
from harness.field.ingest._ingest import Flight, Homecoming, LeftOut, Remark
from harness.field.ingest._logged_events import SUFFIX as LOGGED_SUFFIX
from harness.field.ingest._logged_events import EventLine
from harness.field.ingest._sorting import Sorter
from harness.field.ingest._trace_incarnations import TraceReader
from harness.gc_pause import gc_paused
from harness.scenario.strict_model import VehicleKey
from netem.frames import udp_broadcast
from netem.pcapng import PcapngFile, header
from ucp.block import MAX_AGENT_ID
from ucp.events import LoggableEvent
from ucp.messages import PORT, MalformedDatagramError, decode

FILE = "import.json"


class ImportedAgent(BaseModel):
    """The imported files of one agent, relative to the directory of the flight.

    `trace_from` has the sources of the trace. `handler_runs`, `lives`, `gaps` and `clock_jumps` are counts in the
    trace.
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


class ImportedFlight(BaseModel):
    """One imported flight. `directory` is relative to the directory of the import. `initial_data` is in base64."""

    directory: str
    initial_data: str | None
    epoch_us: int | None
    roster: list[int]
    agents: dict[VehicleKey, ImportedAgent]
    more_captures: list[str] = []


class ImportRemark(BaseModel):
    """A remark on a source file, or on one of its lines, rows or messages: `counts` names the unit. `why` ends a
    sentence."""

    path: str
    line: int | None
    counts: str
    why: str

    @property
    def sentence(self) -> str:
        return Remark(Path(self.path), self.why, self.line, self.counts).sentence


class ImportRecord(BaseModel):
    """The result of an import: the flights, largest first, the files that were left out, and remarks on the others."""

    model_config = ConfigDict(extra="ignore")

    schema_: Annotated[Literal["ucp-import/1"], Field(alias="schema")] = "ucp-import/1"
    sources: list[str]
    flights: list[ImportedFlight]
    left_out: list[ImportRemark]
    remarks: list[ImportRemark]

    def to_json(self) -> dict[str, Any]:
        return self.model_dump(mode="json", by_alias=True)


AGENTS = "agents"
CUT_OFF = '{"lost_lines":'
"""Half a line, as a trace ends that was cut off."""
_COPIED_AT_ONCE = 1024 * 1024


def write_import(homecoming: Homecoming, sources: Sequence[Path], out: Path) -> ImportRecord:
    """The largest flight into `out`, further ones into directories in it. Raises RunDirectoryError."""
    claim(out)
    try:
        flights = []
        for number, flight in enumerate(homecoming.flights, 1):
            directory = out if number == 1 else out / f"flight-{number}"
            flights.append(_write(flight, directory, "." if number == 1 else directory.name))
        record = ImportRecord(
            sources=[str(source) for source in sources],
            flights=flights,
            left_out=[_remark(left_out) for left_out in homecoming.left_out],
            remarks=[_remark(remark) for remark in homecoming.remarks],
        )
        text = json.dumps(record.to_json(), indent=1) + "\n"
        (out / FILE).write_text(text, encoding="utf-8")
    except OSError as error:
        raise RunDirectoryError(f"{out} cannot be written: {error.strerror}; choose another -o") from None
    return record


def _remark(remark: Remark) -> ImportRemark:
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
            file.writelines(_lines(trace, lived_on=_lived_on(trace, flight.exports.get(agent_id))))
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
        agents[agent_id].capture = _copied(capture, directory, str(agent_id))
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
            _copied(capture, directory, f"more-{number}") for number, capture in enumerate(flight.more_captures, 1)
        ],
    )


def _lived_on(trace: Trace, export: Export | None) -> bool:
    """Whether the agent was there after the end of its trace: it has left an export since."""
    if export is None:
        return False
    at_s = mission_s(export.exported_at_us, trace.header)
    return at_s is None or not trace.runs or at_s > trace.runs[-1].t + ROUNDED_S


def _lines(trace: Trace, *, lived_on: bool) -> Iterator[str]:
    """The trace as it is written: what is lost is said where it was.

    An agent whose trace ends in half a line may have been killed over it, unless it `lived_on` and left an export.
    """
    for entry in trace.entries():
        yield gap_line(entry) if isinstance(entry, Gap) else entry.to_line()
    if trace.cut_off:
        yield gap_line(Gap(len(trace.runs), 1, 0)) if lived_on else CUT_OFF


def _copied(capture: Path, directory: Path, name: str) -> str:
    with BoundedFile(capture) as file:
        suffix = "pcapng" if file.peek(4)[:4] == PCAPNG_MAGIC else "pcap"
        path = f"{CAPTURES}/{name}.{suffix}"
        with (directory / path).open("wb") as copy:
            while part := file.read(_COPIED_AT_ONCE):
                copy.write(part)
    return path


MAX_AGENTS = 1000
LAST_NS = 2**63 - 1
MAX_DROPPED = 200_000
"""Of one file, places that say nothing usable: more are in none that is what it is taken for."""
_PLACES_TOLD = 10


@gc_paused()
def bring_in(
    sources: Sequence[Path],
    adapters: Iterable[Adapter],
    out: Path,
    tell: Callable[[str], object] = str,
    *,
    by_content: bool = True,
) -> ImportRecord:
    """Read `sources` and write what is in them to `out`, which must be empty or not be.

    `tell` is told what is going on. Whatever no adapter recognises is taken for one of the house's own formats; not
    `by_content`, all sources are for the first adapter. Raises FieldError if nothing of it can be used, or a source
    does not exist, and RunDirectoryError if `out` cannot be written.
    """
    left_out: list[LeftOut] = []
    adapters = [*adapters]
    sorter = Sorter(left_out)
    streams: dict[Path, _Stream] = {}
    with TemporaryDirectory(prefix="ucp-import-") as scratch:
        for path in files_of(sources, left_out):
            tell(f"reading {escape(path.name)}")
            adapter = _adapter_for(path, adapters) if by_content else adapters[0]
            if adapter is None:
                sorter.take(path)
                continue
            whole = adapter.part_of(path)
            if whole not in streams:
                directory = Path(scratch) / str(len(streams))
                directory.mkdir()
                streams[whole] = _Stream(whole, adapter, directory, left_out)
            streams[whole].take(path, sorter)
        for stream in streams.values():
            stream.end(sorter)
        tell("grouping the records by flight")
        homecoming = sorter.sorted_out()
        homecoming.largest()
        tell("writing")
        return write_import(homecoming, sources, out)


def _adapter_for(path: Path, adapters: Iterable[Adapter]) -> Adapter | None:
    try:
        with BoundedFile(path) as file:
            beginning = file.peek(BEGINNING_BYTES)[:BEGINNING_BYTES]
    except OSError:
        return None  # whoever reads it will say so
    return next((adapter for adapter in adapters if adapter.recognises(path, beginning)), None)


class _Stream:
    """What an adapter says of a file, or of the files of one recording, on its way to where it belongs."""

    def __init__(self, path: Path, adapter: Adapter, scratch: Path, left_out: list[LeftOut]) -> None:
        self._path = path
        self._adapter = adapter
        self._scratch = scratch
        self._left_out = left_out
        self._readers: dict[int, TraceReader] = {}
        self._captures: dict[int, PcapngFile] = {}
        self._lines: Counter[int] = Counter()
        self._before = 0  # places in the files before this one
        self._said = False
        self._unusable: list[LeftOut] = []
        self._dropped = 0

    def take(self, path: Path, sorter: Sorter) -> None:
        """The next file."""
        last = 0
        try:
            for observation in self._adapter.observations(path):
                last = max(last, observation.where or 0)
                if self._dropped > MAX_DROPPED or any(reader.hopeless for reader in self._readers.values()):
                    self._drop(f"there are too many {self._adapter.counts}s without use: the rest is not read", None)
                    break
                self._take(observation, self._before + observation.where if observation.where else None, sorter)
        except MachineError:
            raise
        except Exception as error:  # an adapter is anybody's code, and what it reads anybody's file
            what = error.strerror if isinstance(error, OSError) else f"{type(error).__name__}: {str(error)[:200]}"
            after = f" after {self._adapter.counts} {last}" if last else ""
            self._drop(f"reading failed{after}: {what}", None)
            for reader in self._readers.values():
                reader.lose_unseen()
        self._before += last

    def _take(self, observation: Observation, where: int | None, sorter: Sorter) -> None:
        if isinstance(observation, Unusable):
            self._drop(observation.why, where)
            for agent_id, reader in self._readers.items() if observation.of_a_trace else ():
                if observation.agent_id in (None, agent_id):
                    reader.lose_unseen()
            return
        self._said = True
        if isinstance(observation, ChainExport):
            sorter.take_exports(self._path, _text(observation.text), where, self._adapter.counts)
        elif not 1 <= observation.agent_id <= MAX_AGENT_ID:
            self._drop(f"agent {str(observation.agent_id)[:20]} is not an agent ID: use 1 to {MAX_AGENT_ID}", where)
        elif isinstance(observation, TraceLine):
            self._take_line(observation, where)
        elif not 0 <= observation.time_ns <= LAST_NS:
            self._drop("its time cannot be", where)
        elif isinstance(observation, Datagram):
            self._take_datagram(observation, where)
        else:
            event = LoggableEvent(observation.time_ns // 1000, observation.event_id, observation.data)
            sorter.logged.append((self._path, observation.agent_id, event))

    def _take_line(self, line: TraceLine, where: int | None) -> None:
        reader = self._readers.get(line.agent_id)
        if reader is None:
            reader = self._readers[line.agent_id] = TraceReader(self._path, line.agent_id, self._adapter.counts)
        self._lines[line.agent_id] += 1
        text = line.text.encode("utf-8", "replace") if isinstance(line.text, str) else line.text
        reader.take(where or self._lines[line.agent_id], text)

    def _take_datagram(self, datagram: Datagram, where: int | None) -> None:
        try:
            sender = decode(datagram.data)[0]
        except MalformedDatagramError as malformed:
            self._drop(f"it is not a UCP datagram ({malformed.reason})", where)
            return
        capture = self._captures.get(datagram.agent_id)
        if capture is None:
            if len(self._captures) == MAX_AGENTS:
                self._drop(f"it is of more than {MAX_AGENTS} agents", where)
                return
            path = self._scratch / f"{datagram.agent_id}.pcapng"
            path.write_bytes(header(f"vehicle {datagram.agent_id}", f"from {self._path.name}"))
            capture = self._captures[datagram.agent_id] = PcapngFile(path)
        capture.packet(datagram.time_ns, udp_broadcast(sender, PORT, datagram.data), outbound=datagram.sent)

    def end(self, sorter: Sorter) -> None:
        """There is no more of it."""
        for agent_id, capture in self._captures.items():
            capture.close()
            seen = glance(self._scratch / f"{agent_id}.pcapng", self._left_out)
            sorter.captures += [replace(seen, source=self._path)] if seen else []
        for agent_id, reader in self._readers.items():
            lives = reader.ended(self._left_out)
            sorter.lives += lives
            if not lives:
                self._drop(
                    f"its {self._lines[agent_id]} line(s) of the trace of agent {agent_id} hold no handler run", None
                )
        if not self._said and not self._dropped:
            self._drop("it contains no records of agents", None)
        self._left_out += self._unusable
        if rest := self._dropped - len(self._unusable):
            self._left_out.append(LeftOut(self._path, f"{rest} more places in it hold no usable record"))

    def _drop(self, why: str, where: int | None) -> None:
        self._dropped += 1
        if len(self._unusable) < _PLACES_TOLD:
            self._unusable.append(LeftOut(self._path, why, where, self._adapter.counts))


def _text(text: str | bytes) -> str:
    return text if isinstance(text, str) else text.decode("utf-8", "replace")
