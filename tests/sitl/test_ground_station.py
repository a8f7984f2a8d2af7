"""Test a ground station on one UDP port: the frames that it receives, the commands that it sends, and its limits."""

from __future__ import annotations

import asyncio
import contextlib
import random
import socket
from collections.abc import AsyncIterator, Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

import sitl.ground_station
from sitl._mavlink_frames import FrameSplitter
from sitl._operator import MOST_COMMANDS, CommandLog
from sitl.address import ListenAddress, connected
from sitl.ground_station import GroundStation
from sitl.vehicle import VehicleError
from tests.sitl.flying import DEADLINE_S

GCS = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
VEHICLE = mavlink.MAVLink(None, srcSystem=3, srcComponent=1)
HEARTBEAT = mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3)


def land(sysid: int) -> bytes:
    return bytes(mavlink.MAVLink_command_long_message(sysid, 1, mavlink.MAV_CMD_NAV_LAND, 0, *[0.0] * 7).pack(GCS))


def ask(sysid: int) -> bytes:
    message = mavlink.MAVLink_command_long_message(sysid, 1, mavlink.MAV_CMD_REQUEST_MESSAGE, 0, 1, *[0.0] * 6)
    return bytes(message.pack(GCS))


class Field:
    """Vehicles 3 and 4, and a ground station. The test controls their sockets."""

    def __init__(self) -> None:
        self.ground = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.ground.bind(("127.0.0.1", 0))
        self.ground.setblocking(False)
        self.vehicles: dict[int, socket.socket] = {}
        self.taken_over: list[int] = []
        self.peer: object = None

    async def open(self) -> GroundStation:
        address = ListenAddress("127.0.0.1", self.ground.getsockname()[1])
        self.station = await GroundStation.open(address, lambda: 12.5, self.taken_over.extend)
        for sysid in (3, 4):
            ours, self.vehicles[sysid] = socket.socketpair()
            self.vehicles[sysid].setblocking(False)
            await self.station.attach(sysid + 10, sysid, ours)
        return self.station

    async def said(self) -> bytes:
        """Return the next datagram that the ground station receives."""

        def receive() -> bytes:
            data, self.peer = self.ground.recvfrom(65536)
            return data

        return await eventually(receive)

    async def next_command(self, sysid: int) -> bytes:
        return await eventually(lambda: self.vehicles[sysid].recv(65536))

    def tell(self, data: bytes) -> None:
        assert isinstance(self.peer, tuple)
        self.ground.sendto(data, self.peer)


async def eventually(receive: Callable[[], bytes]) -> bytes:
    async with asyncio.timeout(DEADLINE_S):
        while True:
            with contextlib.suppress(BlockingIOError):
                return receive()
            await asyncio.sleep(0.002)


@contextlib.asynccontextmanager
async def in_field() -> AsyncIterator[Field]:
    field = Field()
    station = await field.open()
    try:
        field.vehicles[3].send(HEARTBEAT.pack(VEHICLE))
        await field.said()
        yield field
    finally:
        station.close()
        field.ground.close()
        for vehicle in field.vehicles.values():
            vehicle.close()


def test_frames_of_all_vehicles_reach_the_station() -> None:
    async def story() -> None:
        async with in_field() as field:
            frame = bytes(HEARTBEAT.pack(VEHICLE))
            field.vehicles[3].send(frame[:7])
            field.vehicles[4].send(frame + frame)
            assert await field.said() == frame + frame
            field.vehicles[3].send(frame[7:])
            assert await field.said() == frame

    asyncio.run(story())


def test_command_reaches_its_vehicle_and_is_recorded() -> None:
    async def story() -> None:
        async with in_field() as field:
            field.tell(land(4))
            assert await field.next_command(4) == land(4)
            assert field.taken_over == [14]
            with pytest.raises(BlockingIOError):
                field.vehicles[3].recv(1)
            (command,) = field.station.to_json()["commands"]
            assert (command["at_s"], command["vehicles"], command["command"]) == (12.5, [14], "MAV_CMD_NAV_LAND")

    asyncio.run(story())


def test_requests_do_not_take_over_a_vehicle() -> None:
    async def story() -> None:
        async with in_field() as field:
            parameter = mavlink.MAVLink_param_set_message(3, 1, b"RTL_ALT", 5.0, 9)
            for frame in (HEARTBEAT.pack(GCS), ask(0), parameter.pack(GCS)):
                field.tell(bytes(frame))
                await field.next_command(3)
            assert field.taken_over == []
            assert [command["message"] for command in field.station.to_json()["commands"]] == ["PARAM_SET"]

    asyncio.run(story())


