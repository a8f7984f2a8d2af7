"""Test modes and flights of the embedded vehicle, in the process of the test. The test sets the time."""

from __future__ import annotations

import math

import pytest
from pymavlink.dialects.v20 import common as mavlink

from sitl._kinematics import LocalPlace
from sitl._mission_upload import on_earth
from sitl._plane import LOITER_RADIUS_M
from sitl.plan import GoTo, Land, Loiter, Plan, TakeOff
from sitl.vehicle import VehicleType
from tests.sitl.cockpit import ACCEPTED, FAILED, UNSUPPORTED, Cockpit
from tests.sitl.flying import HOME

FORCE = 21196
OUT_AND_BACK = Plan((TakeOff(30), GoTo(200, 100), Loiter(20), GoTo(0, 0, altitude_m=20), Land()))


def position_target(place: LocalPlace, mask: int = 0x0DF8) -> mavlink.MAVLink_set_position_target_global_int_message:
    x, y = on_earth(place, HOME)
    frame = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT
    return mavlink.MAVLink_set_position_target_global_int_message(0, 3, 1, frame, mask, x, y, place.up_m, *[0.0] * 8)


def reposition(place: LocalPlace, speed_ms: float = -1.0) -> mavlink.MAVLink_command_int_message:
    x, y = on_earth(place, HOME)
    frame = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT
    command = mavlink.MAV_CMD_DO_REPOSITION
    return mavlink.MAVLink_command_int_message(3, 1, frame, command, 0, 0, speed_ms, 0, 0, 0, x, y, place.up_m)


@pytest.mark.parametrize("vehicle_type", ["copter", "plane"])
def test_mission_ends_disarmed_on_the_ground(vehicle_type: VehicleType) -> None:
    cockpit = Cockpit(vehicle_type)
    cockpit.begin(OUT_AND_BACK)
    cockpit.fly(600.0)
    flown = cockpit.vehicle
    assert not flown.armed and not flown.airborne
    numbers = cockpit.load(OUT_AND_BACK).numbers
    assert cockpit.reached() == numbers[:-1]  # a landing ends with a disarming instead
    assert cockpit.place.up_m == 0
    assert math.dist(cockpit.place[:2], (0, 0)) < (0.1 if vehicle_type == "copter" else 100)
    assert cockpit.texts()[-1] == "Disarming motors"


def test_rover_stays_at_the_end_of_its_mission() -> None:
    cockpit = Cockpit("rover")
    cockpit.begin(Plan((GoTo(100, 0), Loiter(10), GoTo(0, 50))))
    cockpit.fly(300.0)
    assert cockpit.place == pytest.approx((0, 50, 0), abs=0.02)
    assert cockpit.vehicle.armed


@pytest.mark.parametrize("step_s", [0.07, 1.0, 23.0])
def test_track_is_independent_of_the_step_size(step_s: float) -> None:
    fine, coarse = Cockpit(), Cockpit()
    for cockpit, step in ((fine, 0.5), (coarse, step_s)):
        began_s = cockpit.begin(OUT_AND_BACK)
        cockpit.fly(began_s + 61.7, step)
    assert math.dist(fine.place, coarse.place) < 1e-6
    assert coarse.reached() == fine.reached()


def test_only_a_copter_waits_for_the_mission_start() -> None:
    copter = Cockpit()
    copter.ready()
    copter.load(OUT_AND_BACK)
    assert copter.mode("AUTO") == ACCEPTED
    assert copter.arm() == FAILED
    assert copter.texts()[-1] == "Arm: AUTO mode not armable"
    assert (copter.mode("GUIDED"), copter.arm(), copter.mode("AUTO")) == (ACCEPTED,) * 3
    copter.fly(30.0)
    assert copter.place.up_m == 0
    assert copter.command(mavlink.MAV_CMD_MISSION_START) == ACCEPTED
    copter.fly(40.0)
    assert copter.place.up_m > 5


