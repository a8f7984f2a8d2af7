"""Geometry of the map, and the parts into which the network falls.

A part is two or more vehicles that reach each other and not everybody; whoever reaches nobody is alone. A part keeps
its letter from one state to the next as long as most of it does.
"""

import math
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import count
from operator import attrgetter

from harness.archive.connectivity import Connectivity, Topology
from harness.archive.tracks import Fix, Tracks, between
from harness.present import svg
from harness.report.chain_tree import ranges

MAX_STRETCHES = 4000
"""Of all vehicles together; nobody could tell more of them apart."""
MAX_NAMED = 6
"""Parts that are told one by one."""


@dataclass(frozen=True, slots=True)
class Division:
    """From `at_s` on the living vehicles were in these parts, by number from 0, the rest alone.

    While everybody reaches everybody, all are `together`, and there is no part.
    """

    at_s: float
    what: str
    parts: dict[int, frozenset[int]]
    alone: frozenset[int]
    together: frozenset[int]

    @property
    def living(self) -> frozenset[int]:
        return self.together | self.alone | frozenset().union(*self.parts.values())

    def place_of(self, vehicle: int) -> tuple[int | None, frozenset[int]]:
        """Its part, and whom it reaches."""
        return self.part_of(vehicle), self.fellows(vehicle)

    def part_of(self, vehicle: int) -> int | None:
        """The number of its part; None if it is in none."""
        return next((number for number, members in self.parts.items() if vehicle in members), None)

    def fellows(self, vehicle: int) -> frozenset[int]:
        """Those that it reaches, and itself."""
        part = self.part_of(vehicle)
        if part is not None:
            return self.parts[part]
        return self.together if vehicle in self.together else frozenset({vehicle})

    def changed_since(self, before: "Division") -> int:
        """How many vehicles were lost or back, or reached others than before of those that lived before and after."""
        both = self.living & before.living
        moved = sum(self.fellows(vehicle) & both != before.fellows(vehicle) & both for vehicle in both)
        return moved + len(self.living ^ before.living)

    def in_words(self) -> str:
        """Such as "all 5 connected", or "A 1-3; B 4, 5; alone 6"."""
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
class Stretch:
    """A vehicle's way while its place in the network did not change; `division` is the one in which it began."""

    vehicle: int
    fixes: list[Fix]
    division: Division | None


@dataclass(frozen=True, slots=True)
class Life:
    """From take-off, or from where it was first seen, until the run ended or the vehicle was lost."""

    vehicle: int
    stretches: list[Stretch]
    lost: bool

    @property
    def start(self) -> Fix:
        return self.stretches[0].fixes[0]

    @property
    def end(self) -> Fix:
        return self.stretches[-1].fixes[-1]


