"""Write imported records as the harness's own files, with `import.json` beside them."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from harness.archive.bounded_file import Opened
from harness.archive.directory import PUBLIC_KEYS_FILE, claim
from harness.archive.exports import SUFFIX as EXPORT_SUFFIX
from harness.archive.exports import Export
from harness.archive.packets.capture_files import DIRECTORY as CAPTURES
from harness.archive.packets.pcap import PCAPNG_MAGIC
from harness.archive.traces import SUFFIX as TRACE_SUFFIX
from harness.archive.traces import Gap, Trace, gap_line
from harness.checker.records.contradiction import ROUNDED_S, mission_s
from harness.errors import RunDirectoryError
from harness.field.ingest._ingest import Flight, Homecoming, Remark
from harness.field.ingest._logged_events import SUFFIX as LOGGED_SUFFIX
from harness.field.ingest._logged_events import EventLine
from harness.scenario.strict_model import VehicleKey

FILE = "import.json"


class ImportedAgent(BaseModel):
    """What there is of one agent: files relative to the flight's directory, and what they were made from.

    `handler_runs`, `lives`, `gaps` and `clock_jumps` are of its trace.
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
    """`directory` is relative to the import's; `initial_data` is in base64."""

    directory: str
    initial_data: str | None
    epoch_us: int | None
    roster: list[int]
    agents: dict[VehicleKey, ImportedAgent]
    more_captures: list[str] = []


class ImportRemark(BaseModel):
    """Of a file of the sources, or of the line, row or message of it that `counts` says: `why` ends a sentence."""

    path: str
    line: int | None
    counts: str
    why: str

    @property
    def sentence(self) -> str:
        return Remark(Path(self.path), self.why, self.line, self.counts).sentence


class ImportRecord(BaseModel):
    """The flights, the one with the most in it first; what was left out; and what must be known of the rest."""

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
    with Opened(capture) as file:
        suffix = "pcapng" if file.peek(4)[:4] == PCAPNG_MAGIC else "pcap"
        path = f"{CAPTURES}/{name}.{suffix}"
        with (directory / path).open("wb") as copy:
            while part := file.read(_COPIED_AT_ONCE):
                copy.write(part)
    return path
