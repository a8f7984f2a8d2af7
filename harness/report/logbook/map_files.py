"""Write flight paths and events as map files: GeoJSON (RFC 7946) and KML 2.2."""

from collections.abc import Iterable, Iterator
from typing import Any
from xml.etree import ElementTree

from harness.report.logbook.positions import EventTrack, GlobalPosition, LogEntry, coordinates, utc
from ucp.telemetry import describe


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
        _track(folder, track)
        for entry in track.entries:
            if not entry.is_position:
                _placemark(folder, entry)
    ElementTree.indent(root)
    xml: bytes = ElementTree.tostring(root, encoding="UTF-8", xml_declaration=True)
    return xml.decode() + "\n"


def _track(folder: ElementTree.Element, track: EventTrack) -> None:
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
