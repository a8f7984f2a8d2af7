"""Group records by flight. All agents of a flight have the same mission and time, and each agent occurs once.

A mission is identified by its roster and its inception data (BD_0). One mission may have several flights, each with its
own mission second 0. Exports and captures do not name their flight. They are assigned to the flight with which they
have the most blocks in common.
"""

import base64
import binascii
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

from harness.archive.exports import Export
from harness.archive.traces import Trace, TraceHeader
from harness.field.ingest._copies import split_into_flights
from harness.field.ingest._file_owners import CaptureSummary
from harness.field.ingest._ingest import FileRemark, Flight, UnusedPart
from harness.field.ingest._trace_incarnations import TraceIncarnation
from ucp.block import InceptionBlock
from ucp.events import LoggableEvent
from ucp.trigger import TimerTrigger


class _MissionInHeader(NamedTuple):
    """The mission in a trace header: the inception data in base64 (None if absent), the roster, and the start time."""

    initial_data: str | None
    roster: tuple[int, ...]
    epoch_us: int | None


@dataclass
class _FlightRecords:
    """The records of one flight that were read so far. `hashes` contains the hexadecimal hashes of all blocks and
    chains in these records.
    """

    mission: _MissionInHeader
    incarnations: dict[int, list[TraceIncarnation]] = field(default_factory=lambda: defaultdict(list))
    exports: dict[int, tuple[Path, Export]] = field(default_factory=dict)
    captures: dict[int, Path] = field(default_factory=dict)
    more_captures: list[Path] = field(default_factory=list)
    logged: dict[int, list[LoggableEvent]] = field(default_factory=lambda: defaultdict(list))
    hashes: set[str] = field(default_factory=set)
    directories: set[Path] = field(default_factory=set)

    def add(self, incarnation: TraceIncarnation, agent_id: int) -> None:
        self.incarnations[agent_id].append(incarnation)
        self.directories.add(incarnation.path.parent)
        self.hashes |= _hashes_of(incarnation)

    @property
    def runs(self) -> int:
        return sum(len(incarnation.runs) for incarnations in self.incarnations.values() for incarnation in incarnations)

    @property
    def size(self) -> tuple[int, int]:
        return len(self.incarnations) + len(self.exports) + len(self.captures) + len(self.logged), self.runs

    @cached_property
    def time_span(self) -> tuple[float, float]:
        """The times of the first and the last handler run, on the agents' own clocks, in seconds since the
        Unix epoch.
        """
        times = [
            run.t
            for incarnations in self.incarnations.values()
            for incarnation in incarnations
            for run in incarnation.runs
        ]
        start_s = (self.mission.epoch_us or 0) / 1e6
        return start_s + min(times, default=0.0), start_s + max(times, default=0.0)


def group_by_flight(
    incarnations: Iterable[TraceIncarnation],
    exports: Iterable[tuple[Path, Export]],
    captures: Iterable[CaptureSummary],
    logged: Iterable[tuple[Path, int, LoggableEvent]],
    left_out: list[UnusedPart],
    remarks: list[FileRemark],
) -> list[Flight]:
    """Return the flights. The flight with the most records is first."""
    groups, without_header = _by_mission(incarnations, left_out)
    for path, export in exports:
        _add_export(groups, path, export, left_out)
    for incarnation in without_header:
        _add_without_header(groups, incarnation, left_out, remarks)
    for capture in captures:
        _add_capture(groups, capture)
    for path, agent_id, event in logged:
        _add_logged(groups, path, agent_id, event)
    groups.sort(key=lambda records: records.size, reverse=True)
    return [_flight(records, remarks) for records in groups]


# Traces


def _by_mission(
    incarnations: Iterable[TraceIncarnation], left_out: list[UnusedPart]
) -> tuple[list[_FlightRecords], list[TraceIncarnation]]:
    """Group the records by mission and start time. Return these groups, and the traces without a header."""
    by_header: dict[tuple[_MissionInHeader, int], list[TraceIncarnation]] = defaultdict(list)
    without_header: list[TraceIncarnation] = []
    last: TraceIncarnation | None = None
    for incarnation in incarnations:
        if (
            incarnation.header is None
            and last is not None
            and last.path == incarnation.path
            and last.agent_id == incarnation.agent_id
        ):
            incarnation.header = last.header  # a restarted agent whose header line is damaged
        if incarnation.header is None:
            without_header.append(incarnation)
        elif incarnation.header.agent_id not in incarnation.header.roster:
            why = f"agent {incarnation.header.agent_id} is not on the roster in its own trace"
            left_out.append(UnusedPart(incarnation.path, why, incarnation.first_line, incarnation.counts))
        else:
            by_header[_mission_of(incarnation.header), incarnation.header.agent_id].append(incarnation)
        last = incarnation
    groups: dict[_MissionInHeader, list[_FlightRecords]] = defaultdict(list)
    for (mission, agent_id), of_agent in by_header.items():
        _assign_to_flights(groups[mission], mission, agent_id, [*split_into_flights(of_agent, left_out)])
    separate = [records for of_mission in groups.values() for records in of_mission]
    return _merged(separate), without_header


