from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any

import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import common as mavlink

import sitl._pilot_link
import sitl._take_off
import sitl.pilot
from sitl._autopilot import Autopilot
from sitl._vehicle_state import Battery, ReportedPosition
from sitl.pilot import Pilot
from sitl.procedure import Commander
from sitl.serial_channel import ClientChannel
from sitl.streams import heartbeat
from sitl.vehicle import FlightError, VehicleType
from tests.sitl.flying import DEADLINE_S, HOME, connect, embedded

SPEEDUP = 100.0


@asynccontextmanager
async def piloting(
    port: int, tlog: Path, sysid: int = 3, speedup: float = SPEEDUP, vehicle_type: VehicleType = "copter"
) -> AsyncIterator[Pilot]:
    pilot = Pilot(sysid, connect(port), tlog, speedup, HOME, vehicle_type)
    await pilot.start()
    try:
        yield pilot
    finally:
        await pilot.close()


def messages_of(tlog: Path) -> Iterator[Any]:
    log = mavutil.mavlink_connection(str(tlog))
    while (message := log.recv_match()) is not None:
        yield message


def test_take_off_is_recorded_in_the_telemetry_log(tmp_path: Path) -> None:
    async def fly(port: int) -> Pilot:
        async with piloting(port, tmp_path / "3.tlog") as pilot:
            await pilot.fly(pilot.ascent(20.0))
            assert pilot.state.armed
            assert pilot.state.position is not None
            assert pilot.state.position.relative_alt_m >= 19.0
            return pilot

    with embedded(speedup=SPEEDUP) as vehicle:
        pilot = asyncio.run(fly(vehicle.pilot_port))
    flight = list(messages_of(tmp_path / "3.tlog"))
    assert len(flight) == pilot.state.messages
    assert max(message.relative_alt for message in flight if message.get_type() == "GLOBAL_POSITION_INT") >= 19_000
    assert "Arming motors" in [message.text for message in flight if message.get_type() == "STATUSTEXT"]
    times = [message._timestamp for message in flight]
    assert times == sorted(times)


def test_pilot_measures_the_real_time_factor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sitl._pilot_link, "MIN_RATE_SPAN_S", 0.3)

    async def factor(port: int, speedup: float) -> float:
        async with piloting(port, tmp_path / "3.tlog", speedup=speedup) as pilot:
            assert pilot.real_time_factor is None
            async with asyncio.timeout(DEADLINE_S):
                while pilot.real_time_factor is None:
                    await asyncio.sleep(0.01)
            return pilot.real_time_factor

    with embedded(speedup=50) as vehicle:
        assert asyncio.run(factor(vehicle.pilot_port, 50)) == pytest.approx(1.0, rel=0.3)
        assert asyncio.run(factor(vehicle.pilot_port, 100)) == pytest.approx(0.5, rel=0.3)


async def failure(port: int, tlog: Path, sysid: int = 3) -> str:
    async with piloting(port, tlog, sysid) as pilot:
        with pytest.raises(FlightError) as error:
            await pilot.fly(pilot.ascent(1000.0))
    return str(error.value)


def test_missed_deadline_names_vehicle_step_and_last_message(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sitl._take_off, "SLOWEST_CLIMB_MS", 100.0)
    monkeypatch.setattr(sitl.pilot, "LEAST_WAIT_S", 0.5)
    with embedded(speedup=SPEEDUP) as vehicle:
        message = asyncio.run(failure(vehicle.pilot_port, tmp_path / "3.tlog"))
    assert message.startswith("vehicle 3 did not take off: waiting for the climb, 70 simulated seconds were not enough")
    assert "its last text is 'Arming motors' (it is armed, in mode GUIDED; all it sent is in" in message
    assert "3.tlog" in message


def test_vehicle_with_another_system_id_is_refused(tmp_path: Path) -> None:
    with embedded(sysid=9) as vehicle:
        message = asyncio.run(failure(vehicle.pilot_port, tmp_path / "3.tlog", sysid=3))
    assert "vehicle 3" in message and "it sends the system ID 9" in message


def test_silent_vehicle_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sitl.pilot, "SILENCE_S", 0.1)
    with socket.create_server(("127.0.0.1", 0)) as mute:
        message = asyncio.run(failure(mute.getsockname()[1], tmp_path / "3.tlog"))
    assert "the first heartbeat" in message and "silent" in message


