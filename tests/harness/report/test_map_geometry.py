"""Test the geometry of the map: north is up, both axes have one scale, and simplified lines look the same."""

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.archive.tracks import PositionFix
from harness.report.map_parts import INVISIBLE_PX, GroundRectangle, MapProjection, Point, extent, simplify, thin

LAND = GroundRectangle(south_m=-100, north_m=100, west_m=-200, east_m=200)
TO_PX = MapProjection(LAND, 10, 20, 800, 600)

places = st.lists(st.tuples(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6)), min_size=1, max_size=20)
lines = st.lists(st.tuples(st.floats(0, 900), st.floats(0, 600)), min_size=2, max_size=60)


def test_north_is_up_east_is_right_and_metres_have_equal_lengths() -> None:
    assert TO_PX(PositionFix(0, 100, -200)) == (10, 20)
    assert TO_PX(PositionFix(0, -100, 200)) == (810, 420)
    assert TO_PX(PositionFix(0, 0, 0)) == (410, 220)
    assert TO_PX(PositionFix(0, 50, 0)) == (410, 120)
    assert TO_PX(PositionFix(0, 0, 50)) == (510, 220)


def test_land_of_any_shape_fits_into_its_rectangle() -> None:
    for land in (LAND, GroundRectangle(-500, 500, -10, 10), GroundRectangle(0, 30, 0, 30)):
        to_px = MapProjection(land, 0, 0, 800, 600)
        assert to_px.width <= 800 + 1e-9
        assert to_px.height <= 600 + 1e-9
        assert max(to_px.width / 800, to_px.height / 600) == pytest.approx(1)


def test_ticks_and_scale_bar_are_round_metres() -> None:
    north, east = TO_PX.ticks_m()
    assert north == [-100, -50, 0, 50, 100]
    assert east == [-200, -150, -100, -50, 0, 50, 100, 150, 200]
    assert TO_PX.scale_bar_m() == 100
    assert MapProjection(GroundRectangle(0, 1000, 0, 1100), 0, 0, 800, 600).scale_bar_m() == 250


@given(places)
def test_all_tracks_are_inside_the_map_with_a_margin(flown: list[tuple[float, float]]) -> None:
    land = extent([PositionFix(0, *place) for place in flown])
    for north_m, east_m in flown:
        assert land.south_m < north_m < land.north_m
        assert land.west_m < east_m < land.east_m
    assert 0.44 < land.width_m / land.height_m < 1 / 0.44


def test_a_swarm_that_hardly_moves_is_not_blown_up() -> None:
    land = extent([PositionFix(0, 0, 0), PositionFix(1, 0.5, 0)])
    assert land.width_m == land.height_m == pytest.approx(22)


def test_straight_line_is_reduced_to_its_ends_and_corners_stay() -> None:
    straight = [(float(x), 2.0 * x) for x in range(100)]
    assert simplify(straight, INVISIBLE_PX) == [(0, 0), (99, 198)]
    assert simplify([*straight, (99, 0)], INVISIBLE_PX) == [(0, 0), (99, 198), (99, 0)]
    assert simplify([(5, 5), (5.1, 5), (5, 5.1), (5, 5)], INVISIBLE_PX) == [(5, 5), (5, 5)]


@given(lines, st.floats(0.1, 20))
def test_no_point_is_farther_from_the_thinned_line_than_the_tolerance(line: list[Point], tolerance: float) -> None:
    thin = simplify(line, tolerance)
    assert (thin[0], thin[-1]) == (line[0], line[-1])
    assert set(thin) <= set(line)
    for point in line:
        assert min(_distance(point, *ends) for ends in pairwise(thin)) <= tolerance + 1e-6


def _distance(point: Point, start: Point, end: Point) -> float:
    """Return the distance of a point from a line. The function tries points along the line and does not use the tested
    code.
    """
    low, high = 0.0, 1.0

    def at(share: float) -> float:
        return math.dist(point, [one + share * (other - one) for one, other in zip(start, end, strict=True)])

    for _ in range(60):
        third = (high - low) / 3
        low, high = (low, high - third) if at(low + third) < at(high - third) else (low + third, high)
    return min(at(low), at(0), at(1))


def test_many_points_are_thinned_to_the_bound_but_no_line_loses_its_ends() -> None:
    zigzag = [[(float(x % 700), float((x * 7919 + shift) % 500)) for x in range(600)] for shift in range(3)]
    lines = thin(zigzag, 200)
    assert sum(map(len, lines)) <= 200
    assert [(line[0], line[-1]) for line in lines] == [(line[0], line[-1]) for line in zigzag]
    assert thin(zigzag, 0) == [[line[0], line[-1]] for line in zigzag]