def _mission_of(header: TraceHeader) -> _MissionInHeader:
    epoch: object = header.clock.get("epoch_us")
    if not isinstance(epoch, int) or isinstance(epoch, bool) or not 0 <= epoch < 2**63:
        epoch = None
    return _MissionInHeader(header.initial_data, tuple(sorted(set(header.roster))), epoch)


def _assign_to_flights(
    groups: list[_FlightRecords], mission: _MissionInHeader, agent_id: int, flights: list[list[TraceIncarnation]]
) -> None:
    """Assign the records of one agent to the flights of the other agents. Records belong to the flight with the most
    directories in common. This assignment is only a guess, and is used if no other fact determines the flight of the
    records.
    """

    def shared_directories(flight_incarnations: list[TraceIncarnation], records: _FlightRecords) -> int:
        return len(records.directories & {incarnation.path.parent for incarnation in flight_incarnations})

    flights.sort(
        key=lambda flight_incarnations: max(
            (shared_directories(flight_incarnations, each) for each in groups), default=0
        ),
        reverse=True,
    )
    for flight_incarnations in flights:
        free = [records for records in groups if agent_id not in records.incarnations]
        best = max(free, key=lambda records: shared_directories(flight_incarnations, records), default=None)
        if best is None:
            best = _FlightRecords(mission)
            groups.append(best)
        for incarnation in flight_incarnations:
            best.add(incarnation, agent_id)


def _merged(groups: list[_FlightRecords]) -> list[_FlightRecords]:
    """Merge groups of records that belong to the same flight. The headers of these records may differ in mission second
    0, or lack BD_0.
    """
    merged: list[_FlightRecords] = []
    for records in sorted(groups, key=lambda each: each.size, reverse=True):
        host = next((other for other in merged if _same_flight(records, other)), None)
        if host is None:
            merged.append(records)
            continue
        for agent_id, incarnations in records.incarnations.items():
            host.incarnations[agent_id] = incarnations
        host.hashes |= records.hashes
        host.__dict__.pop("spans", None)
        host.directories |= records.directories
        if host.mission.initial_data is None or host.mission.epoch_us is None:
            host.mission = host.mission._replace(
                initial_data=host.mission.initial_data or records.mission.initial_data,
                epoch_us=records.mission.epoch_us if host.mission.epoch_us is None else host.mission.epoch_us,
            )
    return merged


def _same_flight(records: _FlightRecords, other: _FlightRecords) -> bool:
    own_mission, other_mission = records.mission, other.mission
    if records.incarnations.keys() & other.incarnations.keys():
        return False
    if records.hashes & other.hashes:
        return True  # shared hashes prove it, even if a header is damaged
    if own_mission.roster != other_mission.roster:
        return False
    if own_mission.initial_data != other_mission.initial_data and None not in (
        own_mission.initial_data,
        other_mission.initial_data,
    ):
        return False
    if None in (own_mission.epoch_us, other_mission.epoch_us):
        return True
    (start_s, end_s), (other_start_s, other_end_s) = records.time_span, other.time_span
    return start_s <= other_end_s and other_start_s <= end_s


def _hashes_of(incarnation: TraceIncarnation) -> set[str]:
    hashes = {block for run in incarnation.runs for _, block in run.changes}
    hashes.update(run.state.top for run in incarnation.runs if run.state.chain)  # all flights share the inception block
    return hashes


