"""Draw a map of logged events.

The path of each vehicle is a line, and an event without a position is drawn at the last position of its vehicle. A ring
marks a block that only one vehicle holds. The loss of this vehicle would have destroyed the block. The line is dotted
where blocks of the vehicle were lost: between the last position before and the first position after these blocks.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

from markupsafe import Markup

from harness.archive.tracks import PositionFix
from harness.present import text
from harness.present.colours import AgentColours
from harness.present.svg import FONT, n
from harness.report.logbook.positions import EventTrack, GlobalPosition, LogEntry
from harness.report.map_parts import MapProjection, Point, extent, thin
from harness.report.map_svg import end_mark, frame, start_mark, tags
from ucp.telemetry import describe

METRES_PER_DEGREE = 111_195.0
"""Metres per degree of latitude, on a sphere with a radius of 6371 km."""
FARTHEST_M = 1e6
MAX_POINTS = 20_000
MAX_FIXES = 50_000
MAX_EVENTS = 2_000
_LEFT, _TOP, _RIGHT, _BOTTOM = 62, 14, 14, 62
_WIDTH, _HEIGHT = 900, 560


@dataclass(frozen=True)
class EventMap:
    """A map with the positions of events, and sentences about the events that the map does not show."""

    drawing: Markup
    notes: list[str]


def draw(
    tracks: Sequence[EventTrack],
    rare: Iterable[str],
    lost: Mapping[int, Sequence[int]],
    ink: Mapping[int, AgentColours],
    flown: Sequence[EventTrack] = (),
) -> EventMap:
    """Draw the map. `rare` contains the names of blocks that only one vehicle holds. `lost` maps each agent to the
    numbers of its lost blocks. `flown` contains the paths from flight logs. At least one path must contain a position.
    """
    field = _MetricProjection([*tracks, *flown])
    paths = {track.agent_id: [field.fix(at_us, position) for at_us, position in track.fixes] for track in tracks}
    flown_paths = [[field.fix(at_us, position) for at_us, position in track.fixes] for track in flown]
    far_positions = field.far_positions
    extent_of_map = extent([fix for path in (*paths.values(), *flown_paths) for fix in path])
    projection = MapProjection(extent_of_map, _LEFT, _TOP, _WIDTH, _HEIGHT)
    single_copies = set(rare)
    vehicles = {track.agent_id for track in (*tracks, *flown)}
    logged = [event for track in tracks for event in _logged(track, single_copies)]
    # single copies are drawn last, on top
    shown = sorted(logged[:: -(-len(logged) // MAX_EVENTS) or 1], key=lambda event: event[0])
    drawing = Markup(
        '<svg xmlns="http://www.w3.org/2000/svg" class="map" role="img" width="{w}" height="{h}" viewBox="0 0 {w} {h}"'
        ' aria-labelledby="map-title map-desc" font-family="{font}" font-size="12">'
        '<title id="map-title">Map of logged events</title><desc id="map-desc">{desc}</desc>\n'
        "{frame}\n{flown}\n{paths}\n{marks}\n{ends}</svg>\n"
    ).format(
        w=n(_LEFT + projection.width + _RIGHT),
        h=n(_TOP + projection.height + _BOTTOM),
        font=FONT,
        desc=f"Positions of {len(vehicles)} vehicles, {extent_of_map.width_m:.0f} m from west to east.",
        frame=frame(projection),
        flown=_flown(flown, flown_paths, projection, ink),
        paths=_paths(tracks, paths, lost, projection, ink),
        marks=Markup("").join(
            _mark(projection(field.fix(entry.event.timestamp_us, entry.position)), entry, rare, ink[agent_id])
            for rare, agent_id, entry in shown
            if entry.position is not None
        ),
        ends=_ends(paths, projection, ink),
    )
    notes = [] if len(shown) == len(logged) else [f"The map shows {len(shown)} of {len(logged)} events."]
    if far_positions:
        notes.append(f"{far_positions} positions more than {FARTHEST_M / 1000:.0f} km away are at the edge.")
    return EventMap(drawing, notes)


class _MetricProjection:
    """A converter from positions to metres north and east of the median of all positions."""

    def __init__(self, tracks: Sequence[EventTrack]) -> None:
        positions = [position for track in tracks for _, position in track.fixes]
        self._lat = sorted(position.lat_e7 for position in positions)[len(positions) // 2] / 1e7
        self._lon = sorted(position.lon_e7 for position in positions)[len(positions) // 2] / 1e7
        self._east = METRES_PER_DEGREE * max(0.01, math.cos(math.radians(self._lat)))
        self._first_us = min(at_us for track in tracks for at_us, _ in track.fixes)
        self.far_positions = 0

    def fix(self, at_us: int, position: GlobalPosition) -> PositionFix:
        north_m = (position.lat_e7 / 1e7 - self._lat) * METRES_PER_DEGREE
        east_m = ((position.lon_e7 / 1e7 - self._lon + 180) % 360 - 180) * self._east
        self.far_positions += max(abs(north_m), abs(east_m)) > FARTHEST_M
        at_s = (at_us - self._first_us) / 1e6
        return PositionFix(at_s, *(max(-FARTHEST_M, min(FARTHEST_M, metres)) for metres in (north_m, east_m)))


def _flown(
    tracks: Sequence[EventTrack],
    paths: Sequence[Sequence[PositionFix]],
    projection: MapProjection,
    ink: Mapping[int, AgentColours],
) -> Markup:
    stride = sum(map(len, paths)) // MAX_FIXES + 1
    lines = thin([[projection(fix) for fix in (*path[:-1:stride], path[-1])] for path in paths], MAX_POINTS)
    return Markup("\n").join(
        Markup('<g class="track flown"><title>flight log of vehicle {}</title><path d="{}" stroke="{}"/></g>').format(
            track.agent_id, "M" + "L".join(f"{n(x)} {n(y)}" for x, y in line), ink[track.agent_id].fill
        )
        for track, line in zip(tracks, lines, strict=True)
    )


def _paths(
    tracks: Sequence[EventTrack],
    paths: Mapping[int, Sequence[PositionFix]],
    lost: Mapping[int, Sequence[int]],
    projection: MapProjection,
    ink: Mapping[int, AgentColours],
) -> Markup:
    pieces = [(track, gap, piece) for track in tracks for gap, piece in _pieces(track, paths[track.agent_id], lost)]
    stride = sum(map(len, paths.values())) // MAX_FIXES + 1  # thinning visits each point several times
    lines = thin([[projection(fix) for fix in (*piece[:-1:stride], piece[-1])] for _, _, piece in pieces], MAX_POINTS)
    drawn = []
    for (track, gap, _), line in zip(pieces, lines, strict=True):
        path = "M" + "L".join(f"{n(x)} {n(y)}" for x, y in line)
        tip = f"vehicle {track.agent_id}" + (": blocks lost here" if gap else "")
        colours = ink[track.agent_id]
        drawn.append(
            Markup(
                '<g class="{}"><title>{}</title><path class="edge" d="{p}" stroke="{}"/><path d="{p}" stroke="{}"/></g>'
            ).format("track gap" if gap else "track", tip, colours.stroke, colours.fill, p=path)
        )
    return Markup("\n").join(drawn)


def _pieces(
    track: EventTrack, path: Sequence[PositionFix], lost: Mapping[int, Sequence[int]]
) -> Iterable[tuple[bool, Sequence[PositionFix]]]:
    """Divide the path of a vehicle into pieces. For each piece, yield whether it is a gap, and its positions. A gap
    connects two positions between which blocks were lost.
    """
    missing = lost.get(track.agent_id, ())
    ordinals = [_ordinal(entry.block) for entry in track.entries if entry.is_position]
    begin = 0
    for at, (before, after) in enumerate(pairwise(ordinals), 1):
        if before and after and any(before < ordinal < after for ordinal in missing):
            yield False, path[begin:at]
            yield True, path[at - 1 : at + 1]
            begin = at
    yield False, path[begin:]


def _ordinal(name: str) -> int | None:
    ordinal = name.partition(".")[2]
    return int(ordinal) if ordinal.isdecimal() else None


def _logged(track: EventTrack, single_copies: set[str]) -> Iterable[tuple[bool, int, LogEntry]]:
    """Yield three values for each event that the map marks: whether only one vehicle holds the block of the event, the
    agent ID, and the event.
    """
    for entry in track.entries:
        rare = entry.block in single_copies
        if entry.position is not None and (rare or not entry.is_position):
            yield rare, track.agent_id, entry


def _mark(place: Point, entry: LogEntry, rare: bool, ink: AgentColours) -> Markup:
    tip = [
        describe(entry.event.event_id, entry.event.data),
        text.moment(entry.event.timestamp_us),
        f"block {entry.block}" + (", held by one vehicle" if rare else ""),
    ]
    return Markup('<circle class="{}" cx="{}" cy="{}" r="{}" fill="{}"><title>{}</title></circle>').format(
        "logged rare" if rare else "logged", n(place[0]), n(place[1]), 3 if rare else 2.5, ink.fill, "\n".join(tip)
    )


def _ends(
    paths: Mapping[int, Sequence[PositionFix]], projection: MapProjection, ink: Mapping[int, AgentColours]
) -> Markup:
    parts = []
    for agent_id, path in paths.items():
        colours = ink[agent_id]
        first, last = f"first position of vehicle {agent_id}", f"last position of vehicle {agent_id}"
        parts.append(start_mark(projection(path[0]), first, colours.fill, colours.stroke))
        parts.append(end_mark(projection(path[-1]), last, colours.fill, colours.stroke))
    return Markup("").join(parts) + tags(
        [(agent_id, projection(path[-1])) for agent_id, path in paths.items()], [], projection, ink
    )