def test_station_may_disappear_and_return() -> None:
    async def story() -> None:
        async with in_field() as field:
            address = field.ground.getsockname()
            field.ground.close()
            for _ in range(20):
                field.vehicles[3].send(HEARTBEAT.pack(VEHICLE))
                await asyncio.sleep(0.002)
            field.ground = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            field.ground.bind(address)
            field.ground.setblocking(False)
            field.vehicles[3].send(HEARTBEAT.pack(VEHICLE))
            assert await field.said()

    asyncio.run(story())


def test_excess_and_invalid_datagrams_are_dropped_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sitl.ground_station, "MOST_DATAGRAMS_PER_S", 50)
    lots = random.Random(1)

    async def story() -> None:
        async with in_field() as field:
            for _ in range(40):
                field.tell(lots.randbytes(lots.randrange(1, 600)))
            field.tell(bytes(5000))
            for _ in range(300):
                field.tell(ask(3))
            await asyncio.sleep(0.3)
            figures = field.station.to_json()
            assert figures["dropped"] > 100
            assert figures["commands"] == [] or figures["received"] <= 150
            field.vehicles[4].send(HEARTBEAT.pack(VEHICLE))
            assert await field.said()

    asyncio.run(story())


def test_datagrams_of_other_senders_are_ignored() -> None:
    async def story() -> None:
        async with in_field() as field:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
                assert isinstance(field.peer, tuple)
                stranger.sendto(land(3), field.peer)
                await asyncio.sleep(0.05)
            assert field.station.to_json()["received"] == 0

    asyncio.run(story())


@given(st.data())
def test_splitter_yields_complete_frames_for_any_pieces(data: st.DataObject) -> None:
    frames = [bytes(HEARTBEAT.pack(VEHICLE)), land(3), bytes(HEARTBEAT.pack(VEHICLE, force_mavlink1=True))]
    stream = b"noise".join(frames)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=6)))
    splitter = FrameSplitter()
    pieces = [stream[begin:end] for begin, end in zip([0, *cuts], [*cuts, len(stream)], strict=True)]
    assert [frame for piece in pieces for frame in splitter.feed(piece)] == frames


@given(st.lists(st.binary(max_size=700), max_size=8))
def test_splitter_keeps_less_than_one_frame(pieces: list[bytes]) -> None:
    splitter = FrameSplitter()
    for piece in pieces:
        splitter.feed(piece)
        assert len(splitter._rest) < 12 + 255 + 13


def test_stick_messages_make_one_entry_and_the_log_is_bounded() -> None:
    log = CommandLog()
    for tenth in range(100):
        log.note(mavlink.MAVLink_manual_control_message(3, tenth, 0, 0, 0, 0), [3], tenth / 10)
    (entry,) = log.to_json()
    assert (entry["times"], entry["at_s"], entry["until_s"]) == (100, 0.0, 9.9)
    for number in range(MOST_COMMANDS + 9):
        log.note(mavlink.MAVLink_set_mode_message(3, 1, number), [3], 10.0)
    assert len(log.to_json()) == MOST_COMMANDS
    assert log.left_out == 10


@pytest.mark.parametrize(
    ("text", "host", "port"),
    [("127.0.0.1:14550", "127.0.0.1", 14550), ("[::1]:1", "::1", 1), ("base.local:65535", "base.local", 65535)],
)
def test_address_has_host_and_port(text: str, host: str, port: int) -> None:
    assert ListenAddress.parse(text) == ListenAddress(host, port)
    assert str(ListenAddress.parse(text)) == text


@pytest.mark.parametrize(
    "text",
    ["", "14550", ":14550", "host", "host:", "host:0", "host:65536", "host:x", "a b:1", "::1:5", "h:" + "9" * 99],
)
def test_invalid_address_gives_one_sentence(text: str) -> None:
    with pytest.raises(VehicleError, match=r"ground station|host"):
        ListenAddress.parse(text)


def test_unknown_host_gives_one_sentence() -> None:
    with pytest.raises(VehicleError, match=r"the ground station at nobody\.invalid:14550 cannot be sent"):
        asyncio.run(GroundStation.open(ListenAddress("nobody.invalid", 14550), lambda: 0.0, lambda vehicles: None))


def test_ipv4_address_of_a_name_is_preferred(monkeypatch: pytest.MonkeyPatch) -> None:
    ways = [
        (socket.AF_INET6, socket.SOCK_DGRAM, 17, "", ("::1", 14550, 0, 0)),
        (socket.AF_INET, socket.SOCK_DGRAM, 17, "", ("127.0.0.1", 14550)),
    ]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: ways)
    with connected(ListenAddress("localhost", 14550)) as sock:
        assert sock.getpeername() == ("127.0.0.1", 14550)
