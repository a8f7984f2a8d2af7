from __future__ import annotations

import itertools
import random
import socket
import struct
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from tests.ucp.loops import run_until
from ucp import telemetry
from ucp.loop import Loop
from ucp.telemetry import (
    ARMED,
    DISARMED,
    EVENT_KINDS,
    FAILSAFE,
    MODE_CHANGE,
    POSITION,
    STATUS_TEXT,
    TelemetryEvents,
    VehicleConnection,
    describe,
    position_of,
)

STABILIZE, GUIDED = 0, 4


def autopilot(component: int = 1) -> Any:
    return mavlink.MAVLink(None, srcSystem=3, srcComponent=component)


def frames(*messages: Any, component: int = 1) -> bytes:
    return b"".join(message.pack(autopilot(component)) for message in messages)


def heartbeat(mode: int = STABILIZE, armed: bool = False) -> Any:
    return mavlink.MAVLink_heartbeat_message(2, 3, 128 if armed else 0, mode, 4, 3)


def position_msg(ms: int = 60_000, lat: int = -353632620, lon: int = 1491652370) -> Any:
    return mavlink.MAVLink_global_position_int_message(ms, lat, lon, 604_000, 20_000, 300, -400, -250, 27_000)


def good_estimate() -> Any:
    """Return a SYS_STATUS message which reports that the position estimate is good. Without such a message, positions
    are not logged.
    """
    bit = mavlink.MAV_SYS_STATUS_AHRS
    return mavlink.MAVLink_sys_status_message(bit, bit, bit, 0, 0xFFFF, -1, -1, 0, 0, 0, 0, 0, 0)


def text(words: str, identity: int = 0, chunk: int = 0, severity: int = 6) -> Any:
    return mavlink.MAVLink_statustext_message(severity, words.encode(), identity, chunk)


def source(position_interval_s: float = 10.0, seed: int = 1) -> TelemetryEvents:
    return TelemetryEvents(position_interval_s, random.Random(seed))


def test_mode_change_is_an_event_and_an_unchanged_mode_is_not() -> None:
    events = source()
    ((first, data),) = events.receive(frames(heartbeat(STABILIZE)), 0.0)
    assert (first, describe(first, data)) == (MODE_CHANGE, "[0.0 s] mode STABILIZE")
    assert events.receive(frames(heartbeat(STABILIZE)), 1.0) == []
    events.receive(frames(position_msg(5_000)), 1.5)
    ((second, data),) = events.receive(frames(heartbeat(GUIDED)), 2.0)
    assert (second, data) == (MODE_CHANGE, struct.pack(">IBII", 5_000, 2, STABILIZE, GUIDED))
    assert describe(second, data) == "[5.0 s] mode GUIDED (was STABILIZE)"


def test_arming_and_disarming_are_events() -> None:
    events = source()
    events.receive(frames(heartbeat(GUIDED)), 0.0)
    ((armed, data),) = events.receive(frames(heartbeat(GUIDED, armed=True)), 1.0)
    assert (armed, data) == (ARMED, struct.pack(">II", 0, GUIDED))
    ((disarmed, data),) = events.receive(frames(heartbeat(GUIDED)), 2.0)
    assert disarmed == DISARMED
    assert describe(disarmed, data) == "[0.0 s] disarmed in mode 4"


def test_status_text_is_an_event() -> None:
    ((event_id, data),) = source().receive(frames(text("PreArm: Need Position Estimate", severity=2)), 0.0)
    assert (event_id, data) == (STATUS_TEXT, struct.pack(">IB", 0, 2) + b"PreArm: Need Position Estimate")
    assert describe(event_id, data) == "[0.0 s] critical: PreArm: Need Position Estimate"


def test_status_text_in_chunks_is_one_event() -> None:
    words = "x" * 50 + "y" * 50 + "z"
    events = source()
    chunks = (text(words[at * 50 : at * 50 + 50], 7, at) for at in range(3))
    ((event_id, data),) = events.receive(frames(*chunks), 0.0)
    assert (event_id, data[5:].decode()) == (STATUS_TEXT, words)


def test_status_text_without_its_last_chunk_is_an_event() -> None:
    events = source()
    assert events.receive(frames(text("x" * 50, 7, 0)), 0.0) == []
    event_texts = [data[5:].decode() for _, data in events.receive(frames(text("next")), 1.0)]
    assert event_texts == ["x" * 50, "next"]


