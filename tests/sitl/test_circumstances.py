"""Circumstances of a vehicle: they are set by parameters, as far as the vehicle has them, and cause failsafes."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

import sitl.circumstances
from sitl._autopilot import Autopilot
from sitl.circumstances import (
    COMPASS_LOST,
    GPS_LOST,
    GPS_REGAINED,
    MOTOR_STOPPED,
    Circumstance,
    NotSimulatedError,
    battery,
)
from sitl.modes import MODES
from sitl.plan import GoTo, Plan, TakeOff
from sitl.streams import heartbeat, sys_status
from sitl.vehicle import READY_S, VehicleType
from tests.sitl.flying import HOME
from tests.sitl.puppet import on_strings

FAR = Plan((TakeOff(20.0), GoTo(5000.0, 0.0)))


def airborne(vehicle_type: VehicleType = "copter") -> tuple[Autopilot, list[str]]:
    """A vehicle in the air, or on its way, and what it says."""
    vehicle, texts = Autopilot(3, HOME, 0, vehicle_type), list[str]()

    class Ear:
        def send(self, message: object) -> None:
            texts.append(getattr(message, "text", ""))

    vehicle.listeners.append(Ear())
    vehicle.advance(READY_S + 1)
    vehicle.set_mode(MODES[vehicle_type]["TAKEOFF" if vehicle_type == "plane" else "GUIDED"])
    vehicle.arm()
    if vehicle_type == "copter":
        vehicle.take_off(20.0)
    vehicle.advance(60.0)
    texts.clear()
    return vehicle, texts


def mode_of(vehicle: Autopilot) -> str:
    return vehicle.mode


def test_copter_without_gps_lands_and_reports_it() -> None:
    vehicle, texts = airborne()
    vehicle.failsafes.parameters["SIM_GPS1_ENABLE"] = 0.0
    assert not sys_status(vehicle).onboard_control_sensors_health & mavlink.MAV_SYS_STATUS_SENSOR_GPS
    vehicle.advance(61.0)
    vehicle.advance(68.0)
    assert mode_of(vehicle) == "GUIDED"
    vehicle.advance(70.0)
    assert texts == ["EKF variance", "EKF Failsafe: changed to LAND Mode"]
    assert heartbeat(vehicle).system_status == mavlink.MAV_STATE_CRITICAL
    vehicle.advance(300.0)
    assert not vehicle.airborne
    assert vehicle.arm() == mavlink.MAV_RESULT_FAILED
    vehicle.failsafes.parameters["SIM_GPS1_ENABLE"] = 1.0
    vehicle.advance(301.0)
    assert sys_status(vehicle).onboard_control_sensors_health & mavlink.MAV_SYS_STATUS_SENSOR_GPS
    assert heartbeat(vehicle).system_status == mavlink.MAV_STATE_STANDBY


@pytest.mark.parametrize(
    ("vehicle_type", "mode", "said"), [("plane", "TAKEOFF", []), ("rover", "HOLD", ["EKF variance"])]
)
def test_plane_without_gps_flies_on_and_rover_stops(vehicle_type: VehicleType, mode: str, said: list[str]) -> None:
    vehicle, texts = airborne(vehicle_type)
    vehicle.failsafes.parameters["SIM_GPS1_ENABLE"] = 0.0
    vehicle.advance(61.0)
    vehicle.advance(70.0)
    assert (vehicle.mode, texts[:1]) == (mode, said)
    counts = bool(sys_status(vehicle).onboard_control_sensors_health & mavlink.MAV_SYS_STATUS_AHRS)
    assert counts is (vehicle_type == "plane")


@pytest.mark.parametrize(
    ("volts", "given", "mode", "said"),
    [
        (10.4, {}, "GUIDED", "Battery 1 is low 1"),
        (10.4, {"BATT_FS_LOW_ACT": 2.0}, "RTL", "Battery 1 is low 1"),
        (9.5, {"BATT_CRT_VOLT": 10.0, "BATT_FS_CRT_ACT": 1.0}, "LAND", "Battery 1 is critical 9"),
    ],
)
def test_low_battery_triggers_the_action_of_its_parameters(
    volts: float, given: dict[str, float], mode: str, said: str
) -> None:
    vehicle, texts = airborne()
    vehicle.failsafes.parameters |= {"SIM_BATT_VOLTAGE": volts, **given}
    vehicle.advance(61.0)
    vehicle.advance(69.0)
    assert (vehicle.mode, texts) == ("GUIDED", [])
    vehicle.advance(72.0)
    assert (vehicle.mode, texts[0].startswith(said)) == (mode, True)
    status = sys_status(vehicle)
    assert status.voltage_battery < volts * 1000
    assert not status.onboard_control_sensors_health & mavlink.MAV_SYS_STATUS_SENSOR_BATTERY


def test_copter_without_a_motor_falls() -> None:
    vehicle, texts = airborne()
    vehicle.failsafes.parameters["SIM_ENGINE_MUL"] = 0.0
    vehicle.advance(61.0)
    vehicle.advance(70.0)
    assert not vehicle.armed
    assert not vehicle.airborne
    assert texts[:2] == ["Potential Thrust Loss (2)", "Crash: Disarming"]


def test_flight_ended_by_a_failsafe_is_no_failure(tmp_path: Path) -> None:
    async def fly() -> None:
        async with on_strings(tmp_path) as (pilot, puppet):
            flying = asyncio.create_task(pilot.fly(pilot.flight(FAR, "mission")))
            while not puppet.vehicle.airborne:
                await asyncio.sleep(0.01)
            assert await pilot.befall(GPS_LOST) == {"SIM_GPS1_ENABLE": 0.0}
            await asyncio.wait_for(flying, 20)
            while puppet.vehicle.airborne:
                await asyncio.sleep(0.01)
            assert mode_of(puppet.vehicle) == "LAND"
            await asyncio.sleep(0.2)
            assert not puppet.vehicle.armed, "nobody takes it off again"
            assert await pilot.befall(GPS_REGAINED) == {"SIM_GPS1_ENABLE": 1.0}

    asyncio.run(fly())


def test_parameter_name_of_an_earlier_version_is_used(tmp_path: Path) -> None:
    async def ask() -> None:
        async with on_strings(tmp_path) as (pilot, puppet):
            parameters = puppet.vehicle.failsafes.parameters
            del parameters["SIM_GPS1_ENABLE"]
            parameters["SIM_GPS_DISABLE"] = 0.0
            assert await pilot.befall(GPS_LOST) == {"SIM_GPS_DISABLE": 1.0}
            assert parameters["SIM_GPS_DISABLE"] == 1.0
            assert await pilot.befall(GPS_LOST) == {"SIM_GPS_DISABLE": 1.0}, "again, though nothing changes"

    asyncio.run(ask())


@pytest.mark.parametrize(
    ("circumstance", "vehicle_type", "sentence"),
    [
        (COMPASS_LOST, "copter", "loss of its compasses: it has no SIM_MAG1_FAIL with .* and no SIM_MAG1_FAIL$"),
        (MOTOR_STOPPED, "plane", "failure of a motor: it has no SIM_ENGINE_MUL with SIM_ENGINE_FAIL$"),
        (battery(float("nan")), "copter", "did not take a battery of nan V: .* it says SIM_BATT_VOLTAGE 16.8"),
    ],
)
def test_unsupported_circumstance_gives_one_sentence(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    circumstance: Circumstance,
    vehicle_type: VehicleType,
    sentence: str,
) -> None:
    monkeypatch.setattr(sitl.circumstances, "ANSWER_S", 0.2)

    async def ask() -> None:
        async with on_strings(tmp_path, vehicle_type) as (pilot, _):
            with pytest.raises(NotSimulatedError, match=sentence):
                await pilot.befall(circumstance)

    asyncio.run(ask())


@pytest.mark.parametrize("leaves", [True, False])
def test_silent_vehicle_is_not_reported_as_unsupported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, leaves: bool
) -> None:
    monkeypatch.setattr(sitl.circumstances, "ANSWER_S", 0.2)

    async def ask() -> None:
        async with on_strings(tmp_path) as (pilot, puppet):
            puppet.tamper = lambda frame: b""
            await asyncio.sleep(0.1)  # messages under way arrive in this time
            if leaves:
                puppet.leave()
            with pytest.raises(NotSimulatedError, match="ended its connection before" if leaves else "was silent when"):
                await pilot.befall(GPS_LOST)

    asyncio.run(ask())


def test_plane_is_slower_against_the_wind_and_faster_with_it() -> None:
    arrivals = {}
    for from_deg in (None, 0.0, 180.0):
        vehicle, _ = airborne("plane")
        frame, north_e7 = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT, round(HOME.offset(5000, 0).lat_deg * 1e7)
        home = mavlink.MAVLink_mission_item_int_message(3, 1, 0, frame, 16, 0, 1, 0, 0, 0, 0, 0, 0, 0.0)
        place = (north_e7, round(HOME.lon_deg * 1e7), 50.0)
        vehicle.load([home, mavlink.MAVLink_mission_item_int_message(3, 1, 1, frame, 16, 0, 1, 0, 0, 0, 0, *place)])
        vehicle.set_mode(MODES["plane"]["AUTO"])
        if from_deg is not None:
            vehicle.simulate("SIM_WIND_DIR", from_deg)
            vehicle.simulate("SIM_WIND_SPD", 8.0)
        while vehicle.mode == "AUTO":
            vehicle.advance(vehicle.now_s + 1.0)
        arrivals[from_deg] = vehicle.now_s
    assert arrivals[180.0] < arrivals[None] - 30
    assert arrivals[0.0] > arrivals[None] + 60
