"""Compare the computed flight path with flights of the embedded vehicle and of a real ArduCopter."""

from __future__ import annotations

import math
from typing import Literal

import pytest

from sitl._plane import LOITER_RADIUS_M
from sitl.plan import By, GoTo, Land, Loiter, Plan, PlanError, TakeOff
from sitl.track import track
from sitl.vehicle import VehicleType
from tests.sitl.cockpit import Cockpit
from tests.sitl.flying import HOME
from tests.sitl.recorded import flight

SQUARE = Plan(
    (TakeOff(20), *(GoTo(*corner, speed_ms=5) for corner in ((100, 0), (100, 100), (0, 100), (0, 0))), Land())
)
ROUND_TRIP = Plan((TakeOff(30), GoTo(300, -100, altitude_m=60), Loiter(45), GoTo(0, 200, speed_ms=12), GoTo(0, 0)))
DRIVE = Plan((GoTo(100, 0, speed_ms=3), Loiter(45), GoTo(0, 200), GoTo(0, 0)))


@pytest.mark.parametrize(
    ("vehicle_type", "plan"),
    [
        ("copter", ROUND_TRIP),
        ("copter", SQUARE),
        ("plane", ROUND_TRIP),
        ("plane", Plan((*ROUND_TRIP.legs, Land()))),
        ("rover", DRIVE),
    ],
)
def test_track_equals_the_flight_of_the_embedded_vehicle(vehicle_type: VehicleType, plan: Plan) -> None:
    """Positions are sent in units of 1e-7 degrees, about a centimetre. Turns of a plane increase the difference."""
    cockpit = Cockpit(vehicle_type)
    began_s = cockpit.begin(plan)
    computed = track(vehicle_type, plan, heading_deg=HOME.heading_deg, begin_s=began_s)
    for second in range(0, 400, 3):
        cockpit.fly(began_s + second)
        assert math.dist(cockpit.place, computed.at(began_s + second)) < 0.1, f"{second} s after the start"


def test_track_rests_before_its_start_and_after_its_end() -> None:
    square = track("copter", SQUARE, begin_s=5.0)
    assert square.at(0.0) == square.at(5.0) == (0, 0, 0)
    assert square.at(10.0)[2] > 0
    assert square.at(1e6) == (0, 0, 0)
    circling = track("plane", ROUND_TRIP)
    assert math.hypot(*circling.at(5000)[:2]) == pytest.approx(LOITER_RADIUS_M)
    assert circling.at(5000) != circling.at(5001)


def test_place_in_the_field_includes_the_home_offset() -> None:
    square = track("copter", SQUARE, home_offset=(7.0, -3.0, 0.0))
    assert square.in_field(30.0) == pytest.approx((square.at(30.0)[0] + 7, square.at(30.0)[1] - 3, square.at(30.0)[2]))


def test_vehicle_without_plan_stays_and_a_plane_circles() -> None:
    assert track("copter", None, takeoff_altitude_m=15).at(300) == (0, 0, 15)
    assert track("plane", None, takeoff_altitude_m=15).at(300) != track("plane", None, takeoff_altitude_m=15).at(301)
    assert track("rover", None).at(300) == (0, 0, 0)


def test_impossible_plan_is_refused() -> None:
    with pytest.raises(PlanError):
        track("rover", SQUARE)


OUT_AND_BACK = {
    "copter": (TakeOff(30), GoTo(200, 100, speed_ms=8), Loiter(60), GoTo(0, 0), Land()),
    "rover": (GoTo(150, 50, speed_ms=4), Loiter(60), GoTo(0, 0)),
}
WAYS: list[By] = ["mission", "guided"]


@pytest.mark.parametrize("by", WAYS)
@pytest.mark.parametrize("vehicle_type", OUT_AND_BACK)
def test_recorded_vehicle_is_within_5_s_of_the_track(vehicle_type: Literal["copter", "rover"], by: By) -> None:
    """Times count from arming. The vehicle is within 3 m of a position that is computed for a time at most 5 s earlier
    or later.
    """
    flown = flight(f"{vehicle_type}-{by}")  # type: ignore[arg-type]
    computed = track(vehicle_type, Plan(OUT_AND_BACK[vehicle_type]), heading_deg=355.4, by=by)
    for second, *place in flown:
        nearby = (computed.at(second + tenth / 10) for tenth in range(-50, 51))
        assert min(math.dist(place, near) for near in nearby) < 3.0, f"{second:.1f} s after arming"


@pytest.mark.parametrize("by", WAYS)
def test_recorded_plane_is_near_the_track(by: By) -> None:
    """The plane is always within 80 m of the position computed for the same time, and within 30 m of the computed
    path.
    """
    plan = Plan((TakeOff(50), GoTo(600, 350, speed_ms=20), Loiter(120), GoTo(0, 0), Land()))
    computed = track("plane", plan, heading_deg=353.0, by=by)
    path = [computed.at(quarter / 4)[:2] for quarter in range(1200)]
    flown = flight(f"plane-{by}")  # type: ignore[arg-type]
    assert max(math.dist(place, computed.at(second)) for second, *place in flown) < 80.0
    assert max(min(math.dist(place[:2], near) for near in path) for _, *place in flown) < 30.0
