"""Recognise the format of each file by its content, and group the records by flight.

A separate recorder can write events (`ucp-events/1`) as one JSON object per line:

{"schema": "ucp-events/1", "agent_id": 7, "time_us": 1790000000000000, "event_id": 3, "data": "<base64>"}
"""

import base64
from base64 import b64decode
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from harness.archive.bounded_file import BoundedFile
from harness.archive.exports import MAX_EXPORT_BYTES, AgentId, Base64, Export, json_error, parse_export
from harness.archive.packets.pcap import MAGICS
from harness.archive.traces import MAX_LINE_BYTES, MAX_LINE_WEIGHT
from harness.errors import CaptureError, ExportError, FieldError
from harness.field.flight_logs import FlightLog, flight_log_kind, read_flight_log
from harness.field.flight_logs._matching import in_words, match_logs
from harness.field.ingest._file_owners import (
    PUBLIC_SCHEMA,
    CaptureSummary,
    assign_keys,
    assign_mission_files,
    files_of,
    read_mission_file,
    read_public_keys,
    summarise_capture,
)
from harness.field.ingest._flights import group_by_flight
from harness.field.ingest._ingest import FileRemark, Flight, IngestResult, UnusedPart
from harness.field.ingest._trace_incarnations import TraceIncarnation, read_incarnations
from harness.gc_pause import gc_paused
from ucp.events import LoggableEvent, MalformedEventsError, decode_events
from ucp.export import SCHEMA as EXPORT_SCHEMA
from ucp.mission import SCHEMA as MISSION_SCHEMA
from ucp.mission import Mission
from ucp.plain_file import check_weight, parse_json_at
from ucp.store import SCHEMA as STORE_SCHEMA
from ucp.telemetry import Position, position_of

if TYPE_CHECKING:
    from ucp.secure.bundle import PublicKeys
    from ucp.secure.opening import DatagramOpener


SCHEMA: Literal["ucp-events/1"] = "ucp-events/1"
SUFFIX = ".events.jsonl"
MAX_EVENTS = 1_000_000


class EventLine(BaseModel):
    """One recorded event. `time_us` is in microseconds since the Unix epoch."""

    model_config = ConfigDict(extra="ignore")

    schema_: Annotated[Literal["ucp-events/1"], Field(alias="schema")] = SCHEMA
    agent_id: AgentId
    time_us: Annotated[int, Field(ge=0, lt=2**64, strict=True)]
    event_id: Annotated[int, Field(ge=1, le=254, strict=True)]
    data: Annotated[Base64, Field(max_length=100_000)]

    @classmethod
    def of(cls, agent_id: int, event: LoggableEvent) -> "EventLine":
        data = base64.b64encode(event.data).decode()
        return cls(agent_id=agent_id, time_us=event.timestamp_us, event_id=event.event_id, data=data)

    @property
    def event(self) -> LoggableEvent:
        return LoggableEvent(self.time_us, self.event_id, base64.b64decode(self.data))

    def to_line(self) -> str:
        return self.model_dump_json(by_alias=True) + "\n"


def read_logged(path: Path, left_out: list[UnusedPart]) -> list[tuple[int, LoggableEvent]]:
    """Return the events in a file, each with the ID of its agent. The list is empty if the file has another format.
    Raises OSError.
    """
    events: list[tuple[int, LoggableEvent]] = []
    damaged: list[int] = []
    with BoundedFile(path) as file:
        if SCHEMA.encode() not in file.peek(4096)[:4096]:
            return []
        number = 0
        while len(events) < MAX_EVENTS and (text := file.readline(MAX_LINE_BYTES)):
            number += 1
            try:
                check_weight(text, MAX_LINE_WEIGHT)
                line = EventLine.model_validate_json(text)
                events.append((line.agent_id, line.event))
            except ValueError:
                damaged.append(number)
        if file.problem:
            left_out.append(UnusedPart(path, file.problem))
    if damaged:
        more = f", and {len(damaged) - 1} more lines are" if len(damaged) > 1 else ""
        left_out.append(UnusedPart(path, f"it is damaged{more}", damaged[0]))
    return events