def test_vehicle_that_ends_during_take_off_is_given_up_at_once(tmp_path: Path) -> None:
    async def fly(port: int) -> None:
        async with piloting(port, tmp_path / "3.tlog") as pilot:
            flight = asyncio.create_task(pilot.fly(pilot.ascent(1000.0)))
            async with asyncio.timeout(DEADLINE_S):
                while not pilot.state.armed:
                    await asyncio.sleep(0.01)
                vehicle.process.kill()
                with pytest.raises(FlightError, match=r"vehicle 3 .*ended the connection"):
                    await flight

    with embedded(speedup=SPEEDUP) as vehicle:
        asyncio.run(fly(vehicle.pilot_port))


@contextmanager
def connected_pilot(tmp_path: Path) -> Iterator[tuple[Pilot, ClientChannel]]:
    """Provide a pilot, and the autopilot's end of its connection. The test sends the autopilot's messages."""
    ours, theirs = socket.socketpair()
    pilot = Pilot(3, ours, tmp_path / "3.tlog", 1.0, HOME)
    channel = ClientChannel(Autopilot(3, HOME, 0))
    with theirs:
        yield pilot, channel
        asyncio.run(pilot.close())


def test_garbage_is_counted_and_not_logged(tmp_path: Path) -> None:
    with connected_pilot(tmp_path) as (pilot, channel):
        channel.send_due()
        frames = channel.take()
        pilot.link.data_received(b"garbage" + frames + b"\x00" * 300)
        for byte in frames:  # the same bytes, one by one
            pilot.link.data_received(bytes([byte]))
        assert pilot.state.garbage == 2
        assert pilot.state.messages == 12
    assert len(list(messages_of(tmp_path / "3.tlog"))) == 12


def test_messages_of_other_components_are_ignored(tmp_path: Path) -> None:
    with connected_pilot(tmp_path) as (pilot, _):
        gimbal = mavlink.MAVLink(None, srcSystem=3, srcComponent=mavlink.MAV_COMP_ID_GIMBAL)
        pilot.link.data_received(mavlink.MAVLink_heartbeat_message(26, 8, 0, 7, 4, 3).pack(gimbal))
        assert pilot.state.mode is None
        assert pilot.state.messages == 1


def test_messages_of_unknown_dialects_are_logged(tmp_path: Path) -> None:
    unknown = b"\xfd\x01\x00\x00\x00\x03\x01\xff\xff\x7f\x01\xaa\xbb"
    with connected_pilot(tmp_path) as (pilot, _):
        pilot.link.data_received(unknown)
        assert pilot.state.messages == 1
    assert (tmp_path / "3.tlog").read_bytes()[8:] == unknown


def test_full_disk_ends_the_log_but_not_the_flight(tmp_path: Path) -> None:
    (tmp_path / "3.tlog").symlink_to("/dev/full")
    with connected_pilot(tmp_path) as (pilot, channel):
        for _ in range(1000):
            channel.send(heartbeat(channel._autopilot))
            pilot.link.data_received(channel.take())
        assert pilot.state.messages == 1000
        assert pilot.state.log_error is not None and "No space left" in pilot.state.log_error


def test_restarted_vehicle_continues_its_telemetry_log(tmp_path: Path) -> None:
    for _ in range(2):
        with connected_pilot(tmp_path) as (pilot, channel):
            channel.send_due()
            pilot.link.data_received(channel.take())
    assert len(list(messages_of(tmp_path / "3.tlog"))) == 12


def test_state_has_the_reported_motion_and_battery(tmp_path: Path) -> None:
    with connected_pilot(tmp_path) as (pilot, channel):
        vehicle = channel._autopilot
        channel.send_due()
        pilot.link.data_received(channel.take())
        assert pilot.state.position is None  # 0,0 is no position
        assert pilot.state.ready_to_arm is False
        vehicle.advance(12.0)
        channel.send_due()
        pilot.link.data_received(channel.take())
        assert pilot.state.position == ReportedPosition(-35.363262, 149.165237, 584.0, 0.0, heading_deg=270.0)
        assert pilot.state.battery == Battery(16.8, 1.0)
        assert pilot.state.item == 0


def test_refused_repetition_does_not_undo_an_accepted_take_off(tmp_path: Path) -> None:
    autopilot = mavlink.MAVLink(None, srcSystem=3, srcComponent=mavlink.MAV_COMP_ID_AUTOPILOT1)
    answers = [
        mavlink.MAVLink_command_ack_message(mavlink.MAV_CMD_NAV_TAKEOFF, result).pack(autopilot)
        for result in (mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_DENIED)
    ]
    with connected_pilot(tmp_path) as (pilot, _):
        to = Commander(pilot.link, "copter")
        pilot.link.data_received(b"".join(answers))
        assert to.accepted(mavlink.MAV_CMD_NAV_TAKEOFF)
        pilot.link.forget(mavlink.MAV_CMD_NAV_TAKEOFF)
        assert not to.accepted(mavlink.MAV_CMD_NAV_TAKEOFF)
