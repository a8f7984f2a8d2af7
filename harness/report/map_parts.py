"""Compute the geometry of the map, and the groups of connected vehicles at each time.

A *part* of the swarm is a group of two or more vehicles that reach each other but not all vehicles. A vehicle that
reaches no other vehicle is alone. Parts have letters. A part keeps its letter in the next state if more than half of
its vehicles stay together.
"""

import math
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import count
from operator import attrgetter

from harness.archive.connectivity import Connectivity, Topology
from harness.archive.tracks import PositionFix, VehicleTracks, between
from harness.present import svg
from harness.report.chain_tree import ranges

MAX_SEGMENTS = 4000
"""Maximum number of track segments of all vehicles together. More segments could not be distinguished."""
MAX_NAMED = 6
"""Maximum number of groups of vehicles that a text lists."""


@dataclass(frozen=True, slots=True)
class NetworkDivision:
    """A division of the swarm into groups of connected vehicles (*parts*). It lasts from one network change to the
    next.
    """

    at_s: float
    """The mission second of the change with which the division begins."""
    what: str
    parts: dict[int, frozenset[int]]
    """The vehicles in each part, by the number of the part. There are no parts if all vehicles reach each other."""
    alone: frozenset[int]
    """The living vehicles that reach no other vehicle."""
    together: frozenset[int]
    """All living vehicles if all of them reach each other. Otherwise the set is empty."""

    @property
    def living(self) -> frozenset[int]:
        return self.together | self.alone | frozenset().union(*self.parts.values())

    def place_of(self, vehicle: int) -> tuple[int | None, frozenset[int]]:
        """Return the number of the part to which the vehicle belongs, and the vehicles that the vehicle reaches."""
        return self.part_of(vehicle), self.reachable_from(vehicle)

    def part_of(self, vehicle: int) -> int | None:
        """Return the number of the part of the swarm to which the vehicle belongs. Return None if the vehicle belongs
        to no part.
        """
        return next((number for number, members in self.parts.items() if vehicle in members), None)

    def reachable_from(self, vehicle: int) -> frozenset[int]:
        """Return the vehicles that this vehicle reaches. The vehicle itself is one of them."""
        part = self.part_of(vehicle)
        if part is not None:
            return self.parts[part]
        return self.together if vehicle in self.together else frozenset({vehicle})

    def changed_since(self, before: "NetworkDivision") -> int:
        """Return the number of vehicles that changed since the division `before`.

        A vehicle changed if it was lost or replaced, or if it reaches other vehicles than before. For this comparison,
        only vehicles that live in both divisions count as reached.
        """
        both = self.living & before.living
        moved = sum(self.reachable_from(vehicle) & both != before.reachable_from(vehicle) & both for vehicle in both)
        return moved + len(self.living ^ before.living)

    def in_words(self) -> str:
        """Return a text such as "all 5 connected" or "A 1-3; B 4, 5; alone 6"."""
        if self.together:
            return f"all {len(self.together)} connected" if len(self.together) > 1 else "1 vehicle"
        phrases = [f"{letter(number)} {listed(members)}" for number, members in self.parts.items()]
        if len(phrases) > MAX_NAMED:
            largest = max(self.parts.values(), key=len)
            phrases = [f"{len(phrases)} parts, the largest of {len(largest)}"]
        if self.alone:
            few = len(ranges(sorted(self.alone))) <= MAX_NAMED
            phrases.append(f"alone {listed(self.alone)}" if few else f"{len(self.alone)} alone")
        return "; ".join(phrases) or "no vehicle left"


@dataclass(frozen=True, slots=True)
class TrackSegment:
    """A section of a flight path on which the vehicle always belongs to the same part of the swarm. `division` is the
    division of the swarm at the start of the section.
    """

    vehicle: int
    fixes: list[PositionFix]
    division: NetworkDivision | None


@dataclass(frozen=True, slots=True)
class FlightPath:
    """The path of a vehicle from its start to its loss, or to the end of the run. If the start of the path is unknown,
    the path begins at the first known position.
    """

    vehicle: int
    segments: list[TrackSegment]
    lost: bool

    @property
    def start(self) -> PositionFix:
        return self.segments[0].fixes[0]

    @property
    def end(self) -> PositionFix:
        return self.segments[-1].fixes[-1]


