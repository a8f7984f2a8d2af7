"""Test plans that the pilot flies with embedded vehicles over TCP, and with vehicles that send wrong messages."""

from __future__ import annotations

import asyncio
import math
import random
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import common as mavlink

import sitl._autopilot
import sitl._mission_inbox
import sitl._mission_upload
import sitl.pilot
from sitl.modes import MODES
from sitl.pilot import Pilot
from sitl.plan import By, GoTo, Land, Loiter, Plan, PlanError, TakeOff
from sitl.procedure import READY_FOR_S
from sitl.track import track
from sitl.vehicle import FlightError, VehicleType
from tests.sitl.flying import DEADLINE_S, HOME, connect, embedded
from tests.sitl.puppet import Puppet, message_id, on_strings

SPEEDUP = 100.0
SYS_STATUS = mavlink.MAVLINK_MSG_ID_SYS_STATUS
PLAN = Plan((TakeOff(30), GoTo(150, 0, speed_ms=10), Loiter(10), GoTo(0, 100, altitude_m=40), GoTo(0, 0), Land()))
DRIVE = Plan((GoTo(100, 0), Loiter(10), GoTo(0, 0)))
TYPES: list[VehicleType] = ["copter", "plane", "rover"]


def plan_of(vehicle_type: VehicleType) -> Plan:
    return DRIVE if vehicle_type == "rover" else PLAN


def flown(vehicle_type: VehicleType, by: By, tlog: Path) -> Pilot:
    async def fly(port: int) -> Pilot:
        pilot = Pilot(3, connect(port), tlog, SPEEDUP, HOME, vehicle_type)
        await pilot.start()
        try:
            await pilot.fly(pilot.flight(plan_of(vehicle_type), by))
        finally:
            await pilot.close()
        return pilot

    with embedded(speedup=SPEEDUP, vehicle_type=vehicle_type) as vehicle:
        return asyncio.run(fly(vehicle.pilot_port))


def places(tlog: Path) -> Iterator[tuple[float, tuple[float, float, float]]]:
    """Yield (seconds since boot, metres from home) for each position in a telemetry log."""
    log = mavutil.mavlink_connection(str(tlog))
    while (message := log.recv_match(type="GLOBAL_POSITION_INT")) is not None:
        if message.lat:
            yield message.time_boot_ms / 1e3, HOME.metres_to(message.lat / 1e7, message.lon / 1e7, message.alt / 1e3)


@pytest.mark.parametrize("vehicle_type", TYPES)
def test_mission_in_auto_mode_follows_the_computed_track(vehicle_type: VehicleType, tmp_path: Path) -> None:
    """The vehicle is within a metre of the position that is computed for each second."""
    tlog = tmp_path / "3.tlog"
    pilot = flown(vehicle_type, "mission", tlog)
    assert pilot.state.armed is (vehicle_type == "rover")
    assert pilot.state.reached is not None
    computed = track(vehicle_type, plan_of(vehicle_type), heading_deg=HOME.heading_deg)
    samples = list(places(tlog))
    moving = next(index for index, (_, place) in enumerate(samples) if math.dist(place, (0, 0, 0)) > 1)
    shifts = [samples[moving][0] - tenth / 10 for tenth in range(300)]

    def apart(shift_s: float, count: int) -> float:
        return max(math.dist(computed.at(at_s - shift_s), place) for at_s, place in samples[moving : moving + count])

    rough_s = min(shifts, key=lambda shift_s: apart(shift_s, 5))
    shift_s = min((rough_s + hundredth / 100 for hundredth in range(-10, 11)), key=lambda shift_s: apart(shift_s, 5))
    assert apart(shift_s, len(samples)) < 1.0


@pytest.mark.parametrize("vehicle_type", TYPES)
def test_plan_in_guided_mode_reaches_its_places(vehicle_type: VehicleType, tmp_path: Path) -> None:
    tlog = tmp_path / "3.tlog"
    pilot = flown(vehicle_type, "guided", tlog)
    assert pilot.state.armed is (vehicle_type == "rover")
    near = {"copter": 2.0, "plane": 120.0, "rover": 5.0}[vehicle_type]
    way = [place for _, place in places(tlog)]
    for leg in plan_of(vehicle_type).legs:
        if isinstance(leg, GoTo):
            assert min(math.dist(place[:2], (leg.north_m, leg.east_m)) for place in way) <= near
    assert math.dist(way[-1][:2], (0, 0)) < (100 if vehicle_type == "plane" else 6)


def test_impossible_plan_is_refused_before_any_request(tmp_path: Path) -> None:
    async def fly() -> None:
        async with on_strings(tmp_path, "rover") as (pilot, _):
            with pytest.raises(PlanError, match="a rover neither takes off"):
                await pilot.fly(pilot.flight(PLAN, "mission"))

    asyncio.run(fly())


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(DEADLINE_S):
        while not condition():
            await asyncio.sleep(0.001)