def _add_without_header(
    groups: list[_FlightRecords], incarnation: TraceIncarnation, left_out: list[UnusedPart], remarks: list[FileRemark]
) -> None:
    """Add a trace without a header to the flight with which it has the most hashes in common. The header of another
    trace of this flight replaces the lost header.
    """
    agent_id, hashes = incarnation.agent_id, _hashes_of(incarnation)
    if agent_id is None or not incarnation.runs:
        left_out.append(UnusedPart(incarnation.path, "its header is lost, so its agent is unknown"))
        return
    candidates = [records for records in groups if agent_id in records.mission.roster and records.incarnations]
    best = max(
        candidates,
        key=lambda each: (len(each.hashes & hashes), incarnation.path.parent in each.directories, each.size),
        default=None,
    )
    if best is None or not (best.hashes & hashes or incarnation.path.parent in best.directories):
        why = f"its header is lost, and no other trace belongs to a mission of agent {agent_id}"
        left_out.append(UnusedPart(incarnation.path, why))
        return
    own_incarnations = best.incarnations.get(agent_id, [])
    header_owner = next(iter(own_incarnations or next(iter(best.incarnations.values()))))
    assert header_owner.header is not None
    clock = header_owner.header.clock
    if not own_incarnations:
        clock = {key: clock[key] for key in ("epoch_us", "speedup") if key in clock}
        clock["drift"] = _drift(incarnation)
    incarnation.header = header_owner.header.model_copy(update={"agent_id": agent_id, "clock": clock})
    kept = next(split_into_flights([*own_incarnations, incarnation], left_out))
    if incarnation in kept:
        header_source = (
            "another of its files" if own_incarnations else f"the trace of agent {header_owner.header.agent_id}"
        )
        remarks.append(
            FileRemark(
                incarnation.path,
                f"its header is lost; it is read as a trace of agent {agent_id}, with the header of {header_source}",
            )
        )
    best.incarnations[agent_id] = kept
    best.hashes |= hashes


MAX_DRIFT = 0.05


def _drift(incarnation: TraceIncarnation) -> float:
    """Return the drift of an agent's clock. For each timer, the duration of the timer is divided by the time until its
    expiry. The drift is the largest quotient minus 1. It is 0 if no timer expired, or if the result exceeds
    `MAX_DRIFT`.
    """
    started: dict[str, tuple[float, float]] = {}
    drifts = []
    for run in incarnation.runs:
        if isinstance(run.trigger, TimerTrigger) and run.trigger.timer in started:
            started_s, duration_s = started.pop(run.trigger.timer)
            if run.t > started_s:
                drifts.append(duration_s / (run.t - started_s) - 1)
        started.update({timer: (run.t, duration_s) for timer, duration_s in (run.started or {}).items()})
    drift = max(drifts, default=0.0)
    return drift if abs(drift) <= MAX_DRIFT else 0.0


# Exports and captures


def _add_export(groups: list[_FlightRecords], path: Path, export: Export, left_out: list[UnusedPart]) -> None:
    agent_id, inception = export.agent_id, export.inception
    hashes = {block.block_hash for block in export.blocks()} | {*export.completed}
    of_mission = [
        records
        for records in groups
        if records.mission.initial_data in (None, inception.block_data)
        and (not records.exports or _inception(records) == inception.block_hash)
    ]
    candidates = [each for each in of_mission if not each.mission.roster or agent_id in each.mission.roster]
    if of_mission and not candidates:
        left_out.append(UnusedPart(path, f"agent {agent_id} is not on the roster of its mission"))
        return
    best = max(
        candidates,
        key=lambda each: (
            len(each.hashes & hashes),
            path.parent in each.directories,
            each.mission.initial_data is not None,
            each.size,
        ),
        default=None,
    )
    if best is not None and best.mission.initial_data is None and not best.hashes & hashes:
        best = None if best.hashes and hashes else best
    if best is None:
        best = _FlightRecords(_MissionInHeader(inception.block_data, (), None))
        groups.append(best)
    best.hashes |= hashes | {block.chain_hash for block in export.chain if block.chain_hash}
    best.directories.add(path.parent)
    best.mission = best.mission._replace(initial_data=inception.block_data)
    other = best.exports.get(agent_id)
    if other is None:
        best.exports[agent_id] = path, export
        return
    if other[1] == export:
        left_out.append(UnusedPart(path, f"it is the same export as {other[0]}"))
        return
    earlier, later = sorted((other, (path, export)), key=lambda each: each[1].exported_at_us)
    best.exports[agent_id] = later
    left_out.append(UnusedPart(earlier[0], f"agent {agent_id} exported its chain again, later: {later[0]} is used"))


def _inception(records: _FlightRecords) -> str:
    return next(iter(records.exports.values()))[1].inception.block_hash


def _inception_chain_hash(records: _FlightRecords) -> str | None:
    """Return the inception chain hash CH_0 (eq. 3.4) of the mission, which is the same for all flights of the mission.
    Return None if it is unknown.
    """
    data = _decoded(records.mission.initial_data)
    return None if data is None else InceptionBlock(data).chain_hash.hex()