def test_auto_mode_needs_a_mission_with_take_off() -> None:
    cockpit = Cockpit("plane")
    cockpit.ready()
    assert cockpit.mode("AUTO") == FAILED
    items = [mavlink.MAVLink_mission_item_int_message(3, 1, seq, 3, 16, 0, 1, 0, 0, 0, 0, 1, 1, 30) for seq in (0, 1)]
    cockpit.tell(mavlink.MAVLink_mission_count_message(3, 1, 2))
    for item in items:
        cockpit.tell(item)
    assert (cockpit.mode("AUTO"), cockpit.arm()) == (ACCEPTED, ACCEPTED)
    assert cockpit.texts()[-1] == "Auto: Missing Takeoff Cmd"
    cockpit.fly(30.0)
    assert cockpit.place == (0, 0, 0)


def test_interrupted_mission_resumes_at_its_item() -> None:
    cockpit = Cockpit()
    began_s = cockpit.begin(OUT_AND_BACK)
    cockpit.fly(began_s + 25)
    assert cockpit.mode("GUIDED") == ACCEPTED
    here = cockpit.place
    cockpit.fly(began_s + 100)
    assert cockpit.place == here
    assert cockpit.mode("AUTO") == ACCEPTED
    cockpit.fly(began_s + 300)
    assert not cockpit.vehicle.armed
    assert cockpit.reached() == [1, 3, 4, 5]


def test_copter_in_guided_mode_flies_to_places_and_stays() -> None:
    cockpit = Cockpit()
    cockpit.take_off()
    assert cockpit.command(mavlink.MAV_CMD_DO_CHANGE_SPEED, 1, 5) == ACCEPTED
    here, there = cockpit.place, LocalPlace(100, -50, 25)
    cockpit.tell(position_target(there))
    cockpit.fly(45.0)
    assert 10 < math.dist(cockpit.place, here) < 20
    for _ in range(5):  # a repeated command changes nothing
        cockpit.tell(position_target(there))
        cockpit.fly(cockpit.vehicle.now_s + 0.5)
    assert math.dist(cockpit.place, here) > 20
    cockpit.fly(100.0)
    assert cockpit.place == pytest.approx(there, abs=0.02)
    cockpit.tell(position_target(LocalPlace(0, 0, 25), mask=0x0DFF))  # a velocity or nothing, but no position
    assert cockpit.tell(reposition(LocalPlace(0, 0, 25)))[0].result == ACCEPTED
    cockpit.fly(200.0)
    assert cockpit.place == pytest.approx((0, 0, 25), abs=0.02)


def test_plane_takes_off_in_its_mode_and_circles_at_its_target() -> None:
    cockpit = Cockpit("plane")
    (answer,) = cockpit.tell(mavlink.MAVLink_param_set_message(3, 1, b"TKOFF_ALT", 60, 9))
    assert (answer.param_id, answer.param_value) == ("TKOFF_ALT", 60)
    cockpit.ready()
    assert (cockpit.mode("TAKEOFF"), cockpit.arm()) == (ACCEPTED, ACCEPTED)
    cockpit.fly(60.0)
    assert cockpit.place.up_m == 60
    cockpit.tell(position_target(LocalPlace(600, 0, 60)))  # not for planes
    assert cockpit.tell(reposition(LocalPlace(600, 0, 80)))[0].result == FAILED  # not in GUIDED yet
    assert cockpit.mode("GUIDED") == ACCEPTED
    assert cockpit.tell(reposition(LocalPlace(600, 0, 80)))[0].result == ACCEPTED
    cockpit.fly(200.0)
    assert math.dist(cockpit.place[:2], (600, 0)) == pytest.approx(LOITER_RADIUS_M, abs=0.1)
    assert cockpit.place.up_m == 80
    assert cockpit.command(mavlink.MAV_CMD_DO_REPOSITION) == mavlink.MAV_RESULT_COMMAND_INT_ONLY