def puppet_flown(
    tmp_path: Path, strings: Callable[[Puppet], None], vehicle_type: VehicleType = "copter", by: By = "mission"
) -> Pilot:
    """Fly the plan with a vehicle whose messages the function `strings` changes. Return the pilot."""

    async def fly() -> Pilot:
        async with on_strings(tmp_path, vehicle_type) as (pilot, puppet):
            strings(puppet)
            async with asyncio.timeout(DEADLINE_S):
                await pilot.fly(pilot.flight(plan_of(vehicle_type), by))
            return pilot

    return asyncio.run(fly())


def failure(tmp_path: Path, strings: Callable[[Puppet], None], after_m: float = 25.0, by: By = "mission") -> str:
    """Return the reason for which a flight of a copter fails.

    After the vehicle has reached a height of `after_m` metres, the function `strings` changes its messages.
    """

    async def fly() -> str:
        async with on_strings(tmp_path) as (pilot, puppet):
            flight = asyncio.create_task(pilot.fly(pilot.flight(PLAN, by)))
            await until(lambda: pilot.state.position is not None and pilot.state.position.relative_alt_m >= after_m)
            strings(puppet)
            with pytest.raises(FlightError) as error:
                async with asyncio.timeout(DEADLINE_S):
                    await flight
            return str(error.value)

    return asyncio.run(fly())


def without(monkeypatch: pytest.MonkeyPatch, *ids: int) -> Callable[[Puppet], None]:
    """Return a function that suppresses the messages with these IDs, or all messages. It also shortens the pilot's time
    limits.
    """

    def strings(puppet: Puppet) -> None:
        monkeypatch.setattr(sitl.pilot, "SILENCE_S", 0.3)
        puppet.tamper = lambda frame: b"" if not ids or message_id(frame) in ids else frame

    return strings


@pytest.mark.parametrize("by", ["mission", "guided"])
@pytest.mark.parametrize(
    ("lost", "said"),
    [
        ((), "it has been silent for "),
        ((mavlink.MAVLINK_MSG_ID_HEARTBEAT,), "it has sent no heartbeat for "),
        ((mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,), "it has sent no position for "),
    ],
)
def test_silent_vehicle_ends_the_flight_with_an_error(
    lost: tuple[int, ...], said: str, by: By, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    message = failure(tmp_path, without(monkeypatch, *lost), by=by)
    assert message.startswith("vehicle 3 did not fly its plan: waiting for ")
    assert said in message and "its last text is '" in message


def test_disconnected_vehicle_ends_the_flight_at_once(tmp_path: Path) -> None:
    assert "it ended the connection" in failure(tmp_path, Puppet.leave)


@pytest.mark.parametrize("by", ["mission", "guided"])
def test_vehicle_without_motors_ends_the_flight_with_its_leg(by: By, tmp_path: Path) -> None:
    message = failure(tmp_path, lambda puppet: puppet.vehicle.disarm(force=True) and None, after_m=39.0, by=by)
    assert "it disarmed on leg" in message and "of 6 (" in message


def test_vehicle_stuck_on_a_leg_ends_the_flight(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sitl.pilot, "LEAST_WAIT_S", 0.1)
    message = failure(tmp_path, lambda puppet: puppet.vehicle._stay(), after_m=5.0)
    assert "waiting for leg 1 of 6 (take off to 30 m), 240 simulated seconds were not enough" in message


def test_garbage_in_the_stream_is_counted(tmp_path: Path) -> None:
    rng = random.Random(1)

    def strings(puppet: Puppet) -> None:
        puppet.tamper = lambda frame: rng.randbytes(rng.randrange(20)) + frame if rng.random() < 0.1 else frame

    pilot = puppet_flown(tmp_path, strings)
    assert pilot.state.garbage > 0
    assert not pilot.state.armed


def test_undone_mode_is_requested_again(tmp_path: Path) -> None:
    async def fly() -> None:
        async with on_strings(tmp_path) as (pilot, puppet):
            flight = asyncio.create_task(pilot.fly(pilot.flight(PLAN, "mission")))
            await until(lambda: puppet.vehicle.airborne and puppet.vehicle.motion.up_m > 29)
            puppet.vehicle.set_mode(MODES["copter"]["GUIDED"])
            async with asyncio.timeout(DEADLINE_S):
                await flight
            assert pilot.state.reached is not None and not puppet.vehicle.armed

    asyncio.run(fly())


def test_forgotten_mission_is_uploaded_again(tmp_path: Path) -> None:
    """During its boot, the vehicle behaves like ArduCopter 3.5."""
    forgotten: list[int] = []

    def strings(puppet: Puppet) -> None:
        load = puppet.vehicle.load

        def forgetful(mission: object) -> None:
            forgotten.append(1)
            load([] if len(forgotten) == 1 else mission)  # type: ignore[arg-type]

        puppet.vehicle.load = forgetful  # type: ignore[method-assign]

    assert not puppet_flown(tmp_path, strings).state.armed
    assert len(forgotten) == 2


def test_lost_request_restarts_the_upload(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sitl._mission_upload, "RESEND_S", 0.1)
    lost: list[bytes] = []

    def strings(puppet: Puppet) -> None:
        def lossy(frame: bytes) -> bytes:
            if message_id(frame) == mavlink.MAVLINK_MSG_ID_MISSION_REQUEST_INT and len(lost) < 3:
                lost.append(frame)
                return b""
            return frame

        puppet.tamper = lossy

    assert not puppet_flown(tmp_path, strings).state.armed
    assert len(lost) == 3


def test_refused_mission_ends_the_flight_with_the_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sitl._mission_inbox, "MAX_ITEMS", 2)
    with pytest.raises(FlightError, match="it refused its mission with MAV_MISSION_NO_SPACE"):
        puppet_flown(tmp_path, lambda puppet: None)


