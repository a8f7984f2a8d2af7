"""Test simulated events of a vehicle, such as a GPS failure. Parameters set these events, which cause failsafes."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

import sitl.circumstances
from sitl._autopilot import Autopilot
from sitl.circumstances import (
    COMPASS_LOST,
    FENCE_BREACHED,
    FENCE_LIFTED,
    GPS_LOST,
    GPS_REGAINED,
    MOTOR_STOPPED,
    RC_LOST,
    STATION_LOST,
    STATION_REGAINED,
    NotSimulatedError,
    SimulatedFailure,
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
    """Return a vehicle in flight, and the text messages that it has sent."""
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
        (battery(float("nan")), "copter", "did not simulate a battery of nan V: .* it reports SIM_BATT_VOLTAGE 16.8"),
    ],
)
def test_unsupported_circumstance_gives_one_sentence(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    circumstance: SimulatedFailure,
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
            await asyncio.sleep(0.1)  # messages in transit arrive in this time
            if leaves:
                puppet.leave()
            with pytest.raises(
                NotSimulatedError, match="ended its connection before" if leaves else "did not answer the request"
            ):
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


@pytest.mark.parametrize(
    ("vehicle_type", "given", "mode"),
    [
        ("copter", {"FS_GCS_ENABLE": 1.0}, "RTL"),
        ("copter", {"FS_GCS_ENABLE": 5.0}, "LAND"),
        ("copter", {}, "GUIDED"),
        ("plane", {"FS_GCS_ENABL": 1.0, "FS_LONG_ACTN": 1.0}, "RTL"),
        ("rover", {"FS_GCS_ENABLE": 1.0}, "HOLD"),
    ],
)
def test_vehicle_acts_when_its_ground_station_is_silent(
    vehicle_type: VehicleType, given: dict[str, float], mode: str
) -> None:
    vehicle, texts = airborne(vehicle_type)
    vehicle.failsafes.parameters |= given
    vehicle.advance(100.0)
    assert "GCS Failsafe" not in texts  # it never heard a ground station
    vehicle.hear(254)
    vehicle.advance(110.0)
    assert vehicle.station_heard_s is None
    vehicle.hear(255)
    vehicle.advance(114.0)
    assert "GCS Failsafe" not in texts
    vehicle.advance(116.0)
    assert (mode_of(vehicle), "GCS Failsafe" in texts) == (mode, bool(given))


@pytest.mark.parametrize(("vehicle_type", "mode"), [("copter", "RTL"), ("plane", "TAKEOFF"), ("rover", "HOLD")])
def test_vehicle_acts_when_its_remote_control_fails(vehicle_type: VehicleType, mode: str) -> None:
    vehicle, texts = airborne(vehicle_type)
    vehicle.failsafes.parameters["SIM_RC_FAIL"] = 1.0
    vehicle.advance(61.0)
    vehicle.advance(63.0)
    assert (mode_of(vehicle), texts[:1]) == (mode, ["Radio Failsafe"])
    status = sys_status(vehicle)
    rc = mavlink.MAV_SYS_STATUS_SENSOR_RC_RECEIVER
    assert status.onboard_control_sensors_enabled & rc and not status.onboard_control_sensors_health & rc


@pytest.mark.parametrize(("action", "mode"), [(0.0, "GUIDED"), (1.0, "RTL"), (2.0, "LAND")])
def test_copter_outside_of_its_fence_does_its_action(action: float, mode: str) -> None:
    vehicle, texts = airborne()
    fence = mavlink.MAV_SYS_STATUS_GEOFENCE
    assert not sys_status(vehicle).onboard_control_sensors_enabled & fence
    vehicle.failsafes.parameters |= {"FENCE_ACTION": action, **FENCE_BREACHED.ways[0]}
    vehicle.advance(61.0)
    assert (mode_of(vehicle), texts[:1]) == (mode, ["fence breached"])
    status = sys_status(vehicle)
    assert status.onboard_control_sensors_enabled & fence and not status.onboard_control_sensors_health & fence
    vehicle.failsafes.parameters |= FENCE_LIFTED.ways[0]
    vehicle.advance(62.0)
    assert sys_status(vehicle).onboard_control_sensors_health & fence


def test_pilot_has_a_system_id_of_its_own_and_the_station_falls_silent(tmp_path: Path) -> None:
    async def fly() -> None:
        async with on_strings(tmp_path) as (pilot, puppet):
            heard: list[int] = []
            puppet.vehicle.hear = heard.append  # type: ignore[method-assign]
            async with asyncio.timeout(20):
                while not {254, 255} <= set(heard):
                    await asyncio.sleep(0.01)
                assert await pilot.befall(STATION_LOST) == {}
                await asyncio.sleep(0.1)
                heard.clear()
                while heard.count(254) < 5:
                    await asyncio.sleep(0.01)
                assert 255 not in heard
                await pilot.befall(STATION_REGAINED)
                while 255 not in heard:
                    await asyncio.sleep(0.01)

    asyncio.run(fly())


def test_lost_remote_control_is_set_and_ends_the_flight_without_failure(tmp_path: Path) -> None:
    async def fly() -> None:
        async with on_strings(tmp_path) as (pilot, puppet):
            flying = asyncio.create_task(pilot.fly(pilot.flight(FAR, "mission")))
            while not pilot.state.has_moved:  # later than the last request to start the mission
                await asyncio.sleep(0.01)
            assert await pilot.befall(RC_LOST) == {"SIM_RC_FAIL": 1.0}
            await asyncio.wait_for(flying, 20)
            assert mode_of(puppet.vehicle) == "RTL"

    asyncio.run(fly())


def test_pilot_asks_for_no_telemetry_that_arrives_after_a_battery_failsafe(tmp_path: Path) -> None:
    async def fly() -> None:
        async with on_strings(tmp_path) as (pilot, puppet):
            await pilot.fly(pilot.ascent(20.0))
            await pilot.befall(battery(9.0))
            listening = asyncio.create_task(pilot.stay_in_touch())
            while not puppet.vehicle.failsafes.acting:
                await asyncio.sleep(0.01)
            puppet.vehicle.simulate("SIM_GPS1_ENABLE", 0.0)  # its checks before arming fail from now on
            while pilot.state.ready_to_arm:
                await asyncio.sleep(0.01)
            asked: list[int] = []
            pilot.link.command = lambda command, *params: asked.append(command)  # type: ignore[method-assign]
            beats = pilot.link.heartbeats
            pilot.link._asked_at = None
            while pilot.link.heartbeats < beats + 5:
                await asyncio.sleep(0.01)
            assert mavlink.MAV_CMD_SET_MESSAGE_INTERVAL not in asked
            listening.cancel()

    asyncio.run(fly())


def test_vehicle_that_never_left_its_home_is_reported(tmp_path: Path) -> None:
    async def fly() -> None:
        async with on_strings(tmp_path) as (pilot, puppet):
            flight = pilot.flight(FAR, "mission")
            puppet.vehicle.arm = lambda: 4  # type: ignore[method-assign]
            flying = asyncio.create_task(pilot.fly(flight))
            while not pilot.state.ready_to_arm:
                await asyncio.sleep(0.01)
            while pilot._awaited is None or pilot._awaited.name != "arming":
                await asyncio.sleep(0.01)
            sentence = pilot.shortfall(flight)
            assert sentence is not None
            assert "vehicle 3 did not fly its plan: waiting for arming, it has not left its home at the end" in sentence
            del puppet.vehicle.arm
            while not pilot.state.has_moved:
                await asyncio.sleep(0.01)
            assert pilot.shortfall(flight) is None
            flying.cancel()

    asyncio.run(fly())