@pytest.mark.parametrize("hostile", [math.nan, math.inf, -math.inf, 1e30])
def test_impossible_places_are_refused(hostile: float) -> None:
    cockpit = Cockpit()
    cockpit.take_off()
    assert cockpit.tell(reposition(LocalPlace(10, 10, 0)._replace(up_m=hostile)))[0].result == FAILED
    cockpit.tell(position_target(LocalPlace(10, 10, hostile)))
    assert cockpit.command(mavlink.MAV_CMD_DO_CHANGE_SPEED, 1, hostile) == FAILED
    before = cockpit.place
    cockpit.fly(60.0)
    assert cockpit.place == before


@pytest.mark.parametrize(
    ("command", "params"),
    [(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, (0, FORCE)), (mavlink.MAV_CMD_DO_FLIGHTTERMINATION, (1,))],
)
@pytest.mark.parametrize("vehicle_type", ["copter", "plane"])
def test_vehicle_without_motors_falls_and_reports_the_impact(
    vehicle_type: VehicleType, command: int, params: tuple[float, ...]
) -> None:
    cockpit = Cockpit(vehicle_type)
    began_s = cockpit.begin(OUT_AND_BACK)
    cockpit.fly(began_s + 30)
    assert cockpit.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0) == FAILED  # not without force
    assert cockpit.command(command, *params) == ACCEPTED
    assert not cockpit.vehicle.armed
    assert cockpit.arm() == FAILED  # in the air
    cockpit.fly(began_s + 40)
    assert cockpit.place.up_m == 0
    assert cockpit.texts()[-1].startswith("SIM Hit ground at 2")  # 30 m down: 24 m/s
    there = cockpit.place
    cockpit.fly(began_s + 100)
    assert cockpit.place == there


def test_disarmed_rover_stops() -> None:
    cockpit = Cockpit("rover")
    began_s = cockpit.begin(Plan((GoTo(100, 0),)))
    cockpit.fly(began_s + 10)
    assert cockpit.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0) == ACCEPTED
    there = cockpit.place
    assert 0 < there.north_m < 100
    cockpit.fly(began_s + 60)
    assert cockpit.place == there


def test_return_to_launch_brings_each_type_home() -> None:
    copter = Cockpit()
    copter.take_off(10)
    copter.tell(position_target(LocalPlace(100, 0, 10)))
    copter.fly(80.0)
    assert copter.command(mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH) == ACCEPTED
    copter.fly(85.0)
    assert copter.place.up_m > 12  # RTL_ALT is 15 m
    copter.fly(200.0)
    assert copter.place == pytest.approx((0, 0, 0), abs=1e-6) and not copter.vehicle.armed
    plane = Cockpit("plane")
    began_s = plane.begin(Plan((TakeOff(50), GoTo(1000, 0))))
    plane.fly(began_s + 30)
    assert plane.mode("RTL") == ACCEPTED
    plane.fly(began_s + 300)
    assert plane.place.up_m == pytest.approx(100) and math.hypot(*plane.place[:2]) < 250
    rover = Cockpit("rover")
    began_s = rover.begin(Plan((GoTo(100, 0),)))
    rover.fly(began_s + 30)
    assert rover.mode("RTL") == ACCEPTED
    rover.fly(began_s + 100)
    assert rover.place == pytest.approx((0, 0, 0), abs=0.02)


def test_unknown_modes_of_a_type_are_refused() -> None:
    assert Cockpit("plane").command(mavlink.MAV_CMD_NAV_LAND) == UNSUPPORTED
    assert Cockpit("rover").command(mavlink.MAV_CMD_DO_SET_MODE, 1, 13) == FAILED
    rover = Cockpit("rover")
    rover.ready()
    assert (rover.mode("GUIDED"), rover.arm()) == (ACCEPTED, ACCEPTED)
    assert rover.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 20) == FAILED
