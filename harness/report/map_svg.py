"""Draw the map as SVG: flight paths, groups of connected vehicles, and vehicle IDs.

No information depends on colour alone. Parts have letters and dashes, vehicles have IDs, and each mark has a tooltip.
The colours are in `map.css`, so the page must include STYLE.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from markupsafe import Markup

from harness.archive.connectivity import quality
from harness.archive.tracks import PositionFix
from harness.present import text as words
from harness.present.colours import AgentColours
from harness.present.svg import FONT, n
from harness.report.map_parts import (
    FlightPath,
    GroundRectangle,
    MapProjection,
    NetworkDivision,
    Point,
    TrackSegment,
    letter,
    listed,
    thin,
)
from sitl.vehicle import VehicleType

HEIGHT, DIGIT, PADDING = 16, 7.5, 8
NEAR, FAR = 14, 34
"""Distances in pixels between a place on the map and the middle of its tag. `FAR` is used if a tag has no room at
`NEAR`.
"""
_DIRECTIONS = ((0, -1), (0, 1), (1, -1), (-1, -1), (1, 1), (-1, 1), (1, 0), (-1, 0))

Box = tuple[float, float, float, float]
"""A rectangle in pixels: left, top, right, bottom."""


def tags(
    tagged: Sequence[tuple[int, Point]], crosses: Sequence[Point], to_px: MapProjection, ink: Mapping[int, AgentColours]
) -> Markup:
    """Draw tags with vehicle IDs. A tag overlaps no other tag and no point in `crosses`. If there is no room for a tag,
    only the tooltip of the vehicle shows its ID.
    """
    occupied = [(x - 5, y - 5, x + 5, y + 5) for x, y in (*(place for _, place in tagged), *crosses)]
    drawn = []
    for vehicle, place in tagged:
        for box in _boxes(len(str(vehicle)), place):
            if _inside(box, to_px) and not any(_overlap(box, occupied_box) for occupied_box in occupied):
                occupied.append(box)
                drawn.append(_tag(vehicle, box, place, ink[vehicle]))
                break
    return Markup("").join(drawn)


def _boxes(digits: int, place: Point) -> list[Box]:
    """Return the possible rectangles for a tag beside a place on the map. The best rectangle is first."""
    width = digits * DIGIT + PADDING
    boxes = []
    for distance in (NEAR, FAR):
        for right, down in _DIRECTIONS:
            x = place[0] + right * (distance - HEIGHT / 2 + width / 2)
            y = place[1] + down * distance
            boxes.append((x - width / 2, y - HEIGHT / 2, x + width / 2, y + HEIGHT / 2))
    return boxes


def _tag(vehicle: int, box: Box, place: Point, ink: AgentColours) -> Markup:
    left, top, right, bottom = box
    x, y = (left + right) / 2, (top + bottom) / 2
    leader = Markup('<path class="leader" d="M{} {}L{} {}"/>').format(n(place[0]), n(place[1]), n(x), n(y))
    return Markup(
        '{}<rect x="{}" y="{}" width="{}" height="{}" rx="3" fill="{}" stroke="{}"{}/>'
        '<text x="{}" y="{}" text-anchor="middle" fill="{}">{}</text>'
    ).format(
        leader if abs(y - place[1]) > HEIGHT or abs(x - place[0]) > right - left + HEIGHT else "",
        n(left),
        n(top),
        n(right - left),
        n(bottom - top),
        ink.fill,
        ink.stroke,
        Markup(' stroke-dasharray="4 2"') if ink.dashed else "",
        n(x),
        n(y + 4.3),
        ink.text,
        vehicle,
    )


def _inside(box: Box, to_px: MapProjection) -> bool:
    left, top, right, bottom = box
    return (
        left >= to_px.left
        and top >= to_px.top
        and right <= to_px.left + to_px.width
        and bottom <= to_px.top + to_px.height
    )


def _overlap(first: Box, second: Box) -> bool:
    return first[0] < second[2] and second[0] < first[2] and first[1] < second[3] and second[1] < first[3]


STYLE = (Path(__file__).parent / "map.css").read_text(encoding="utf-8")

PART_CLASSES = 4
"""Number of different line styles for the parts of a swarm. Further parts use the same styles again, but have other
letters.
"""
TRACK_CLASSES = ("unknown", "whole", *(f"part{number}" for number in range(PART_CLASSES)), "alone")
MAX_POINTS = 20_000
MAX_LINKS = 1500
"""Maximum number of links that the map of one moment shows. The map shows the shortest links."""
MOST_TAGGED_AT_A_MOMENT = 15
"""Maximum number of vehicles with ID tags in a small map."""

_LEFT, _RIGHT, _TOP, _BOTTOM = 62, 14, 14, 62
_ROOM_WIDTH, _ROOM_HEIGHT = 900, 600
_MOMENT_WIDTH, _MOMENT_HEIGHT = 300, 240


def css_class(division: NetworkDivision | None, vehicle: int) -> str:
    """Return the CSS class of a vehicle. The class depends on the part of the swarm to which the vehicle belongs."""
    if division is None:
        return "unknown"
    if vehicle in division.together:
        return "whole"
    part = division.part_of(vehicle)
    return "alone" if part is None else f"part{part % PART_CLASSES}"


def draw_tracks(
    flights: Sequence[FlightPath],
    reboots: Sequence[tuple[PositionFix, int]],
    land: GroundRectangle,
    ink: Mapping[int, AgentColours],
    description: str,
) -> Markup:
    """Draw the map. `reboots` contains the position and the agent of each reboot. `description` is a text about the
    picture for readers who cannot see it.
    """
    to_px = MapProjection(land, _LEFT, _TOP, _ROOM_WIDTH, _ROOM_HEIGHT)
    return Markup(
        '<svg xmlns="http://www.w3.org/2000/svg" class="map" role="img" width="{w}" height="{h}" viewBox="0 0 {w} {h}"'
        ' aria-labelledby="tracks-title tracks-desc" font-family="{font}" font-size="12">'
        '<title id="tracks-title">Map of the tracks</title><desc id="tracks-desc">{desc}</desc>\n'
        "{frame}\n{tracks}\n{marks}</svg>\n"
    ).format(
        w=n(_LEFT + to_px.width + _RIGHT),
        h=n(_TOP + to_px.height + _BOTTOM),
        font=FONT,
        desc=description,
        frame=frame(to_px),
        tracks=_track_paths([segment for flight in flights for segment in flight.segments], to_px),
        marks=_marks(flights, reboots, to_px, ink),
    )


def draw_moment(
    swarm: Mapping[int, PositionFix],
    lost: Sequence[PositionFix],
    links: Mapping[tuple[int, int], float],
    division: NetworkDivision | None,
    land: GroundRectangle,
    ink: Mapping[int, AgentColours],
    types: Mapping[int, VehicleType],
    description: str,
) -> Markup:
    """Draw the living vehicles, the loss rates of their links, and the places where vehicles were lost."""
    to_px = MapProjection(land, 1, 1, _MOMENT_WIDTH, _MOMENT_HEIGHT)
    at = {vehicle: to_px(fix) for vehicle, fix in swarm.items()}
    dots = (_dot(vehicle, place, division, ink[vehicle], types.get(vehicle, "copter")) for vehicle, place in at.items())
    tagged = list(at.items()) if len(at) <= MOST_TAGGED_AT_A_MOMENT else []
    return Markup(
        '<svg xmlns="http://www.w3.org/2000/svg" class="map" role="img" width="{w}" height="{h}" viewBox="0 0 {w} {h}"'
        ' preserveAspectRatio="xMinYMin" aria-label="{desc}" font-family="{font}" font-size="12">'
        '<rect class="frame" x="1" y="1" width="{fw}" height="{fh}"/>{links}{crosses}{dots}{tags}</svg>'
    ).format(
        w=n(to_px.width + 2),
        h=n(to_px.height + 2),
        fw=n(to_px.width),
        fh=n(to_px.height),
        desc=description,
        font=FONT,
        links=_links(at, links, division),
        crosses=Markup("").join(_cross(to_px(fix), "vehicle lost here") for fix in lost),
        dots=Markup("").join(dots),
        tags=tags(tagged, [to_px(fix) for fix in lost], to_px, ink),
    )


def _links(at: Mapping[int, Point], links: Mapping[tuple[int, int], float], division: NetworkDivision | None) -> Markup:
    """Draw the links between vehicles. Links with small loss rates are drawn last, so that they cover the
    other links.
    """
    drawn: dict[tuple[int, str], list[str]] = {}
    shortest = sorted(links, key=lambda pair: math.dist(at[pair[0]], at[pair[1]]))
    for vehicle, neighbour in shortest[:MAX_LINKS]:
        (x1, y1), (x2, y2) = at[vehicle], at[neighbour]
        which = quality(links[vehicle, neighbour]), css_class(division, vehicle)
        drawn.setdefault(which, []).append(f"M{n(x1)} {n(y1)}L{n(x2)} {n(y2)}")
    return Markup("").join(
        Markup('<path class="link {} q{}" d="{}"/>').format(which, grade, "".join(lines))
        for (grade, which), lines in sorted(drawn.items(), key=lambda links: (-links[0][0], links[0][1]))
    )


def _dot(
    vehicle: int, place: Point, division: NetworkDivision | None, ink: AgentColours, vehicle_type: VehicleType
) -> Markup:
    tip = f"vehicle {vehicle}, a {vehicle_type}: {_connection_text(division, vehicle)}"
    return Markup('<path class="dot {}" d="{}" fill="{}"><title>{}</title></path>').format(
        css_class(division, vehicle), _shape(vehicle_type, place), ink.fill, tip
    )


def _shape(vehicle_type: VehicleType, place: Point) -> str:
    """Return the shape for a type of vehicle: a circle for a copter, a triangle for a plane, a square for a rover."""
    x, y = place
    match vehicle_type:
        case "copter":
            return f"M{n(x - 4.5)} {n(y)}a4.5 4.5 0 1 1 9 0a4.5 4.5 0 1 1-9 0z"
        case "plane":
            return f"M{n(x)} {n(y - 6)}l5.5 10h-11z"
        case "rover":
            return f"M{n(x - 4)} {n(y - 4)}h8v8h-8z"


def sample(which: str) -> Markup:
    """Draw a sample line or mark for the legend. `which` is one of LOOKS, "start", "end", "lost", "reboot", a link
    quality such as "q1", or a vehicle type.
    """
    place = (17.0, 8.0)
    match which:
        case "start":
            shape = start_mark(place, "start", "currentColor", "currentColor")
        case "end":
            shape = end_mark(place, "end", "currentColor", "currentColor")
        case "lost":
            shape = _cross(place, "lost")
        case "reboot":
            shape = _diamond(place, "reboot")
        case "copter" | "plane" | "rover":
            shape = Markup('<path d="{}" fill="currentColor"/>').format(_shape(which, place))
        case _ if which.startswith("q"):
            shape = Markup('<path class="link whole {}" d="M1 8h32"/>').format(which)
        case _:
            shape = Markup('<path class="way {}" d="M1 8h32"/>').format(which)
    return Markup('<svg width="34" height="16" aria-hidden="true">{}</svg>').format(shape)


def frame(to_px: MapProjection) -> Markup:
    """Draw the frame of the map: a grid with labels in metres, the scale bar, and a north arrow."""
    left, top = to_px.left, to_px.top
    right, bottom = left + to_px.width, top + to_px.height
    north, east = to_px.ticks_m()
    rules = [f"M{n(left)} {n(to_px.y(metres))}H{n(right)}" for metres in north]
    rules += [f"M{n(to_px.x(metres))} {n(top)}V{n(bottom)}" for metres in east]
    texts = [_text(left - 7, to_px.y(metres) + 4, "end", words.value(round(metres, 6))) for metres in north]
    texts += [_text(to_px.x(metres), bottom + 17, "middle", words.value(round(metres, 6))) for metres in east]
    bar_m = to_px.scale_bar_m()
    bar_px, y = bar_m * to_px.px_per_m, bottom + 44
    return Markup(
        '<path class="rule" d="{}"/><rect class="frame" x="{}" y="{}" width="{}" height="{}"/>{}{}{}'
        '<path class="bar" d="M{} {}v5h{}v-5"><title>scale bar</title></path>{}'
        '<path class="arrow" d="M{} {}v-16m-4 6l4-6 4 6"/>{}'
    ).format(
        "".join(rules),
        n(left),
        n(top),
        n(to_px.width),
        n(to_px.height),
        Markup("").join(texts),
        _text(left, bottom + 36, "start", "metres east"),
        Markup(
            '<text class="quiet" text-anchor="end" transform="translate(14 {}) rotate(-90)">metres north</text>'
        ).format(n(top)),
        n(right - bar_px),
        n(y),
        n(bar_px),
        _text(right - bar_px - 8, y + 5, "end", f"{words.value(round(bar_m, 6))}\u00a0m"),
        n(right - bar_px - 92),
        n(y + 6),
        _text(right - bar_px - 82, y + 5, "start", "N"),
    )


def _track_paths(segments: Sequence[TrackSegment], to_px: MapProjection) -> Markup:
    """Draw the flight paths. The sections in which a vehicle belongs to a part of the swarm are drawn last, so that
    they cover the other sections.
    """
    lines = thin([[to_px(fix) for fix in segment.fixes] for segment in segments], MAX_POINTS)
    classes = [css_class(segment.division, segment.vehicle) for segment in segments]
    drawn = sorted(zip(classes, segments, lines, strict=True), key=lambda track: TRACK_CLASSES.index(track[0]))
    return Markup("\n").join(
        Markup('<path class="way {}" d="M{}"><title>{}</title></path>').format(
            which, "L".join(f"{n(x)} {n(y)}" for x, y in line), _segment_tip(segment)
        )
        for which, segment, line in drawn
    )


def _segment_tip(segment: TrackSegment) -> str:
    begin, end = (words.duration(segment.fixes[at].at_s) for at in (0, -1))
    return f"vehicle {segment.vehicle}, {begin} to {end}: {_connection_text(segment.division, segment.vehicle)}"


def _connection_text(division: NetworkDivision | None, vehicle: int) -> str:
    if division is None:
        return "network not recorded"
    part, reachable_from = division.place_of(vehicle)
    others = listed(reachable_from - {vehicle})
    if not others:
        return "alone"
    return f"connected to all others: {others}" if part is None else f"part {letter(part)}, with {others}"


def _marks(
    flights: Sequence[FlightPath],
    reboots: Iterable[tuple[PositionFix, int]],
    to_px: MapProjection,
    ink: Mapping[int, AgentColours],
) -> Markup:
    """Draw the marks for the starts, the reboots and the ends of flight paths. The ends have tags with the
    vehicle IDs.
    """
    parts = []
    for flight in flights:
        colours, start, end = ink[flight.vehicle], flight.start, flight.end
        begins = f"vehicle {flight.vehicle} starts at {words.duration(start.at_s)}"
        ends = f"vehicle {flight.vehicle} {'is lost' if flight.lost else 'ends'} at {words.duration(end.at_s)}"
        parts.append(start_mark(to_px(start), begins, colours.fill, colours.stroke))
        parts.append(
            _cross(to_px(end), ends) if flight.lost else end_mark(to_px(end), ends, colours.fill, colours.stroke)
        )
    parts += [
        _diamond(to_px(fix), f"agent {vehicle} reboots at {words.duration(fix.at_s)}") for fix, vehicle in reboots
    ]
    return Markup("").join(parts) + tags([(flight.vehicle, to_px(flight.end)) for flight in flights], [], to_px, ink)


def start_mark(place: Point, tip: str, fill: str, stroke: str) -> Markup:
    return Markup('<rect x="{}" y="{}" width="7" height="7" fill="{}" stroke="{}"><title>{}</title></rect>').format(
        n(place[0] - 3.5), n(place[1] - 3.5), fill, stroke, tip
    )


def end_mark(place: Point, tip: str, fill: str, stroke: str) -> Markup:
    return Markup('<circle cx="{}" cy="{}" r="4.5" fill="{}" stroke="{}"><title>{}</title></circle>').format(
        n(place[0]), n(place[1]), fill, stroke, tip
    )


def _cross(place: Point, tip: str) -> Markup:
    return Markup('<path class="lost" d="M{} {}l10 10m0-10l-10 10"><title>{}</title></path>').format(
        n(place[0] - 5), n(place[1] - 5), tip
    )


def _diamond(place: Point, tip: str) -> Markup:
    return Markup('<path class="reboot" d="M{} {}l5 5-5 5-5-5z"><title>{}</title></path>').format(
        n(place[0]), n(place[1] - 5), tip
    )


def _text(x: float, y: float, anchor: str, text: str) -> Markup:
    return Markup('<text class="quiet" x="{}" y="{}" text-anchor="{}">{}</text>').format(n(x), n(y), anchor, text)
