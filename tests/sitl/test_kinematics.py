from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sitl.kinematics import CIRCLE_RADIUS_M, CIRCLE_SPEED_MS, CLIMB_MS, DESCENT_MS, Copter, Motion, Phase

steps = st.lists(st.floats(0.001, 30.0), min_size=1, max_size=30)


def flying(altitude_m: float = 20.0, heading_deg: float = 270.0) -> Copter:
    copter = Copter(heading_deg)
    copter.take_off(altitude_m, 0.0)
    return copter


def distance(a: Motion, b: Motion) -> float:
    return math.dist((a.north_m, a.east_m, a.up_m), (b.north_m, b.east_m, b.up_m))


def test_a_copter_on_the_ground_stays_there() -> None:
    copter = Copter(90.0)
    copter.advance(1000.0)
    assert copter.motion == Motion(yaw_rad=math.radians(90.0))


def test_it_climbs_at_the_climb_rate_to_the_altitude_and_no_higher() -> None:
    copter = flying(20.0)
    copter.advance(4.0)
    assert copter.motion.up_m == pytest.approx(4 * CLIMB_MS)
    copter.advance(1000.0)
    assert copter.motion.up_m == pytest.approx(20.0)


def test_it_circles_home_and_never_stands_still() -> None:
    copter = flying()
    copter.advance(100.0)
    assert math.hypot(copter.motion.north_m, copter.motion.east_m) == pytest.approx(CIRCLE_RADIUS_M)
    assert math.hypot(copter.motion.north_ms, copter.motion.east_ms) == pytest.approx(CIRCLE_SPEED_MS)
    before = copter.motion
    copter.advance(102.0)
    assert distance(before, copter.motion) > CIRCLE_SPEED_MS


def test_landing_ends_on_the_ground_below() -> None:
    copter = flying()
    copter.land(60.0)
    above = copter.motion
    copter.advance(60.0 + 20.0 / DESCENT_MS + 1.0)
    assert copter.phase is Phase.GROUND
    assert copter.motion.up_m == 0.0
    assert (copter.motion.north_m, copter.motion.east_m) == (above.north_m, above.east_m)


def test_it_takes_off_again_from_where_it_landed() -> None:
    copter = flying()
    copter.land(60.0)
    copter.take_off(10.0, 100.0)
    copter.advance(200.0)
    assert copter.motion.up_m == pytest.approx(10.0)


@given(steps, st.floats(0, 359), st.lists(st.sampled_from(["land", "hold", "nothing"]), max_size=30))
def test_it_never_jumps_nor_goes_underground(waits: list[float], heading: float, wishes: list[str]) -> None:
    copter, now = flying(20.0, heading), 0.0
    fastest = math.hypot(CIRCLE_SPEED_MS, CIRCLE_SPEED_MS, CLIMB_MS)
    for wait, wish in zip(waits, [*wishes, *["nothing"] * len(waits)], strict=False):
        if wish == "land":
            copter.land(now)
        elif wish == "hold":
            copter.hold(now)
        before, now = copter.motion, now + wait
        copter.advance(now)
        assert distance(before, copter.motion) <= fastest * wait + 1e-6
        assert copter.motion.up_m >= 0.0


@given(steps)
def test_the_track_does_not_depend_on_the_steps(waits: list[float]) -> None:
    fine, coarse = flying(), flying()
    now = 0.0
    for wait in waits:
        now += wait
        fine.advance(now)
    coarse.advance(now)
    assert distance(fine.motion, coarse.motion) < 1e-6
