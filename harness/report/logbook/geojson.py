"""Tracks as GeoJSON (RFC 7946): a LineString for each vehicle, a Point for each event."""

from collections.abc import Iterable, Iterator
from typing import Any

from harness.report.logbook.positions import Entry, Track, coordinates, utc
from ucp.telemetry import describe


def geojson(tracks: Iterable[Track]) -> dict[str, Any]:
    """A FeatureCollection. Altitudes are above mean sea level, as the autopilot's.

    A LineString's property `times` has the time of each of its positions; a vehicle with a single position has no
    LineString. An event that is no position is where the vehicle last was, `position_age_s` seconds before; one before
    the first position is nowhere: its geometry is null.
    """
    return {"type": "FeatureCollection", "features": [feature for track in tracks for feature in _features(track)]}


def _features(track: Track) -> Iterator[dict[str, Any]]:
    fixes = track.fixes
    if len(fixes) >= 2:
        line = {"type": "LineString", "coordinates": [coordinates(position) for _, position in fixes]}
        times = [utc(timestamp_us) for timestamp_us, _ in fixes]
        yield {"type": "Feature", "geometry": line, "properties": {"agent": track.agent_id, "times": times}}
    for entry in track.entries:
        yield {"type": "Feature", "geometry": _point(entry), "properties": _properties(track, entry)}


def _point(entry: Entry) -> dict[str, Any] | None:
    return {"type": "Point", "coordinates": coordinates(entry.position)} if entry.position else None


def _properties(track: Track, entry: Entry) -> dict[str, Any]:
    return {
        "agent": track.agent_id,
        "block": entry.block,
        "time": utc(entry.event.timestamp_us),
        "event_id": entry.event.event_id,
        "words": describe(entry.event.event_id, entry.event.data),
        "position_age_s": entry.position_age_s,
    }
