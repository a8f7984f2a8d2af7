"""Test the events that a vehicle's messages cause, such as waypoints, failsafes and battery levels, and their
descriptions.
"""

import random
import struct
from collections.abc import Iterable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from tests.ucp.test_telemetry import frames, position_msg
from ucp.telemetry import (
    ARMED,
    BATTERY,
    EVENT_KINDS,
    FAILSAFE,
    POSITION,
    STATUS_TEXT,
    WAYPOINT,
    EventKind,
    Position,
    TelemetryEvents,
    describe,
    position_of,
)

STANDBY, ACTIVE, CRITICAL, EMERGENCY = 3, 4, 5, 6
RADIO = mavlink.MAV_SYS_STATUS_SENSOR_RC_RECEIVER
FENCE = mavlink.MAV_SYS_STATUS_GEOFENCE
ALL = RADIO | FENCE | mavlink.MAV_SYS_STATUS_AHRS | mavlink.MAV_SYS_STATUS_SENSOR_BATTERY


def source(*log: EventKind) -> TelemetryEvents:
    return TelemetryEvents(10.0, random.Random(1), log)


def heartbeat(state: int, armed: bool = True) -> Any:
    return mavlink.MAVLink_heartbeat_message(2, 3, 128 if armed else 0, 4, state, 3)


def status(unhealthy: int = 0, left: int = -1, millivolt: int = 0xFFFF, enabled: int = ALL) -> Any:
    return mavlink.MAVLink_sys_status_message(
        ALL, enabled, ALL & ~unhealthy, 0, millivolt, 1_000, left, 0, 0, 0, 0, 0, 0
    )


def event_texts(events: TelemetryEvents, *messages: Any) -> list[str]:
    return [describe(event_id, data) for event_id, data in events.receive(frames(*messages), 0.0)]


def test_reached_mission_item_is_an_event() -> None:
    events = source("waypoint")
    ((event_id, data),) = events.receive(
        frames(position_msg(7_500), mavlink.MAVLink_mission_item_reached_message(300)), 0.0
    )
    assert (event_id, data) == (WAYPOINT, struct.pack(">IH", 7_500, 300))
    assert describe(event_id, data) == "[7.5 s] reached mission item 300"


def test_mission_item_reached_again_is_a_second_event() -> None:
    """A mission may jump back to an earlier item."""
    reached = mavlink.MAVLink_mission_item_reached_message(2)
    assert len(event_texts(source("waypoint"), reached, reached)) == 2


def test_start_escalation_and_end_of_a_failsafe_are_events() -> None:
    events = source("failsafe")
    assert event_texts(events, heartbeat(STANDBY, armed=False), heartbeat(ACTIVE)) == []
    assert event_texts(events, heartbeat(CRITICAL)) == ["[0.0 s] failsafe, critical"]
    assert event_texts(events, heartbeat(CRITICAL)) == []
    assert event_texts(events, heartbeat(EMERGENCY)) == ["[0.0 s] failsafe, emergency"]
    assert event_texts(events, heartbeat(ACTIVE)) == ["[0.0 s] failsafe over, active"]
    assert event_texts(events, heartbeat(STANDBY)) == []


def test_failsafe_event_names_the_failed_sensors() -> None:
    events = source("failsafe")
    events.receive(frames(position_msg(9_000), heartbeat(ACTIVE), status()), 0.0)
    ((event_id, data),) = events.receive(frames(status(RADIO)), 0.0)
    assert (event_id, data) == (FAILSAFE, struct.pack(">IBI", 9_000, ACTIVE, RADIO))
    assert describe(event_id, data) == "[9.0 s] failsafe, active: RC receiver"
    assert event_texts(events, heartbeat(CRITICAL)) == ["[9.0 s] failsafe, critical: RC receiver"]
    assert event_texts(events, status(ALL)) == ["[9.0 s] failsafe, critical: RC receiver, geofence, AHRS, battery"]
    assert event_texts(events, status(), heartbeat(ACTIVE)) == [
        "[9.0 s] failsafe, critical",
        "[9.0 s] failsafe over, active",
    ]


def test_breached_fence_is_a_failsafe_although_it_is_not_critical() -> None:
    assert event_texts(source("failsafe"), heartbeat(ACTIVE), status(FENCE)) == ["[0.0 s] failsafe, active: geofence"]


@pytest.mark.parametrize(
    ("bit", "name"), [(mavlink.MAV_SYS_STATUS_SENSOR_3D_MAG, "compass"), (mavlink.MAV_SYS_STATUS_SENSOR_GPS, "GPS")]
)
def test_sensor_lost_in_flight_is_a_failsafe_although_not_critical(bit: int, name: str) -> None:
    """ArduPilot 4.7 reports a lost compass only with this bit. For a plane, this is also true for a lost GPS."""
    lost = mavlink.MAVLink_sys_status_message(ALL | bit, ALL | bit, ALL, 0, 0xFFFF, -1, -1, 0, 0, 0, 0, 0, 0)
    assert event_texts(source("failsafe"), heartbeat(ACTIVE), lost) == [f"[0.0 s] failsafe, active: {name}"]


def test_sensor_unhealthy_on_the_ground_or_disabled_is_no_failsafe() -> None:
    events = source("failsafe")
    assert event_texts(events, heartbeat(STANDBY, armed=False), status(ALL)) == []
    assert event_texts(source("failsafe"), heartbeat(ACTIVE), status(ALL, enabled=0)) == []