def assign_flight_logs(
    flights: Sequence[Flight], logs: Iterable[FlightLog], left_out: list[UnusedPart], remarks: list[FileRemark]
) -> None:
    """Assign each flight log to the first flight in which an agent flew on the vehicle of the log. Omit the logs of
    unknown vehicles.
    """
    fixes = [_logged_positions(flight) for flight in flights] if logs else []
    for log in logs:
        remarks += [FileRemark(log.path, problem) for problem in log.problems]
        unmatched = []
        for number in range(len(log.vehicles)):
            why = ""
            for flight, positions in zip(flights, fixes, strict=True):
                match = match_logs([log], positions)[number]
                if match.agent_id is not None:
                    flight.flight_logs.append(match)
                    remarks.append(FileRemark(log.path, in_words(match).removeprefix(f"{log.path}: ")))
                    break
                why = why or in_words(match).removeprefix(f"{log.path}: ")
            else:
                unmatched.append(why)
        left_out += [UnusedPart(log.path, why or "a flight log without a flight of agents") for why in unmatched]
        if not log.vehicles:
            left_out.append(UnusedPart(log.path, f"a {log.kind} log without a vehicle"))


def _logged_positions(flight: Flight) -> dict[int, list[tuple[int, Position]]]:
    """Return the positions that each agent logged, in order of time, from all blocks that any record contains."""
    found: dict[int, dict[int, Position]] = {agent_id: {} for agent_id in {*flight.agents, *flight.roster}}
    data = {(block.agent_id, block.event_bytes) for export in flight.exports.values() for block in export.blocks()}
    data |= {(agent_id, b64decode(export.current_block.event_data)) for agent_id, export in flight.exports.items()}
    for agent_id, event_data in data:
        try:
            events = decode_events(event_data)
        except MalformedEventsError:
            continue
        of_agent = found.setdefault(agent_id, {})
        for event in events:
            if (position := position_of(event.event_id, event.data)) is not None:
                of_agent[event.timestamp_us] = position
    for agent_id, logged in flight.logged.items():
        for event in logged:
            if (position := position_of(event.event_id, event.data)) is not None:
                found[agent_id][event.timestamp_us] = position
    return {agent_id: sorted(positions.items()) for agent_id, positions in found.items()}


MAX_DOCUMENTS = 1000
"""Maximum number of chain exports in one file."""
MAX_LISTED_ALIKE = 3
"""Maximum number of omitted files of one directory that are listed separately if they have the same reason."""
_BAGS = (b"#ROSBAG V2.0\n", b"\x89MCAP0\r\n", b"SQLite format 3\0", b"\x28\xb5\x2f\xfd")
_ARCHIVES = (b"PK\x03\x04", b"7z\xbc\xaf", b"\xfd7zXZ", b"BZh", b"Rar!")
_BEGINNING_CHARACTERS = 200
_BLANK = " \t\r\n\0\ufeff"


@gc_paused()
def ingest_files(paths: Iterable[Path], opener: "DatagramOpener | None" = None) -> IngestResult:
    """Return the records in files and directories, grouped by flight. File names have no effect. Damaged files are used
    as far as possible. `opener` decrypts captures of a secured mission. Raises FieldError if a path does not exist. The
    field `left_out` of the result reports every other problem.
    """
    left_out: list[UnusedPart] = []
    sorter = RecordSorter(left_out, opener)
    for path in files_of(paths, left_out):
        sorter.add_file(path)
    return sorter.result()


