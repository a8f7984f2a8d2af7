"""Read all data of a run that can be exported: its files, its clock, and all recorded values.

The run may have been interrupted, some of its files may be damaged, or the command `import` may have created it from
field logs. The export contains everything that is readable. `problems` contains a sentence for each unreadable file.

Each line in the log file of a program begins with its time. Agents may use any log format. A line without a time
receives the time of the previous line. If the first line of a file has no time, it receives the time of the start of
the mission. Log files do not name their time zone. The reader assumes the zone in which the first line is nearest to
the start of the mission.
"""

import math
import re
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from functools import cached_property
from heapq import merge
from itertools import chain, groupby, islice
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING

from pymavlink import mavutil

from harness.archive.archive import RunArchive
from harness.archive.bounded_file import BoundedFile
from harness.archive.connectivity import Components, Connectivity, LossRates, Topology
from harness.archive.exports import name_blocks
from harness.archive.history import (
    LATEST_S,
    MissionHistory,
    end_of_traces,
    has_possible_time,
    history_of,
    possible_faults,
)
from harness.archive.replication import replication_of
from harness.archive.run_record import FaultRecord
from harness.archive.tracks import VehicleTracks
from harness.errors import ExportError, RunDirectoryError
from harness.report import logbook
from harness.report.export._samples import (
    DropSample,
    EarthPosition,
    FieldPosition,
    HandlerRunSample,
    Level,
    LogLine,
    LossSample,
    MessageSample,
    MissionTime,
    NetworkSample,
    ReconcileSample,
    ReplicationSample,
    Sample,
    TelemetrySample,
    VoteSample,
    mission_time,
)
from harness.report.logbook.positions import tracks
from harness.scenario.strict_model import MAX_AGENTS
from harness.scenario.verdict_names import kind_of
from sitl.vehicle import Home
from ucp.trace import DroppedDatagram

if TYPE_CHECKING:
    from ucp.secure.sealing import Depot


NAME = "telemetry.tlog"
MAX_TELEMETRY_BYTES = 1024 * 1024 * 1024
MAX_TELEMETRY_FILES = 1000
_LIFE = re.compile(r"([1-9]\d{0,4})(?:-([1-9]\d{0,3}))?")


def telemetry_logs(directory: Path) -> list[tuple[int, Path]]:
    """Return the vehicle and the path of each telemetry log. A restarted vehicle has several logs."""
    logs = []
    for path in islice((directory / "vehicles").glob(f"*/{NAME}"), MAX_TELEMETRY_FILES):
        if named := _LIFE.fullmatch(path.parent.name):
            logs.append((int(named[1]), int(named[2] or 1), path))
    return [(vehicle, path) for vehicle, _, path in sorted(logs)]


def read_telemetry(vehicle: int, path: Path, time: MissionTime, problems: list[str]) -> Iterator[TelemetrySample]:
    """Yield the messages of a telemetry log. At the end, add sentences about damage in the log to `problems`."""
    damaged = untimed = 0
    if not path.is_file():
        problems.append(f"{path}: cannot be read: it is not a file")
        return
    try:
        if path.stat().st_size > MAX_TELEMETRY_BYTES:
            problems.append(
                f"{path}: larger than {MAX_TELEMETRY_BYTES // 1024**2} MiB, which is too large for a log of a "
                "flight; it is left out"
            )
            return
        log = mavutil.mavlogfile(str(path), robust_parsing=True)
    except OSError as error:
        problems.append(f"{path}: cannot be read: {error.strerror}")
        return
    try:
        while (message := log.recv_msg()) is not None:
            kind = message.get_type()
            if kind == "BAD_DATA":
                damaged += 1
            elif (at_ns := time.of_wall(message._timestamp)) is None:
                untimed += 1
            elif not kind.startswith("UNKNOWN_"):
                yield TelemetrySample(at_ns, vehicle, message)
    finally:
        log.f.close()
    if damaged:
        problems.append(f"{path}: damaged in {damaged} places; the messages between are read")
    if untimed:
        problems.append(f"{path}: {untimed} messages with an impossible time are left out")