def test_other_unhealthy_sensors_are_no_failsafe() -> None:
    gyro = mavlink.MAVLink_sys_status_message(ALL | 1, ALL | 1, ALL, 0, 0xFFFF, -1, -1, 0, 0, 0, 0, 0, 0)
    assert event_texts(source("failsafe"), heartbeat(ACTIVE), gyro) == []


def levels(percentages: Iterable[int]) -> list[int]:
    """Return the percentages of the battery's charge at which an event occurs."""
    events = source("battery")
    return [left for left in percentages if events.receive(frames(status(left=left)), 0.0)]


def test_battery_event_occurs_every_10_percent_and_every_5_when_low() -> None:
    assert levels(range(100, -1, -1)) == [100, 90, 80, 70, 60, 50, 40, 30, 20, 15, 10, 5, 0]


def test_skipped_battery_levels_and_noise_give_one_event() -> None:
    assert levels([77, 76, 41, 40, 41, 40, 42, 39, 12, 13, 12]) == [77, 41, 40, 12]


def test_changed_battery_is_an_event() -> None:
    assert levels([30, 29, 39, 40, 41, 100, 100, 90]) == [30, 40, 100, 90]


def test_battery_without_a_percentage_is_no_event() -> None:
    assert levels([-1, -1, 50, -1, 50]) == [50]


def test_battery_event_has_the_documented_text() -> None:
    ((event_id, data),) = source("battery").receive(frames(status(left=15, millivolt=14_320)), 0.0)
    assert (event_id, data) == (BATTERY, struct.pack(">IHhb", 0, 14_320, 1_000, 15))
    assert describe(event_id, data) == "[0.0 s] battery 15 %, 14.3 V, 10.0 A"
    assert describe(BATTERY, struct.pack(">IHhb", 500, 0xFFFF, -1, 15)) == "[0.5 s] battery 15 %"


@pytest.mark.parametrize(
    ("vehicle_type", "mode", "name"),
    [(2, 5, "LOITER"), (1, 12, "LOITER"), (10, 4, "HOLD"), (2, 200, "200"), (6, 0, "0")],
)
def test_modes_have_the_names_of_their_vehicle(vehicle_type: int, mode: int, name: str) -> None:
    message = mavlink.MAVLink_heartbeat_message(vehicle_type, 3, 0, mode, ACTIVE, 3)
    assert event_texts(source("mode"), message) == [f"[0.0 s] mode {name}"]


def test_default_kinds_are_mode_arming_text_and_position() -> None:
    events = TelemetryEvents(10.0, random.Random(1))
    reached = mavlink.MAVLink_mission_item_reached_message(2)
    made = [event_id for event_id, _ in events.receive(frames(heartbeat(CRITICAL), status(RADIO, 50), reached), 0.0)]
    assert made == [1, ARMED]
    text = mavlink.MAVLink_statustext_message(6, b"hello")
    made += [
        event_id
        for event_id, _ in events.receive(frames(position_msg()), 0.0)
        + events.receive(frames(position_msg(), text), 99.0)
    ]
    assert made == [1, ARMED, POSITION, STATUS_TEXT]


@pytest.mark.parametrize("kind", EVENT_KINDS)
def test_events_of_kinds_that_are_not_selected_are_not_logged(kind: EventKind) -> None:
    """If only one kind is selected, its events are the same as with all kinds."""
    stream = [
        frames(heartbeat(CRITICAL), status(RADIO, 50), mavlink.MAVLink_mission_item_reached_message(2), position_msg()),
        frames(
            heartbeat(ACTIVE, armed=False),
            status(),
            mavlink.MAVLink_statustext_message(6, b"hello"),
            position_msg(),
        ),
    ]

    def logged(log: Iterable[EventKind]) -> list[tuple[int, bytes]]:
        events = TelemetryEvents(10.0, random.Random(1), log)
        return [event for at, data in enumerate(stream) for event in events.receive(data, at * 99.0)]

    alone = logged([kind])
    assert {event_id for event_id, _ in alone} == set(EVENT_KINDS[kind])
    assert alone == [event for event in logged(EVENT_KINDS) if event[0] in EVENT_KINDS[kind]]


def test_every_kind_has_event_ids_of_its_own() -> None:
    assert sorted(event_id for ids in EVENT_KINDS.values() for event_id in ids) == list(range(1, 9))


FIELDS = st.tuples(
    *(st.integers(0, 2**32 - 1), st.integers(0, 2**64 - 1)),
    *(st.integers(-(10**9), 10**9) for _ in range(4)),
    *(st.integers(-(2**15), 2**15 - 1) for _ in range(3)),
    st.integers(0, 2**16 - 1),
    *(st.floats(width=32, allow_nan=False) for _ in range(3)),
    *(st.integers(-(2**15), 2**15 - 1) for _ in range(3)),
    *(st.integers(0, 2**16 - 1), st.integers(-(2**15), 2**15 - 1), st.integers(-128, 127)),
    *(st.integers(0, 2**32 - 1), st.integers(0, 255)),
)


@given(FIELDS)
def test_packed_position_record_unpacks_to_the_same_position(fields: tuple[Any, ...]) -> None:
    position = Position(*fields)
    assert len(position.pack()) == 64
    assert Position.unpack(position.pack()) == position
    on_earth = abs(position.lat_e7) <= 900_000_000
    assert position_of(POSITION, position.pack()) == (position if on_earth else None)
    assert position_of(STATUS_TEXT, position.pack()) is None
    assert position_of(POSITION, position.pack()[:-1]) is None