def _add_capture(groups: list[_FlightRecords], capture: CaptureSummary) -> None:
    inception_hashes = {_inception_chain_hash(records) for records in groups}

    def shared_hashes(records: _FlightRecords) -> int:
        return len((records.hashes & capture.hashes) - inception_hashes)

    def same_mission(records: _FlightRecords) -> bool:
        return _inception_chain_hash(records) in capture.hashes

    candidates = [
        each for each in groups if shared_hashes(each) or same_mission(each) or not each.hashes or not capture.hashes
    ]
    best = max(
        candidates,
        key=lambda each: (
            shared_hashes(each),
            same_mission(each),
            capture.epoch_us is not None and capture.epoch_us == each.mission.epoch_us,
            capture.source.parent in each.directories,
            each.size,
        ),
        default=None,
    )
    if best is None:
        best = _FlightRecords(_MissionInHeader(None, (), capture.epoch_us))
        groups.append(best)
    best.hashes |= capture.hashes
    best.directories.add(capture.source.parent)
    if best.mission.epoch_us is None:
        best.mission = best.mission._replace(epoch_us=capture.epoch_us)
    if capture.vehicle is None or capture.vehicle in best.captures:
        best.more_captures.append(capture.path)
    else:
        best.captures[capture.vehicle] = capture.path


def _add_logged(groups: list[_FlightRecords], path: Path, agent_id: int, event: LoggableEvent) -> None:
    """Add an event to the flight that was in progress at the time of the event. If no flight was in progress at that
    time, add the event to the flight with files in the same directory.
    """

    def under_way(records: _FlightRecords) -> bool:
        start_s, end_s = records.time_span
        return start_s <= event.timestamp_us / 1e6 <= end_s

    candidates = [each for each in groups if not each.mission.roster or agent_id in each.mission.roster]
    best = max(candidates, key=lambda each: (under_way(each), path.parent in each.directories, each.size), default=None)
    if best is None:
        best = _FlightRecords(_MissionInHeader(None, (), None))
        groups.append(best)
    best.logged[agent_id].append(event)


# Results


def _flight(records: _FlightRecords, remarks: list[FileRemark]) -> Flight:
    traces = {agent_id: _trace(incarnations) for agent_id, incarnations in sorted(records.incarnations.items())}
    for agent_id, trace in traces.items():
        remarks += _clock_remarks(agent_id, records.incarnations[agent_id], trace)
    return Flight(
        _decoded(records.mission.initial_data),
        traces,
        {agent_id: export for agent_id, (_, export) in sorted(records.exports.items())},
        dict(sorted(records.captures.items())),
        records.mission.roster,
        records.mission.epoch_us,
        records.more_captures,
        {agent_id: sorted(events, key=attrgetter("timestamp_us")) for agent_id, events in records.logged.items()},
        {
            agent_id: list(dict.fromkeys(incarnation.path for incarnation in incarnations))
            for agent_id, incarnations in records.incarnations.items()
        },
    )


def _trace(incarnations: list[TraceIncarnation]) -> Trace:
    header = incarnations[0].header
    assert header is not None
    trace, run_lines, aside_lines = Trace(header), list[int](), list[int]()
    for number, incarnation in enumerate(incarnations):
        first_position = len(trace.runs)
        if number:
            trace.starts.append(first_position)
        trace.runs += incarnation.runs
        trace.asides += [(first_position + position, aside) for position, aside in incarnation.asides]
        trace.gaps += [gap._replace(position=first_position + gap.position) for gap in incarnation.gaps]
        trace.jumps += [first_position + position for position in incarnation.jumps]
        run_lines += incarnation.run_lines
        aside_lines += incarnation.aside_lines
    trace.lines = run_lines, aside_lines
    trace.cut_off = incarnations[-1].cut_off
    return trace


def _clock_remarks(agent_id: int, incarnations: list[TraceIncarnation], trace: Trace) -> Iterator[FileRemark]:
    jumps = [(incarnation, position) for incarnation in incarnations for position in incarnation.jumps]
    for incarnation, position in jumps[:1]:
        before, after = incarnation.runs[position - 1].t, incarnation.runs[position].t
        more = f", and {len(jumps) - 1} more times" if len(jumps) > 1 else ""
        yield FileRemark(
            incarnation.path,
            f"the clock of agent {agent_id} jumps from {before:.3f} s to {after:.3f} s here{more}",
            incarnation.run_lines[position],
            incarnation.counts,
        )


def _decoded(initial_data: str | None) -> bytes | None:
    try:
        return None if initial_data is None else base64.b64decode(initial_data, validate=True)
    except (binascii.Error, ValueError):
        return None