MAX_LOG_BYTES = 32 * 1024 * 1024
MAX_LINE_BYTES = 64 * 1024
MAX_LOG_FILES = 3000
_ZONE_STEP_S = 15 * 60
_FURTHEST_ZONE_S = 14 * 3600
_TIME = re.compile(r"(\d{4}-\d\d-\d\d[ T]\d\d:\d\d:\d\d)(?:[.,](\d{1,6}))?\s*")
_WORSE = re.compile(r"\b(error|exception|traceback|fatal|critical|panic)\b", re.IGNORECASE)
_BAD = re.compile(r"\bwarn(ing)?\b", re.IGNORECASE)


def log_files(directory: Path) -> Iterator[tuple[str, Path]]:
    """Yield the name and path of each log file of the run. Log files exist for the network, the rogue node, the agents
    and the vehicles.
    """
    files = chain(directory.glob("*.log"), directory.glob("agents/**/*.log"), directory.glob("vehicles/*/output.log"))
    for path in sorted(islice(files, MAX_LOG_FILES)):
        yield str(path.relative_to(directory)).encode("utf-8", "replace").decode(), path


def read_log(source: str, path: Path, time: MissionTime, problems: list[str]) -> Iterator[LogLine]:
    """Yield the lines of a log file. If a part cannot be read, add a sentence to `problems`."""
    at_ns, zone_s = time.at(0.0), None
    try:
        with BoundedFile(path, MAX_LOG_BYTES) as file:
            while line := file.readline(MAX_LINE_BYTES):
                text = line.decode("utf-8", "replace").rstrip()
                if timed := _TIME.match(text):
                    wall_s = _seconds(timed)
                    if wall_s is not None and zone_s is None:
                        zone_s = _zone_s(wall_s - time.epoch_ns / 1e9)
                    moment = None if wall_s is None or zone_s is None else time.of_wall(wall_s - zone_s)
                    at_ns = at_ns if moment is None else moment
                    text = text[timed.end() :]
                if text:
                    yield LogLine(at_ns, _level(text), source, text)
            if file.problem:
                problems.append(f"{path}: {file.problem}")
    except OSError as error:
        problems.append(f"{path}: cannot be read: {error.strerror}")


def _zone_s(ahead_s: float) -> float:
    """Return the time zone of a log file as an offset from UTC in seconds. It is the zone in which the first line of
    the file is nearest to the start of the mission. Return infinity if no zone matches, for example in virtual time.
    """
    zone_s = round(ahead_s / _ZONE_STEP_S) * _ZONE_STEP_S
    return zone_s if abs(zone_s) <= _FURTHEST_ZONE_S else math.inf


def _seconds(timed: re.Match[str]) -> float | None:
    """Parse a text as a time in UTC, and return it in seconds since the Unix epoch. Return None if the text is not a
    valid time.
    """
    try:
        whole = datetime.fromisoformat(timed[1]).replace(tzinfo=UTC).timestamp()
    except ValueError:
        return None
    return whole + float(f"0.{timed[2] or 0}")


def _level(text: str) -> Level:
    if _WORSE.search(text):
        return "error"
    return "warning" if _BAD.search(text) else "info"


FAULTS, OPERATOR, VERDICTS = "faults", "operator", "verdicts"
MAX_LINKED = 100
"""Maximum number of vehicles for which the loss of every link is exported. 100 vehicles have 9900 links."""