def letter(number: int) -> str:
    """Return a letter for a number: A, B, ... Z, A2, B2, ..."""
    return chr(ord("A") + number % 26) + (str(number // 26 + 1) if number >= 26 else "")


def listed(vehicles: frozenset[int]) -> str:
    return ", ".join(ranges(sorted(vehicles)))


def divisions(states: Sequence[Topology]) -> list[NetworkDivision]:
    all_divisions: list[NetworkDivision] = []
    before: dict[int, frozenset[int]] = {}
    for state in states:
        if len(state.components) == 1:
            all_divisions.append(NetworkDivision(state.at_s, state.what, {}, frozenset(), state.components[0]))
            continue
        parts = [group for group in state.components if len(group) > 1]
        alone = frozenset().union(*(group for group in state.components if len(group) == 1))
        numbered = _numbered(parts, before)
        before = numbered or before
        all_divisions.append(NetworkDivision(state.at_s, state.what, numbered, alone, frozenset()))
    return all_divisions


def _numbered(parts: Sequence[frozenset[int]], before: dict[int, frozenset[int]]) -> dict[int, frozenset[int]]:
    """Number the parts of the swarm. If a part contains more than half of the vehicles of an earlier part, it gets the
    number of the earlier part. The other parts get the lowest free numbers.
    """
    numbers: dict[int, frozenset[int]] = {}
    for part in parts:
        shared = {number: len(part & members) for number, members in before.items() if number not in numbers}
        best = max(shared, key=lambda number: shared[number], default=None)
        if best is None or 2 * shared[best] <= len(before[best]):
            best = None
        numbers[best if best is not None else -1 - len(numbers)] = part
    free = (number for number in count() if number not in numbers)
    return dict(sorted((number if number >= 0 else next(free), part) for number, part in numbers.items()))


def longest_divisions(all_divisions: Sequence[NetworkDivision], end_s: float, most: int) -> list[NetworkDivision]:
    """Return at most `most` divisions of the swarm: the first one, and the ones that lasted longest. The map shows a
    division until the next returned division begins.
    """
    if len(all_divisions) <= most:
        return list(all_divisions)
    ends = [*(division.at_s for division in all_divisions[1:]), end_s]
    by_length = sorted(range(1, len(all_divisions)), key=lambda at: all_divisions[at].at_s - ends[at])
    return [all_divisions[at] for at in sorted([0, *by_length[: most - 1]])]


def flights(
    vehicle: int, tracks: VehicleTracks, network: Connectivity, all_divisions: Sequence[NetworkDivision], end_s: float
) -> Iterator[FlightPath]:
    """Yield the flight path of a vehicle. If the vehicle was lost and replaced, also yield the flight path of each
    replacement.
    """
    wreck: PositionFix | None = None
    for begin_s, until_s, lost in network.airborne_intervals(vehicle, end_s):
        flown = [fix for fix in tracks.by_vehicle[vehicle] if begin_s <= fix.at_s <= until_s]
        while wreck and flown and flown[0][1:] == wreck[1:]:  # the replacement still reports the position of the wreck
            del flown[0]
        if flown:
            end = tracks.at(vehicle, until_s)
            yield FlightPath(vehicle, list(_segments(vehicle, [*flown, end], all_divisions)), lost)
            wreck = end


def _segments(
    vehicle: int, path: list[PositionFix], all_divisions: Sequence[NetworkDivision]
) -> Iterator[TrackSegment]:
    now = next((division for division in reversed(all_divisions) if division.at_s <= path[0].at_s), None)
    begin = 0
    for division in all_divisions:
        unchanged = now is not None and now.place_of(vehicle) == division.place_of(vehicle)
        if unchanged or not path[0].at_s < division.at_s < path[-1].at_s:
            continue
        end = bisect_left(path, division.at_s, begin, key=attrgetter("at_s"))
        turn = between(path[end - 1], path[end], division.at_s)
        yield TrackSegment(vehicle, [*path[begin:end], turn], now)
        path[end - 1], begin, now = turn, end - 1, division
    yield TrackSegment(vehicle, path[begin:], now)


Point = tuple[float, float]
"""A point in CSS pixels. `x` increases to the right, and `y` increases downwards."""

MIN_SPAN_M = 20.0
"""Minimum size of a map in metres. In a smaller map, drift in the wind would look like a flight."""
MIN_ASPECT = 0.45
"""Minimum ratio of the shorter side of a map to the longer side."""
MARGIN = 0.05
"""Margin around the flight paths, as a share of the length of each side of the map."""
INVISIBLE_PX = 0.5
"""Largest deviation of a line, in pixels, that readers cannot see."""


@dataclass(frozen=True, slots=True)
class GroundRectangle:
    """A rectangle on the ground, in metres north and east of the field's centre."""

    south_m: float
    north_m: float
    west_m: float
    east_m: float

    @property
    def width_m(self) -> float:
        return self.east_m - self.west_m

    @property
    def height_m(self) -> float:
        return self.north_m - self.south_m


def extent(fixes: Sequence[PositionFix]) -> GroundRectangle:
    """Return the rectangle on the ground that the map shows. The rectangle contains all given positions and a margin.
    There must be at least one position.
    """
    north, east = [fix.north_m for fix in fixes], [fix.east_m for fix in fixes]
    shortest = max(MIN_SPAN_M, MIN_ASPECT * max(max(north) - min(north), max(east) - min(east)))
    return GroundRectangle(*_widen(min(north), max(north), shortest), *_widen(min(east), max(east), shortest))


def _widen(low: float, high: float, shortest: float) -> tuple[float, float]:
    span = max(high - low, shortest) * (1 + 2 * MARGIN)
    middle = (low + high) / 2
    return middle - span / 2, middle + span / 2


@dataclass(frozen=True)
class MapProjection:
    """A converter that maps positions in the area `land` to pixels in a rectangle. `left` and `top` are the pixel
    coordinates of the rectangle's upper left corner.
    """

    land: GroundRectangle
    left: float
    top: float
    room_width: float
    room_height: float

    @cached_property
    def px_per_m(self) -> float:
        return min(self.room_width / self.land.width_m, self.room_height / self.land.height_m)

    @property
    def width(self) -> float:
        return self.land.width_m * self.px_per_m

    @property
    def height(self) -> float:
        return self.land.height_m * self.px_per_m

    def x(self, east_m: float) -> float:
        return self.left + (east_m - self.land.west_m) * self.px_per_m

    def y(self, north_m: float) -> float:
        return self.top + (self.land.north_m - north_m) * self.px_per_m

    def __call__(self, fix: PositionFix) -> Point:
        return self.x(fix.east_m), self.y(fix.north_m)

    def ticks_m(self) -> tuple[list[float], list[float]]:
        """Return the positions of the ticks on both axes of the map, in metres. The first list is for the north axis,
        the second for the east axis. Both axes have the same step, which is a round number.
        """
        every = svg.step(max(self.land.width_m, self.land.height_m), 9)
        return _multiples(every, self.land.south_m, self.land.north_m), _multiples(
            every, self.land.west_m, self.land.east_m
        )

    def scale_bar_m(self) -> float:
        """Return the length of the scale bar in metres. The length is a round number, and at least a fifth of the map's
        width.
        """
        return svg.step(self.land.width_m, 5)


def _multiples(every: float, low: float, high: float) -> list[float]:
    return [number * every for number in range(math.ceil(low / every), math.floor(high / every) + 1)]


def thin(lines: Sequence[Sequence[Point]], most: int) -> list[list[Point]]:
    """Remove points from the lines. A simplified line deviates by at most half a pixel from the original line. If more
    than `most` points remain, a larger deviation is allowed. Each line keeps its first and last point.
    """
    tolerance, thin = INVISIBLE_PX, [simplify(line, INVISIBLE_PX) for line in lines]
    while sum(map(len, thin)) > max(most, 2 * len(lines)):
        tolerance *= 4
        thin = [simplify(line, tolerance) for line in thin]
    return thin


def simplify(line: Sequence[Point], tolerance: float) -> list[Point]:
    """Remove points from a line. The simplified line deviates by at most `tolerance` from the original (Douglas and
    Peucker, 1973).
    """
    half = tolerance / 2
    apart = [line[0]]
    for point in line[1:-1]:
        if math.dist(point, apart[-1]) > half:  # a hovering vehicle stays at one point
            apart.append(point)
    apart.append(line[-1])
    kept = {0, len(apart) - 1}
    to_split = [(0, len(apart) - 1)]
    while to_split:
        first, last = to_split.pop()
        between = range(first + 1, last)
        if not between:
            continue
        strays = [_distance(apart[at], apart[first], apart[last]) for at in between]
        farthest = max(strays)
        if farthest > half:
            middle = between[strays.index(farthest)]
            kept.add(middle)
            to_split += [(first, middle), (middle, last)]
    return [apart[at] for at in sorted(kept)]


def _distance(point: Point, start: Point, end: Point) -> float:
    """Return the distance from a point to the straight line between two other points."""
    (x, y), (x1, y1), (x2, y2) = point, start, end
    dx, dy = x2 - x1, y2 - y1
    length = dx * dx + dy * dy
    share = min(1.0, max(0.0, ((x - x1) * dx + (y - y1) * dy) / length)) if length else 0.0
    return math.hypot(x - x1 - share * dx, y - y1 - share * dy)