def test_vehicle_that_never_becomes_ready_ends_the_flight(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sitl._autopilot, "READY_S", math.inf)
    monkeypatch.setattr(sitl.pilot, "LEAST_WAIT_S", 0.1)
    with pytest.raises(FlightError, match="ready to arm, 180 simulated seconds were not enough; it sent no text"):
        puppet_flown(tmp_path, lambda puppet: None)


@pytest.mark.parametrize("by", ["mission", "guided"])
def test_terminated_flight_ends_without_an_error(by: By, tmp_path: Path) -> None:
    async def fly() -> None:
        async with on_strings(tmp_path) as (pilot, puppet):
            flight = asyncio.create_task(pilot.fly(pilot.flight(PLAN, by)))
            await until(lambda: puppet.vehicle.motion.up_m > 29)
            async with asyncio.timeout(DEADLINE_S):
                await pilot.terminate_flight()
                await flight
            assert not puppet.vehicle.armed
            assert puppet.vehicle.motion.up_m == 0
            await until(lambda: any(text.startswith("SIM Hit ground") for text in pilot.state.texts))
            await pilot.stay_in_touch()  # returns at once

    asyncio.run(fly())


def test_vehicle_is_monitored_after_its_flight(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def listen() -> str:
        async with on_strings(tmp_path) as (pilot, puppet):
            await pilot.fly(pilot.ascent(10.0))
            without(monkeypatch)(puppet)
            with pytest.raises(FlightError) as error:
                await pilot.stay_in_touch()
            return str(error.value)

    assert "vehicle 3 did not stay in touch: waiting for its next message, it has been silent" in asyncio.run(listen())


@pytest.mark.parametrize("vehicle_type", TYPES)
@pytest.mark.parametrize("by", ["mission", "guided"])
def test_ready_vehicle_only_needs_arming(by: By, vehicle_type: VehicleType, tmp_path: Path) -> None:
    async def fly() -> None:
        async with on_strings(tmp_path, vehicle_type) as (pilot, puppet):
            flight = pilot.flight(plan_of(vehicle_type), by)
            await pilot.get_ready(flight)
            assert pilot.state.position is not None
            assert (puppet.vehicle.ready, puppet.vehicle.armed) == (True, False)
            assert puppet.vehicle.now_s >= sitl._autopilot.READY_S + READY_FOR_S
            assert bool(puppet.vehicle.mission) is (by == "mission")
            mission = puppet.vehicle.mission
            flying = asyncio.create_task(pilot.fly(flight))
            await until(lambda: puppet.vehicle.armed)
            assert puppet.vehicle.mission is mission
            flying.cancel()

    asyncio.run(fly())


def test_vehicle_that_revokes_its_readiness_is_not_ready(tmp_path: Path) -> None:
    """ArduPilot 4.7 reports for 2.4 s that a rover is ready. Then it reports for 17 s that the rover is not ready."""

    async def fly() -> None:
        async with on_strings(tmp_path, "rover") as (pilot, puppet):
            link = pilot.link

            def take_back(frame: bytes) -> bytes:
                if 2.0 < puppet.vehicle.now_s - sitl._autopilot.READY_S < 30.0 and message_id(frame) == SYS_STATUS:
                    link.state.ready_to_arm = False
                    return b""
                return frame

            puppet.tamper = take_back
            await pilot.get_ready(pilot.flight(DRIVE, "mission"))
            assert puppet.vehicle.now_s > sitl._autopilot.READY_S + 30.0 + READY_FOR_S

    asyncio.run(fly())


def test_pilot_stops_after_handing_over(tmp_path: Path) -> None:
    """If the pilot continued, it would request its own mode again."""

    async def fly() -> None:
        async with on_strings(tmp_path) as (pilot, puppet):
            flying = asyncio.create_task(pilot.fly(pilot.flight(PLAN, "guided")))
            await until(lambda: puppet.vehicle.motion.up_m > 29)
            pilot.hand_over()
            puppet.vehicle.set_mode(MODES["copter"]["RTL"])
            async with asyncio.timeout(DEADLINE_S):
                await flying
            await until(lambda: not puppet.vehicle.armed)
            assert puppet.vehicle.mode == "RTL"

    asyncio.run(fly())