def letter(number: int) -> str:
    """A, B, ... Z, A2, B2, ..."""
    return chr(ord("A") + number % 26) + (str(number // 26 + 1) if number >= 26 else "")


def listed(vehicles: frozenset[int]) -> str:
    return ", ".join(ranges(sorted(vehicles)))


def divisions(states: Sequence[Topology]) -> list[Division]:
    divided: list[Division] = []
    before: dict[int, frozenset[int]] = {}
    for state in states:
        if len(state.components) == 1:
            divided.append(Division(state.at_s, state.what, {}, frozenset(), state.components[0]))
            continue
        parts = [group for group in state.components if len(group) > 1]
        alone = frozenset().union(*(group for group in state.components if len(group) == 1))
        numbered = _numbered(parts, before)
        before = numbered or before
        divided.append(Division(state.at_s, state.what, numbered, alone, frozenset()))
    return divided


def _numbered(parts: Sequence[frozenset[int]], before: dict[int, frozenset[int]]) -> dict[int, frozenset[int]]:
    """The parts by number: that of the former part most of which is in it, or else the first that is free."""
    numbers: dict[int, frozenset[int]] = {}
    for part in parts:
        shared = {number: len(part & members) for number, members in before.items() if number not in numbers}
        best = max(shared, key=lambda number: shared[number], default=None)
        if best is None or 2 * shared[best] <= len(before[best]):
            best = None
        numbers[best if best is not None else -1 - len(numbers)] = part
    free = (number for number in count() if number not in numbers)
    return dict(sorted((number if number >= 0 else next(free), part) for number, part in numbers.items()))


def longest(divided: Sequence[Division], end_s: float, most: int) -> list[Division]:
    """The first, and those of the others that lasted longest; each then lasts until the next that is left."""
    if len(divided) <= most:
        return list(divided)
    ends = [*(division.at_s for division in divided[1:]), end_s]
    by_length = sorted(range(1, len(divided)), key=lambda at: divided[at].at_s - ends[at])
    return [divided[at] for at in sorted([0, *by_length[: most - 1]])]


def lives(
    vehicle: int, tracks: Tracks, network: Connectivity, divided: Sequence[Division], end_s: float
) -> Iterator[Life]:
    """The ways of a vehicle, and of those that took its place after it was lost."""
    wreck: Fix | None = None
    for begin_s, until_s, lost in network.lives(vehicle, end_s):
        flown = [fix for fix in tracks.by_vehicle[vehicle] if begin_s <= fix.at_s <= until_s]
        while wreck and flown and flown[0][1:] == wreck[1:]:  # the new vehicle is not there yet
            del flown[0]
        if flown:
            end = tracks.at(vehicle, until_s)
            yield Life(vehicle, list(_stretches(vehicle, [*flown, end], divided)), lost)
            wreck = end


def _stretches(vehicle: int, way: list[Fix], divided: Sequence[Division]) -> Iterator[Stretch]:
    now = next((division for division in reversed(divided) if division.at_s <= way[0].at_s), None)
    begin = 0
    for division in divided:
        unchanged = now is not None and now.place_of(vehicle) == division.place_of(vehicle)
        if unchanged or not way[0].at_s < division.at_s < way[-1].at_s:
            continue
        end = bisect_left(way, division.at_s, begin, key=attrgetter("at_s"))
        turn = between(way[end - 1], way[end], division.at_s)
        yield Stretch(vehicle, [*way[begin:end], turn], now)
        way[end - 1], begin, now = turn, end - 1, division
    yield Stretch(vehicle, way[begin:], now)


Point = tuple[float, float]
"""x and y in CSS pixels; y grows downwards."""

MIN_SPAN_M = 20.0
"""A map of less would make much of the wind."""
SLIMMEST = 0.45
"""The shorter side of a map, as a share of the longer."""
MARGIN = 0.05
"""Around all that was flown, as a share of each side."""
FINEST = 0.5
"""Pixels: what nobody sees."""


@dataclass(frozen=True, slots=True)
class Extent:
    """A piece of land, in metres north and east of the field's centre."""

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


def extent(fixes: Sequence[Fix]) -> Extent:
    """Around these fixes, of which there is one at least."""
    north, east = [fix.north_m for fix in fixes], [fix.east_m for fix in fixes]
    shortest = max(MIN_SPAN_M, SLIMMEST * max(max(north) - min(north), max(east) - min(east)))
    return Extent(*_widened(min(north), max(north), shortest), *_widened(min(east), max(east), shortest))


def _widened(low: float, high: float, shortest: float) -> tuple[float, float]:
    span = max(high - low, shortest) * (1 + 2 * MARGIN)
    middle = (low + high) / 2
    return middle - span / 2, middle + span / 2


@dataclass(frozen=True)
class Projection:
    """`land`, as large as fits into a room of so many pixels whose upper left corner is at `left`, `top`."""

    land: Extent
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

    def __call__(self, fix: Fix) -> Point:
        return self.x(fix.east_m), self.y(fix.north_m)

    def ticks_m(self) -> tuple[list[float], list[float]]:
        """Round metres north and east, in equal steps."""
        every = svg.step(max(self.land.width_m, self.land.height_m), 9)
        return _multiples(every, self.land.south_m, self.land.north_m), _multiples(
            every, self.land.west_m, self.land.east_m
        )

    def scale_bar_m(self) -> float:
        """A round length of a fifth of the map's width or somewhat more."""
        return svg.step(self.land.width_m, 5)


def _multiples(every: float, low: float, high: float) -> list[float]:
    return [number * every for number in range(math.ceil(low / every), math.floor(high / every) + 1)]


def thinned(lines: Sequence[Sequence[Point]], most: int) -> list[list[Point]]:
    """The lines, of half a pixel's exactness, or as coarse as it takes to have at most so many points in all.

    A line of which nothing is left keeps both its ends.
    """
    tolerance, thin = FINEST, [simplified(line, FINEST) for line in lines]
    while sum(map(len, thin)) > max(most, 2 * len(lines)):
        tolerance *= 4
        thin = [simplified(line, tolerance) for line in thin]
    return thin


def simplified(line: Sequence[Point], tolerance: float) -> list[Point]:
    """Those of its points without which it would stray by more than `tolerance` (Douglas and Peucker, 1973)."""
    half = tolerance / 2
    apart = [line[0]]
    for point in line[1:-1]:
        if math.dist(point, apart[-1]) > half:  # a vehicle that hovers is in one place
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
    """From the point to the nearest of the straight line between the two others."""
    (x, y), (x1, y1), (x2, y2) = point, start, end
    dx, dy = x2 - x1, y2 - y1
    length = dx * dx + dy * dy
    share = min(1.0, max(0.0, ((x - x1) * dx + (y - y1) * dy) / length)) if length else 0.0
    return math.hypot(x - x1 - share * dx, y - y1 - share * dy)
