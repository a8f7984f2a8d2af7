"""From metres to places in a picture: north up, one scale both ways."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from harness.archive.tracks import Fix
from harness.present import svg

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
