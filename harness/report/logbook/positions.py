"""Find the positions of vehicles over time, in logged events or in the flight paths that the run recorded.

The events of a vehicle come from all surviving copies of its blocks, in all chains, deques and reconcile stacks. The
track of a lost vehicle therefore ends with the last of its blocks that another agent holds.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import NamedTuple, Protocol

from harness.archive.exports import ExportedBlock
from harness.archive.run_record import RunRecord
from harness.archive.tracks import PositionFix, VehicleTracks
from harness.report.logbook import Logbook
from sitl.vehicle import Home
from ucp.events import LoggableEvent, MalformedEventsError
from ucp.telemetry import position_of

LAST_TIMESTAMP_US = 253_402_300_799_999_999
"""The last microsecond of the year 9999. Map programs cannot show later times."""


class GlobalPosition(Protocol):
    """A position in units of 1e-7 degrees, with an altitude in millimetres above mean sea level."""

    @property
    def lat_e7(self) -> int: ...
    @property
    def lon_e7(self) -> int: ...
    @property
    def alt_mm(self) -> int: ...


@dataclass(frozen=True)
class LogEntry:
    """One event of an agent."""

    block: str
    """The name of the block that contains the event."""
    event: LoggableEvent
    is_position: bool
    position: GlobalPosition | None
    """The position in the event. If the event contains no position, this is the last position of the vehicle before the
    event. The value is None if no earlier position is known.
    """
    position_age_s: float | None
    """The age of the position at the time of the event, in seconds."""


@dataclass(frozen=True)
class EventTrack:
    """The events of one agent."""

    agent_id: int
    entries: list[LogEntry]
    """All events of the agent, with the oldest first."""
    fixes: list[tuple[int, GlobalPosition]]
    """The positions of the vehicle, with timestamps in microseconds."""


def tracks(logbook: Logbook) -> list[EventTrack]:
    """Return one track for each agent that logged positions, in order of agent IDs. The list is empty if the events are
    not telemetry.
    """
    if not logbook.telemetry:
        return []
    blocks: dict[int, dict[tuple[int, str], ExportedBlock]] = {}
    for export in logbook.exports.values():
        for block in export.blocks():
            blocks.setdefault(block.agent_id, {})[block.timestamp_us, block.event_data] = block
    all_tracks = (track_of(agent_id, _events(logbook, blocks[agent_id].values())) for agent_id in sorted(blocks))
    return [track for track in all_tracks if track.fixes]


def coordinates(position: GlobalPosition) -> tuple[float, float, float]:
    """Return longitude and latitude in degrees, and altitude in metres above mean sea level."""
    return position.lon_e7 / 1e7, position.lat_e7 / 1e7, position.alt_mm / 1e3


def utc(timestamp_us: int) -> str:
    """Return a timestamp in the format of RFC 3339, with milliseconds. The year is at most 9999."""
    at = datetime.fromtimestamp(timestamp_us // 1_000_000, UTC)
    return f"{at:%Y-%m-%dT%H:%M:%S}.{timestamp_us // 1000 % 1000:03d}Z"


def _events(logbook: Logbook, blocks: Iterable[ExportedBlock]) -> list[tuple[LoggableEvent, str]]:
    """Return the events in these blocks, with the names of the blocks. Unreadable blocks are skipped."""
    logged = []
    for block in blocks:
        try:
            events = logbook.event_data.events(block)
        except MalformedEventsError:
            continue
        name = logbook.name(block.block_hash)
        logged += [(event, name) for event in events]
    return logged


def track_of(agent_id: int, logged: Iterable[tuple[LoggableEvent, str]]) -> EventTrack:
    """Return a track that contains these events in order of time. Events with an impossible time are omitted."""
    track = EventTrack(agent_id, [], [])
    possible = [pair for pair in logged if pair[0].timestamp_us <= LAST_TIMESTAMP_US]
    for event, block in sorted(possible, key=lambda pair: pair[0].timestamp_us):
        own = position_of(event.event_id, event.data)
        if own is not None:
            track.fixes.append((event.timestamp_us, own))
        at_us, position = track.fixes[-1] if track.fixes else (None, None)
        age_s = None if at_us is None else (event.timestamp_us - at_us) / 1e6
        track.entries.append(LogEntry(block, event, own is not None, position, age_s))
    return track


class RoundedPosition(NamedTuple):
    """A position on Earth in units of 1e-7 degrees, with an altitude in millimetres above mean sea level."""

    lat_e7: int
    lon_e7: int
    alt_mm: int


def recorded_tracks(record: RunRecord, recorded: VehicleTracks) -> list[EventTrack]:
    """Return a track without events for each vehicle whose flight path the run recorded. Recorded positions are
    relative to the home position in the scenario.
    """
    if record.scenario is None:
        return []
    home = record.scenario.vehicles.field
    return [_track(vehicle, fixes, home) for vehicle, fixes in recorded.by_vehicle.items()]


def _track(vehicle: int, fixes: Sequence[PositionFix], home: Home) -> EventTrack:
    return EventTrack(vehicle, [], [(round(fix.at_s * 1e6), _rounded_position(fix, home)) for fix in fixes])


def _rounded_position(fix: PositionFix, home: Home) -> RoundedPosition:
    position = home.offset(fix.north_m, fix.east_m)
    return RoundedPosition(
        round(position.lat_deg * 1e7), round(position.lon_deg * 1e7), round((position.alt_m + fix.up_m) * 1e3)
    )