class ExportedRun:
    """A run to export. If no file contains positions, the positions come from logged events, which `depot` decrypts.

    Raises RunDirectoryError if the directory holds no run, and ExportError if it holds nothing to export.
    """

    def __init__(self, directory: Path, depot: "Depot | None" = None) -> None:
        if not directory.is_dir():
            raise RunDirectoryError(f"{directory} is not a directory: name the directory of a run, or of an import")
        self.directory = directory
        self.archive = RunArchive(directory)
        self._depot = depot
        self._problems: list[str] = []
        if self.archive.recorded and self.archive.record.outcome == "running":
            self.add_problem("the end of the run is not recorded: the run is still active, or it was killed")
        headers = {agent: trace.header for agent, trace in self.archive.traces.items()}
        self.time: MissionTime = mission_time(headers, self.archive.record, self._problems)
        if not any((self.agents, self._telemetry, self._logs)):
            raise ExportError(f"{directory}: nothing to export: it holds no traces, chains, telemetry or logs")
        if len(self.agents) > MAX_AGENTS:
            raise ExportError(
                f"{directory}: {len(self.agents)} agents are named in it, but a run has at most {MAX_AGENTS}; "
                "run.json was edited or damaged"
            )

    @cached_property
    def agents(self) -> list[int]:
        """The IDs of all agents that any file of the run mentions, in ascending order."""
        archive = self.archive
        return sorted({*archive.roster, *archive.traces, *archive.exports.by_agent})

    @cached_property
    def block_names(self) -> dict[str, str]:
        """The names of the blocks, such as "4.11", by block hash."""
        return name_blocks(self.archive.exports.by_agent)

    def block(self, block_hash: str) -> str:
        """Return the name of a block. If no export contains the block, return the first 12 digits of its hash."""
        return self.block_names.get(block_hash, block_hash[:12])

    @cached_property
    def history(self) -> MissionHistory:
        """All votes, reconciles and messages in the traces of the agents."""
        return history_of(self.archive.traces, self.faults, self.end_s)

    @cached_property
    def faults(self) -> list[FaultRecord]:
        return possible_faults(self.archive.record.faults)

    @cached_property
    def network(self) -> Connectivity:
        return self.archive.network(self.agents)

    @cached_property
    def tracks(self) -> VehicleTracks:
        return self.archive.tracks(self.agents)

    @cached_property
    def end_s(self) -> float:
        """The last recorded mission second."""
        recorded_end_s = self.archive.record.mission_s or 0.0
        flown = (fixes[-1].at_s for fixes in self.tracks.by_vehicle.values())
        return max(
            [end_of_traces(self.archive.traces), *flown, *([recorded_end_s] if 0 <= recorded_end_s <= LATEST_S else [])]
        )

    @property
    def problems(self) -> list[str]:
        """A sentence for each damaged or missing file. The list is complete only after all `samples` were read."""
        archive = self.archive
        sentences = [*archive.problems, *archive.gaps, *self.tracks.problems, *self.network.problems, *self._problems]
        return list(dict.fromkeys(map(archive.within, sentences)))

    def add_problem(self, sentence: str) -> None:
        """Add a sentence to the list of problems."""
        self._problems.append(sentence)

    @cached_property
    def _telemetry(self) -> list[tuple[int, Path]]:
        return telemetry_logs(self.directory)

    @cached_property
    def _logs(self) -> list[tuple[str, Path]]:
        return list(log_files(self.directory))

    def samples(self) -> Iterator[Sample]:
        """Yield all recorded values in order of time. The method reads telemetry and log files while the caller
        iterates.
        """
        streams: list[Iterable[Sample]] = [
            self.positions(),
            self._losses(),
            self._network(),
            self._spread(),
            self._messages(),
            self._votes(),
            self._reconciles(),
            self._log_lines(),
            *map(self._handler_runs, self.archive.traces),
            *map(self._drops, self.archive.traces),
            *(read_telemetry(vehicle, path, self.time, self._problems) for vehicle, path in self._telemetry),
            *(read_log(source, path, self.time, self._problems) for source, path in self._logs),
        ]
        return merge(*streams, key=attrgetter("at_ns"))

    def positions(self) -> Iterator[FieldPosition]:
        """Yield the recorded positions of the vehicles. If no positions were recorded, yield the positions that agents
        logged as events.
        """
        positions = self._by_tracks() if self.tracks.by_vehicle else self._by_events()
        return iter(sorted(positions, key=attrgetter("at_ns")))

    def _by_tracks(self) -> Iterator[FieldPosition]:
        scenario = self.archive.record.scenario
        if scenario is None:
            self._problems.append("the location of the field is unknown: positions are in metres, without a map")
        home = scenario.vehicles.field if scenario else None
        for vehicle, fixes in self.tracks.by_vehicle.items():
            for fix in fixes:
                metres = fix.east_m, fix.north_m, fix.up_m
                there = home.offset(fix.north_m, fix.east_m) if home else None
                place = EarthPosition(there.lat_deg, there.lon_deg, there.alt_m + fix.up_m) if there else None
                yield FieldPosition(self.time.at(fix.at_s), vehicle, metres, place)

    def _by_events(self) -> Iterator[FieldPosition]:
        """Yield the positions in logged events. The first position becomes the centre of the field."""
        if not self.archive.exports.by_agent:
            return
        untimed, field = 0, None
        read = logbook.read(self.archive, self._depot)
        if read.event_data.is_closed:
            self._problems.append("event data is sealed to the depot: positions need --depot-key")
        for track in tracks(read):
            for timestamp_us, logged in track.fixes:
                place = EarthPosition(*(logged.lat_e7 / 1e7, logged.lon_e7 / 1e7, logged.alt_mm / 1e3))
                field = field or Home(*place)
                at_ns = self.time.of_timestamp(timestamp_us)
                if at_ns is None:
                    untimed += 1
                else:
                    north_m, east_m, up_m = field.metres_to(*place)
                    yield FieldPosition(at_ns, track.agent_id, (east_m, north_m, up_m), place)
        if untimed:
            self._problems.append(f"{untimed} logged positions with an impossible time are left out")

    def _losses(self) -> Iterator[LossSample]:
        if len(self.agents) > MAX_LINKED:
            self._problems.append(
                f"single links are exported for up to {MAX_LINKED} vehicles only, and this run has more"
            )
            return
        for at_s, losses in self.archive.link_losses(self.agents):
            if at_s <= LATEST_S:
                yield LossSample(self.time.at(at_s), losses)

    def _network(self) -> Iterator[NetworkSample]:
        def at(change: Topology | LossRates) -> float:
            return change.at_s

        groups: Components = ()
        losses = LossRates(0.0, 0.0, 0.0)
        changes: list[Topology | LossRates] = [*self.network.states, *self.network.losses]
        for at_s, simultaneous in groupby(sorted(changes, key=at), at):
            for change in simultaneous:
                if isinstance(change, LossRates):
                    losses = change
                else:
                    groups = change.components
            if at_s <= LATEST_S:
                yield NetworkSample(self.time.at(at_s), groups, losses.mean, losses.worst)

    def _spread(self) -> Iterator[ReplicationSample]:
        for replication in replication_of(self.archive.traces, self.faults):
            yield ReplicationSample(self.time.at(replication.at_s), replication)

    def _handler_runs(self, agent: int) -> Iterator[HandlerRunSample]:
        for run in self.archive.traces[agent].runs:
            if has_possible_time(run):
                yield HandlerRunSample(self.time.at(run.t, agent), agent, run)

    def _drops(self, agent: int) -> Iterator[DropSample]:
        for _, aside in self.archive.traces[agent].asides:
            if isinstance(aside, DroppedDatagram) and 0 <= aside.t <= LATEST_S:
                yield DropSample(self.time.at(aside.t, agent), agent, aside.dropped)

    def _messages(self) -> Iterator[MessageSample]:
        for message in self.history.messages or ():
            yield MessageSample(self.time.at(message.at_s, message.sender), message)

    def _votes(self) -> Iterator[VoteSample]:
        for vote in sorted(self.history.votes, key=attrgetter("end_s")):
            yield VoteSample(self.time.at(vote.end_s, vote.agent), vote)

    def _reconciles(self) -> Iterator[ReconcileSample]:
        for reconcile in sorted(self.history.reconciles, key=attrgetter("end_s")):
            yield ReconcileSample(self.time.at(reconcile.end_s, reconcile.agent), reconcile)

    def _log_lines(self) -> Iterator[LogLine]:
        """Yield a log line for each fault, each operator command and each verdict. The verdicts have the time at which
        the run ended.
        """
        for state in self.archive.record.network[:1]:
            yield LogLine(self.time.at(0.0), "info", FAULTS, f"{state.what}: {state.detail}")
        for fault in self.faults:
            yield LogLine(self.time.at(fault.at_s), "warning", FAULTS, f"{fault.what}: {fault.detail}")
        record = self.archive.record
        for command in record.ground_station.commands if record.ground_station else ():
            vehicles = f"vehicle{'s' if len(command.vehicles) > 1 else ''} {' '.join(map(str, command.vehicles))}"
            recorded_end_s = f"{command.command or command.message} to {vehicles}"
            yield LogLine(self.time.at(command.at_s), "warning", OPERATOR, recorded_end_s)
        for sentence in record.unmatched_fates:
            yield LogLine(self.time.at(self.end_s), "warning", FAULTS, sentence)
        for key, judgement in self.archive.record.judgements.items():
            level: Level = "error" if kind_of(judgement.verdict) == "bad" else "info"
            sentence = f"{key} {judgement.name}: {judgement.verdict}: {judgement.reason}"
            yield LogLine(self.time.at(self.end_s), level, VERDICTS, sentence)
