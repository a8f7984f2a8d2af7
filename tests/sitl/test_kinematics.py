from __future__ import annotations

import itertools
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sitl._kinematics import (
    CircularArc,
    ClimbingSegment,
    FallSegment,
    LocalPlace,
    MotionSegment,
    MotionState,
    PlannedMotion,
    RestSegment,
    StraightLine,
    end_of,
)
from sitl._models import MODELS
from sitl._plane import LOITER_RADIUS_M
from sitl.vehicle import VehicleType

metres = st.floats(-2000, 2000)
heights = st.floats(1, 300)
places = st.builds(LocalPlace, metres, metres, heights)


def distance(a: MotionState, b: MotionState) -> float:
    return math.dist(a.point, b.point)


def test_line_has_a_trapezoidal_speed() -> None:
    line = StraightLine(MotionState(), LocalPlace(100, 0, 0), speed_ms=10, accel_ms2=2)
    assert line.duration_s == pytest.approx(5 + 50 / 10 + 5)
    assert (line.at(5).north_m, line.at(5).north_ms) == pytest.approx((25, 10))
    assert line.at(10).north_m == pytest.approx(75)
    assert line.at(15) == MotionState(100, 0, 0)


def test_short_line_does_not_reach_its_speed() -> None:
    line = StraightLine(MotionState(), LocalPlace(0, 8, 0), speed_ms=10, accel_ms2=2)
    assert line.duration_s == pytest.approx(4)
    assert line.at(2).east_ms == pytest.approx(4)


@given(places, st.floats(0.5, 30), st.floats(0.5, 5), st.floats(0, 1), st.floats(0, 1))
def test_speed_of_a_line_is_the_derivative_of_its_position(
    end: LocalPlace, speed: float, accel: float, begins: float, ends: float
) -> None:
    line = StraightLine(
        MotionState(up_m=end.up_m), end._replace(north_m=2000), speed, accel, begins * speed, ends * speed
    )
    for part in (0.1, 0.5, 0.9):
        at_s = part * line.duration_s
        before, after = line.at(at_s - 1e-3), line.at(at_s + 1e-3)
        says = math.hypot(line.at(at_s).north_ms, line.at(at_s).east_ms, line.at(at_s).up_ms)
        assert distance(before, after) / 2e-3 == pytest.approx(says, abs=accel * 2e-3 + 1e-4)
        assert says <= speed + 1e-9


@pytest.mark.parametrize(("turn", "end"), [(math.pi, (0, 20)), (-math.pi, (0, -20))])
def test_clockwise_arc_turns_right(turn: float, end: tuple[float, float]) -> None:
    heading_north = MotionState()
    arc = CircularArc(heading_north, (0, math.copysign(10, turn)), turn, speed_ms=5)
    assert arc.at(0).yaw_rad % math.tau == pytest.approx(0, abs=1e-9)
    assert arc.at(arc.duration_s).point[:2] == pytest.approx(end, abs=1e-9)
    assert arc.at(arc.duration_s).north_ms == pytest.approx(-5)
    assert math.copysign(1, arc.at(1).roll_rad) == math.copysign(1, turn)


def test_climb_ends_at_its_altitude() -> None:
    climb = ClimbingSegment(StraightLine(MotionState(up_m=10), LocalPlace(100, 0, 10), 10, 100), up_m=20, rate_ms=2)
    assert (climb.at(2).up_m, climb.at(2).up_ms) == (14, 2)
    assert (climb.at(9).up_m, climb.at(9).up_ms) == (20, 0)


def test_fall_ends_at_the_speed_of_free_fall() -> None:
    fall = FallSegment(MotionState(up_m=100, north_ms=3))
    assert fall.at(fall.duration_s).point == pytest.approx((3 * fall.duration_s, 0, 0))
    assert fall.impact_ms == pytest.approx(math.sqrt(2 * 9.81 * 100))


def test_course_joins_its_segments() -> None:
    line = StraightLine(MotionState(), LocalPlace(10, 0, 0), 10, 10)
    course = PlannedMotion(100, [RestSegment(MotionState(), 5), line, RestSegment(end_of([line]))])
    assert course.at(0) == course.at(104.9) == MotionState()
    assert course.at(105 + line.duration_s / 2).north_m == pytest.approx(5)
    assert course.at(1e6).north_m == 10
    assert course.end_s == math.inf


FASTEST_MS = 28.4  # a plane that climbs
STEPS = 50
WISHES = ("go_to", "loiter", "land", "ascent")


@settings(max_examples=50)
@given(
    st.sampled_from(["copter", "plane", "rover"]),
    st.floats(0, 6.28),
    st.lists(st.tuples(st.sampled_from(WISHES), places, st.floats(0.1, 60)), max_size=6),
)
def test_motion_is_continuous_and_above_ground(
    vehicle_type: VehicleType, yaw: float, wishes: list[tuple[str, LocalPlace, float]]
) -> None:
    """Each movement begins at the position at which the previous one was interrupted."""
    model = MODELS[vehicle_type]
    segments = model.take_off(MotionState(yaw_rad=yaw), 20)
    now, motion = 0.0, end_of(segments)
    for wish, place, seconds in wishes:
        if wish == "go_to":
            segments = model.go_to(motion, place, model.cruise_ms)
        elif wish == "loiter":
            segments = model.loiter(motion, place, model.cruise_ms, seconds)
        elif wish == "ascent":
            segments = model.ascent(motion, place.up_m)
        else:
            segments = model.land(motion, motion.point)
        course = PlannedMotion(now, segments)
        assert distance(course.at(now), motion) < 1e-6
        fine = [course.at(now + seconds * step / STEPS) for step in range(STEPS + 1)]
        for before, after in itertools.pairwise(fine):
            assert distance(before, after) <= FASTEST_MS * seconds / STEPS + 1e-6
            assert after.up_m >= -1e-6
        now, motion = now + seconds, fine[-1]
        if vehicle_type == "plane" and wish == "land":
            return


@given(places, metres, metres, st.floats(0, 6.28))
def test_plane_passes_close_to_every_place(place: LocalPlace, north: float, east: float, yaw: float) -> None:
    start = MotionState(north, east, 50, 22 * math.cos(yaw), 22 * math.sin(yaw), yaw_rad=yaw)
    there = end_of(MODELS["plane"].go_to(start, place, 22))
    assert math.dist(there.point[:2], place[:2]) <= 50 + 1e-3
    circle: list[MotionSegment] = [*MODELS["plane"].loiter(start, place, 22, 30)]
    assert math.dist(end_of(circle).point[:2], place[:2]) == pytest.approx(LOITER_RADIUS_M)