class RecordSorter:
    """A collector that reads records from files and sorts them by flight.

    It reads files of the harness, and accepts the records that adapters read from other files.
    """

    def __init__(self, left_out: list[UnusedPart], opener: "DatagramOpener | None" = None) -> None:
        self._opener = opener
        self.incarnations: list[TraceIncarnation] = []
        self.exports: list[tuple[Path, Export]] = []
        self.captures: list[CaptureSummary] = []
        self.logged: list[tuple[Path, int, LoggableEvent]] = []
        self.flight_logs: list[FlightLog] = []
        self._public_keys: list[tuple[Path, PublicKeys]] = []
        self._mission_files: list[tuple[Path, Mission]] = []
        self._left_out = left_out

    def result(self) -> IngestResult:
        """Return the flights in all files that were added."""
        remarks: list[FileRemark] = []
        flights = group_by_flight(self.incarnations, self.exports, self.captures, self.logged, self._left_out, remarks)
        assign_flight_logs(flights, self.flight_logs, self._left_out, remarks)
        assign_keys(flights, self._public_keys, self._left_out)
        assign_mission_files(flights, self._mission_files, self._left_out)
        return IngestResult(flights, [*_summarise(self._left_out)], remarks)

    def add_file(self, path: Path) -> None:
        """Recognise the format of a file, and read the records in the file."""
        try:
            with BoundedFile(path) as file:
                beginning = file.peek(4096)[:4096]
            if beginning.startswith(_BAGS):
                self._omit(path, "a ROS bag, or a compressed recording: read it with `ucp-harness import`")
            elif flight_log_kind(path, beginning) is not None:
                self.flight_logs.append(read_flight_log(path))
            elif beginning[:4] in MAGICS:
                summary = summarise_capture(path, self._left_out, self._opener)
                self.captures += [summary] if summary else []
            elif incarnations := read_incarnations(path, self._left_out):
                self.incarnations += incarnations
            elif logged := read_logged(path, self._left_out):
                self.logged += [(path, agent_id, event) for agent_id, event in logged]
            else:
                self._add_export_file(path)
        except OSError as error:
            self._omit(path, f"it cannot be read: {error.strerror}")
        except (CaptureError, FieldError) as error:
            self._omit(path, str(error).removeprefix(f"{path}: "))

    def _add_export_file(self, path: Path) -> None:
        with BoundedFile(path, MAX_EXPORT_BYTES) as file:
            data = file.read()
            if file.problem:
                self._omit(path, f"it is incomplete: {file.problem}")
                return
        try:
            text = data.decode("utf-8").strip(_BLANK)
        except UnicodeDecodeError:
            text = ""
        if STORE_SCHEMA in text[:_BEGINNING_CHARACTERS]:
            self._omit(path, "the store of an agent, with which it can reboot: only the agent reads it")
            return
        if not text.startswith(("{", "[")):
            self._omit(path, _describe_content(data))
            return
        if MISSION_SCHEMA in text[:_BEGINNING_CHARACTERS]:
            if (mission := read_mission_file(path, self._left_out)) is not None:
                self._mission_files.append((path, mission))
            return
        if PUBLIC_SCHEMA in text:
            if (keys := read_public_keys(path, self._left_out)) is not None:
                self._public_keys.append((path, keys))
            return
        self.add_exports(path, text)

    def add_exports(self, path: Path, text: str, line: int | None = None, counts: str = "line") -> None:
        """Add the chain exports in a text. If the text is only a part of a file, `line` is its position in the file."""
        try:
            for document in _documents(text.strip(_BLANK)):
                self.exports.append((path, parse_export(path, document)))
        except ExportError as error:
            self._omit(path, str(error).removeprefix(f"{path}: "), line, counts)
        except ValueError as error:
            what = "a chain export, but " if EXPORT_SCHEMA in text else ""
            self._omit(path, what + str(json_error(path, error)).removeprefix(f"{path}: "), line, counts)

    def _omit(self, path: Path, why: str, line: int | None = None, counts: str = "line") -> None:
        self._left_out.append(UnusedPart(path, why, line, counts))


def _documents(text: str) -> Iterator[Any]:
    """Yield the JSON documents that follow one another in a text. Raises ValueError."""
    position = 0
    for _ in range(MAX_DOCUMENTS):
        if position == len(text):
            return
        document, position = parse_json_at(text, position)
        while position < len(text) and text[position] in _BLANK:
            position += 1
        yield document


def _describe_content(data: bytes) -> str:
    if not data.strip(b"\0\r\n\t "):
        return "it is empty" if not data else "it holds only NUL bytes and blanks, as after a loss of power"
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "it is UTF-16 text, as written by PowerShell: convert it with `iconv -f UTF-16 -t UTF-8`"
    if data.startswith(_ARCHIVES):
        return "it is an archive, or compressed with another program than gzip: unpack it first"
    printable = sum(byte >= 32 or byte in b"\t\r\n" for byte in data[:4096])
    content = "text" if printable > 0.9 * len(data[:4096]) else "binary data"
    return f"it is not a trace, chain export or capture: {content} without UCP records"


def _summarise(left_out: list[UnusedPart]) -> Iterator[UnusedPart]:
    """Yield the omitted files. If many files of one directory have the same reason, they become one entry."""
    alike: dict[tuple[Path, str], list[UnusedPart]] = {}
    for each in left_out:
        alike.setdefault((each.path.parent, each.why) if each.line is None else (each.path, str(each.line)), []).append(
            each
        )
    for (_, why), group in alike.items():
        yield from group[:MAX_LISTED_ALIKE]
        if more := group[MAX_LISTED_ALIKE:]:
            names = ", ".join(each.path.name for each in more[:10]) + (", ..." if len(more) > 10 else "")
            yield UnusedPart(
                more[0].path.parent, f"{len(more)} more files ({names}) are left out for the same reason: {why}"
            )
