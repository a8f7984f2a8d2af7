from __future__ import annotations

import math

import pytest

from sitl._kinematics import LocalPlace
from sitl._route import route
from sitl.plan import MAX_LEGS, GoTo, Land, Leg, Loiter, Plan, PlanError, TakeOff
from sitl.vehicle import VehicleType


@pytest.mark.parametrize(
    ("vehicle_type", "legs", "problem"),
    [
        ("copter", [], "1 to 100 legs, this one has 0"),
        ("copter", [TakeOff(20), *[Loiter(1)] * MAX_LEGS], "this one has 101"),
        ("copter", [GoTo(1, 1)], "the plan of a copter begins with take_off"),
        ("plane", [Land()], "the plan of a plane begins with take_off"),
        ("rover", [TakeOff(20)], "leg 1 .* a rover neither takes off nor lands"),
        ("rover", [GoTo(1, 1), Land()], "leg 2 .* a rover neither takes off nor lands"),
        ("rover", [GoTo(1, 1, altitude_m=5)], "a rover has no altitude"),
        ("copter", [TakeOff(20), TakeOff(20)], r"leg 2 \(take off to 20 m\): a plan takes off once"),
        ("copter", [TakeOff(20), Land(), GoTo(1, 1)], "nothing comes after a landing"),
        ("copter", [TakeOff(0)], "more than 0 m"),
        ("copter", [TakeOff(math.nan)], "more than 0 m"),
        ("copter", [TakeOff(20), GoTo(80_000, 80_000)], "farther than 100 km"),
        ("copter", [TakeOff(20), GoTo(math.nan, 0)], "farther than 100 km"),
        ("copter", [TakeOff(20), GoTo(0, 0, altitude_m=-5)], "more than 0 m"),
        ("copter", [TakeOff(20), GoTo(0, 0, speed_ms=21)], "a copter goes 0.5 to 20 m/s"),
        ("plane", [TakeOff(20), GoTo(0, 0, speed_ms=9)], "a plane goes 10 to 30 m/s"),
        ("copter", [TakeOff(20), GoTo(0, 0, speed_ms=math.nan)], "0.5 to 20 m/s"),
        ("copter", [TakeOff(20), Loiter(0)], "more than 0 s"),
        ("copter", [TakeOff(20), Loiter(math.inf)], "at most 65535 s"),
    ],
)
def test_impossible_plan_is_refused_with_its_leg(vehicle_type: VehicleType, legs: list[Leg], problem: str) -> None:
    with pytest.raises(PlanError, match=problem):
        Plan(tuple(legs)).check(vehicle_type)


def test_missing_values_of_legs_are_filled_in() -> None:
    plan = Plan((TakeOff(30), GoTo(100, 0, speed_ms=4), Loiter(5), GoTo(100, 50, altitude_m=40), GoTo(0, 0), Land()))
    waypoints = route(plan, "copter", 0.0)
    assert [(one.place, one.speed_ms) for one in waypoints] == [
        (LocalPlace(0, 0, 30), 10),
        (LocalPlace(100, 0, 30), 4),
        (LocalPlace(100, 0, 30), 4),
        (LocalPlace(100, 50, 40), 10),
        (LocalPlace(0, 0, 40), 10),
        (LocalPlace(0, 0, 0), 10),
    ]
    assert waypoints[2].seconds == 5
    assert waypoints[1].leg == "leg 2 of 6 (go to 100 m north, 0 m east)"


def test_plane_approach_lies_before_the_runway() -> None:
    approach, landing = route(Plan((TakeOff(30), GoTo(0, 100), Land())), "plane", 90.0)[-2:]
    assert (approach.kind, landing.kind) == ("go_to", "land")
    assert approach.place == pytest.approx((0, 100 - 300, 30))
    assert landing.place == (0, 100, 0)
