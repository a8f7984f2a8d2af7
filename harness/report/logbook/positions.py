"""Find the positions of vehicles over time, in logged events or in the flight paths that the run recorded.

The events of a vehicle come from all surviving copies of its blocks, in all chains, deques and reconcile stacks. The
track of a lost vehicle therefore ends with the last of its blocks that another agent holds.

Map files contain flight paths and events: GeoJSON (RFC 7946) and KML 2.2.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, NamedTuple, Protocol
from xml.etree import ElementTree

from harness.archive.exports import ExportedBlock
from harness.archive.run_record import RunRecord
from harness.archive.tracks import PositionFix, VehicleTracks
from harness.report.logbook import Logbook
from sitl.vehicle import Home
from ucp.events import LoggableEvent, MalformedEventsError
from ucp.telemetry import describe, position_of

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


def geojson(tracks: Iterable[EventTrack]) -> dict[str, object]:
    """Return a GeoJSON FeatureCollection. Altitudes are metres above mean sea level.

    The property `times` of a LineString holds the time of each position. A vehicle with a single position has no
    LineString. An event that is no position gets the last known position of the vehicle. `position_age_s` is the age of
    this position in seconds. Events before the first position have the geometry null.
    """
    return {"type": "FeatureCollection", "features": [feature for track in tracks for feature in _features(track)]}


def _features(track: EventTrack) -> Iterator[dict[str, Any]]:
    fixes = track.fixes
    if len(fixes) >= 2:
        line = {"type": "LineString", "coordinates": [coordinates(position) for _, position in fixes]}
        times = [utc(timestamp_us) for timestamp_us, _ in fixes]
        yield {"type": "Feature", "geometry": line, "properties": {"agent": track.agent_id, "times": times}}
    for entry in track.entries:
        yield {"type": "Feature", "geometry": _point(entry), "properties": _properties(track, entry)}


def _point(entry: LogEntry) -> dict[str, object] | None:
    return {"type": "Point", "coordinates": coordinates(entry.position)} if entry.position else None


def _properties(track: EventTrack, entry: LogEntry) -> dict[str, object]:
    return {
        "agent": track.agent_id,
        "block": entry.block,
        "time": utc(entry.event.timestamp_us),
        "event_id": entry.event.event_id,
        "words": describe(entry.event.event_id, entry.event.data),
        "position_age_s": entry.position_age_s,
    }


_KML, _GX = "http://www.opengis.net/kml/2.2", "http://www.google.com/kml/ext/2.2"
ElementTree.register_namespace("", _KML)
ElementTree.register_namespace("gx", _GX)


def kml(tracks: Iterable[EventTrack]) -> str:
    """Return a KML document. The folder of each vehicle contains its flight path and its other events with their times.

    Altitudes are in metres above mean sea level. An event gets the last known position of the vehicle. Events before
    the first position are omitted.
    """
    root = ElementTree.Element(f"{{{_KML}}}kml")
    document = _add(root, "Document")
    for track in tracks:
        folder = _add(document, "Folder")
        _add(folder, "name", f"vehicle {track.agent_id}")
        _written_track(folder, track)
        for entry in track.entries:
            if not entry.is_position:
                _placemark(folder, entry)
    ElementTree.indent(root)
    xml: bytes = ElementTree.tostring(root, encoding="UTF-8", xml_declaration=True)
    return xml.decode() + "\n"


def _written_track(folder: ElementTree.Element, track: EventTrack) -> None:
    placemark = _add(folder, "Placemark")
    _add(placemark, "name", f"track of vehicle {track.agent_id}")
    line = ElementTree.SubElement(placemark, f"{{{_GX}}}Track")
    _add(line, "altitudeMode", "absolute")
    for timestamp_us, _ in track.fixes:
        _add(line, "when", utc(timestamp_us))
    for _, position in track.fixes:
        coord = ElementTree.SubElement(line, f"{{{_GX}}}coord")
        coord.text = _numbers(position, " ")


def _placemark(folder: ElementTree.Element, entry: LogEntry) -> None:
    if entry.position is None:
        return
    placemark = _add(folder, "Placemark")
    _add(placemark, "name", describe(entry.event.event_id, entry.event.data))
    _add(placemark, "description", f"block {entry.block}; the position is {entry.position_age_s:.0f} s older")
    _add(_add(placemark, "TimeStamp"), "when", utc(entry.event.timestamp_us))
    point = _add(placemark, "Point")
    _add(point, "altitudeMode", "absolute")
    _add(point, "coordinates", _numbers(entry.position, ","))


def _numbers(position: GlobalPosition, separator: str) -> str:
    lon, lat, alt = coordinates(position)
    return f"{lon:.7f}{separator}{lat:.7f}{separator}{alt:.3f}"


def _add(parent: ElementTree.Element, tag: str, text: str | None = None) -> ElementTree.Element:
    element = ElementTree.SubElement(parent, f"{{{_KML}}}{tag}")
    element.text = text
    return element