def test_event_data_never_exceeds_its_limit() -> None:
    events = source()
    events.receive(frames(*(text("é" * 25, 7, chunk) for chunk in range(255))), 0.0)
    ((_, data),) = events.receive(frames(text("", 7, 255)), 1.0)
    assert len(data) == telemetry.MAX_DATA_BYTES


def positions(events: TelemetryEvents, seconds: int) -> list[float]:
    """Give the converter a position every tenth of a second, and return the times of the resulting position events."""
    data = frames(good_estimate(), position_msg())
    return [now / 10 for now in range(10 * seconds) if events.receive(data, now / 10)]


def test_intervals_of_positions_are_random_around_the_mean() -> None:
    times = positions(source(10.0), 2000)
    gaps = [after - before for before, after in itertools.pairwise(times)]
    assert min(gaps) >= 5.0
    assert max(gaps) <= 15.2
    assert sum(gaps) / len(gaps) == pytest.approx(10.0, rel=0.1)
    assert max(gaps) - min(gaps) > 5.0


def test_equal_seeds_give_equal_intervals_of_positions() -> None:
    assert positions(source(seed=1), 100) == positions(source(seed=1), 100)
    assert positions(source(seed=1), 100) != positions(source(seed=2), 100)


def test_position_holds_attitude_battery_and_mode() -> None:
    events = source()
    status = mavlink.MAVLink_sys_status_message(0, 0, 0, 0, 15_900, 1_000, 77, 0, 0, 0, 0, 0, 0)
    events.receive(frames(heartbeat(GUIDED, armed=True), status, position_msg()), 0.0)
    events.receive(frames(mavlink.MAVLink_attitude_message(59_000, 0.1, -0.2, 3.0, 0.01, 0, float("inf"))), 1.0)
    events.receive(frames(mavlink.MAVLink_system_time_message(1_700_000_000_000_000, 59_500)), 1.0)
    ((event_id, data),) = events.receive(frames(position_msg()), 100.0)
    assert event_id == POSITION
    assert len(data) == 64
    fields = telemetry.Position.unpack(data)
    assert fields[:10] == (
        60_000,
        1_700_000_000_000_000,
        -353632620,
        1491652370,
        604_000,
        20_000,
        300,
        -400,
        -250,
        27_000,
    )
    assert fields[10:13] == pytest.approx((0.1, -0.2, 3.0))
    assert fields[13:] == (10, 0, 32_767, 15_900, 1_000, 77, GUIDED, 1)
    assert describe(event_id, data) == (
        "[60.0 s] at -35.3632620 149.1652370, 604.0 m, 20.0 m above home, 5.0 m/s, climb 2.5 m/s, "
        "heading 270, battery 15.9 V 77 %, mode 4 armed"
    )


def test_position_before_the_first_fix_is_no_event() -> None:
    events = source()
    nowhere = frames(good_estimate(), position_msg(lat=0, lon=0))
    assert not any(events.receive(nowhere, float(now)) for now in range(100))


def test_other_components_on_the_link_cause_no_events() -> None:
    events = source()
    assert events.receive(frames(heartbeat(GUIDED), text("hello"), component=154), 0.0) == []
    ground = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
    assert events.receive(frames(ground), 0.0) == []


def test_translator_reads_split_messages_between_garbage() -> None:
    events = source()
    stream = b"noise" + frames(heartbeat(GUIDED)) + b"\x00\xfd\xff" + bytes(300) + frames(text("still here"))
    made = [event for byte in stream for event in events.receive(bytes([byte]), 0.0)]
    assert [event_id for event_id, _ in made] == [MODE_CHANGE, STATUS_TEXT]
    assert events.garbage >= 2


def test_buffer_between_reads_is_limited() -> None:
    events = source()
    frame = frames(heartbeat())
    events.receive(frame[:10], 0.0)
    for _ in range(2000):  # no read ends at the end of a message
        events.receive(frame[10:] + frame[:10], 0.0)
        assert len(events._parser.buf) < 2 * len(frame)


@given(st.lists(st.binary(max_size=600), max_size=10))
def test_random_bytes_raise_no_exception(reads: list[bytes]) -> None:
    events = source()
    for now, data in enumerate(reads):
        events.receive(data, float(now))


def any_message(kind: type[Any], draw: Callable[[str], Any]) -> Any:
    return kind(*(draw(name) for name in kind.fieldtypes))


_FIELDS = {
    "uint8_t": st.integers(0, 2**8 - 1),
    "int8_t": st.integers(-(2**7), 2**7 - 1),
    "uint16_t": st.integers(0, 2**16 - 1),
    "int16_t": st.integers(-(2**15), 2**15 - 1),
    "uint32_t": st.integers(0, 2**32 - 1),
    "int32_t": st.integers(-(2**31), 2**31 - 1),
    "uint64_t": st.integers(0, 2**64 - 1),
    "float": st.floats(width=32),
    "char": st.binary(max_size=50),
}
_KINDS = (
    mavlink.MAVLink_heartbeat_message,
    mavlink.MAVLink_sys_status_message,
    mavlink.MAVLink_system_time_message,
    mavlink.MAVLink_attitude_message,
    mavlink.MAVLink_global_position_int_message,
    mavlink.MAVLink_statustext_message,
    mavlink.MAVLink_mission_current_message,
    mavlink.MAVLink_mission_item_reached_message,
)


@given(st.data(), st.lists(st.sampled_from(_KINDS), min_size=1, max_size=12))
def test_messages_with_random_values_give_readable_events(data: st.DataObject, kinds: list[Any]) -> None:
    events = TelemetryEvents(10.0, random.Random(1), EVENT_KINDS)
    for at, kind in enumerate(kinds):
        message = any_message(kind, lambda name: data.draw(_FIELDS[name]))
        for event_id, event_data in events.receive(frames(message), at * 100.0):
            assert 1 <= event_id <= 254
            assert len(event_data) <= telemetry.MAX_DATA_BYTES
            unreadable = describe(event_id, event_data) == "unreadable"
            # The largest MAV_SEVERITY is 7, and the largest MAV_STATE is 8.
            assert not unreadable or event_id in (STATUS_TEXT, FAILSAFE)


@given(st.integers(-5, 300), st.binary(max_size=300))
def test_random_events_have_a_printable_text(event_id: int, data: bytes) -> None:
    described = describe(event_id, data)
    assert described.isprintable()
    position = position_of(event_id, data)
    assert position is None or abs(position.lat_e7) <= 90e7


@pytest.mark.parametrize("event_id", [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 254])
def test_other_event_data_is_unreadable(event_id: int) -> None:
    assert describe(event_id, b"\x00") == "unreadable"


class FakeVehicle:
    """A vehicle that records the requested messages, and can close the connection."""

    def __init__(self, loop: Loop) -> None:
        self.requested: set[int] = set()
        self._loop = loop
        self._clients = 0
        self._client: socket.socket | None = None
        self._listener: socket.socket | None = None
        self._mav = mavlink.MAVLink(None)

    def serve(self, port: int = 0) -> int:
        self._listener = socket.create_server(("127.0.0.1", port))
        self._loop.watch(self._listener, readable=self._accept)
        return int(self._listener.getsockname()[1])

    def _accept(self) -> None:
        assert self._listener is not None
        self._client = self._listener.accept()[0]
        self._clients += 1
        self._client.send(b"hello %d" % self._clients)
        self._loop.watch(self._client, readable=self._read)

    def _read(self) -> None:
        assert self._client is not None
        for message in self._mav.parse_buffer(self._client.recv(1000)) or ():
            assert message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
            self.requested.add(int(message.param1))

    def hang_up(self) -> None:
        assert self._client is not None
        self._loop.watch(self._client)
        self._client.close()

    def close(self) -> None:
        assert self._listener is not None
        self._loop.watch(self._listener)
        self._listener.close()


def test_connection_waits_requests_messages_and_reconnects() -> None:
    loop, received = Loop(), bytearray()
    vehicle = FakeVehicle(loop)
    port = vehicle.serve()
    vehicle.close()
    connection = VehicleConnection(loop, "127.0.0.1", port, received.extend)
    run_until(loop, lambda: True, after_s=0.02)  # the first attempt finds no listener
    vehicle.serve(port)
    run_until(loop, lambda: vehicle.requested == {1, 2, 30, 33, 42})
    vehicle.hang_up()
    run_until(loop, lambda: b"hello 2" in received)
    assert bytes(received) == b"hello 1hello 2"
    connection.close()
    vehicle.close()
