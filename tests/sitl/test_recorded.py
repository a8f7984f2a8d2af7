"""Test the position that the pilot computes from recorded telemetry of ArduPilot, and the events that an agent logs."""

from __future__ import annotations

import random
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common as mavlink

from sitl._pilot_link import PilotLink
from sitl.vehicle import Home
from tests.sitl.recorded import Name, frames, messages
from ucp.telemetry import EVENT_KINDS, POSITION, STATUS_TEXT, WAYPOINT, Position, TelemetryEvents, describe

HOME = Home(-35.363262, 149.165237, 584.0)
FIELD_M = 200.0  # maximum distance of the standing vehicles from HOME in metres
GOOD_S: dict[Name, float] = {"copter-mission": 22.9, "plane-mission": 21.9, "plane-guided": 21.9, "rover-mission": 42.1}


@pytest.fixture
def link(tmp_path: Path) -> Iterator[PilotLink]:
    ours, theirs = socket.socketpair()
    link = PilotLink(1, ours, tmp_path / "1.tlog", 8.0, HOME)
    with ours, theirs:
        yield link
    link.connection_lost(None)


@pytest.mark.parametrize("name", GOOD_S)
def test_position_is_unknown_until_the_estimate_is_good(name: Name, link: PilotLink) -> None:
    """A plane first reports a position near 0 N, 0 E, and a rover first reports an altitude of 0."""
    for frame in frames(name):
        link.data_received(frame)
        if (link.state.time_s or 0.0) < GOOD_S[name] - 0.1:
            assert link.state.position is None
        elif (link.state.time_s or 0.0) > GOOD_S[name] + 1.0:
            position = link.state.position
            assert position is not None
            north_m, east_m, up_m = HOME.metres_to(position.lat_deg, position.lon_deg, position.alt_m)
            assert abs(north_m) < 1000 and abs(east_m) < 1000
            assert position.relative_alt_m == pytest.approx(up_m)
            assert -3 < up_m < 80
            if link.state.time_s < 24:  # type: ignore[operator]
                assert abs(north_m) < FIELD_M and abs(east_m) < FIELD_M


@pytest.mark.parametrize(
    ("says", "height_m"),
    [
        ([(604_080, 20_000), (600_900, 5_000), (600_900, 3)], 0.003),
        ([(584_090, 583_900), (585_090, 584_900)], 1.09),
    ],
)
def test_height_is_relative_to_home_unless_home_is_wrong(
    says: list[tuple[int, int]], height_m: float, link: PilotLink
) -> None:
    """A copter without GPS always reports the same altitude. A rover sets its home position before it knows its
    altitude.
    """
    vehicle, ahrs = mavlink.MAVLink(None, srcSystem=1, srcComponent=1), mavlink.MAV_SYS_STATUS_AHRS
    well = mavlink.MAVLink_sys_status_message(ahrs, ahrs, ahrs, *[0] * 10)
    place = round(HOME.lat_deg * 1e7), round(HOME.lon_deg * 1e7)
    for second, (alt_mm, relative_mm) in enumerate(says):
        link.data_received(mavlink.MAVLink_system_time_message(0, second * 1000).pack(vehicle) + well.pack(vehicle))
        where = mavlink.MAVLink_global_position_int_message(second * 1000, *place, alt_mm, relative_mm, 0, 0, 0, 0)
        link.data_received(where.pack(vehicle))
    position = link.state.position
    assert position is not None
    assert position.relative_alt_m == pytest.approx(height_m, abs=0.01)
    assert position.alt_m == pytest.approx(HOME.alt_m + height_m, abs=0.01)


def logged(name: Name, position_interval_s: float = 1.0) -> list[tuple[int, bytes]]:
    source = TelemetryEvents(position_interval_s, random.Random(1), EVENT_KINDS)
    events = []
    for frame, message in messages(name):
        events += source.receive(frame, getattr(message, "time_boot_ms", 0) / 1e3)
    return events


@pytest.mark.parametrize("name", GOOD_S)
def test_positions_are_logged_with_heights_above_home(name: Name) -> None:
    positions = [Position.unpack(data) for event_id, data in logged(name) if event_id == POSITION]
    assert GOOD_S[name] * 1e3 - 100 < positions[0].vehicle_ms < GOOD_S[name] * 1e3 + 3000
    for position in positions:
        assert abs(position.lat_e7 / 1e7 - HOME.lat_deg) < 0.01
        height_m = position.alt_mm / 1e3 - HOME.alt_m
        assert position.relative_alt_mm / 1e3 == pytest.approx(height_m, abs=3)
    assert abs(positions[0].relative_alt_mm) < 1_000


def test_late_agent_knows_the_height_of_an_armed_rover() -> None:
    source = TelemetryEvents(1.0, random.Random(1), ["position"])
    came, heights_mm = False, []
    for frame, message in messages("rover-mission"):
        came = came or bool(getattr(message, "base_mode", 0) & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        if came:
            events = source.receive(frame, getattr(message, "time_boot_ms", 0) / 1e3)
            heights_mm += [Position.unpack(data).relative_alt_mm for _, data in events]
    assert heights_mm
    assert all(abs(height_mm) < 1_000 for height_mm in heights_mm)


REACHED: dict[Name, list[int]] = {
    "copter-mission": [1, 3, 4, 6],
    "plane-mission": [1, 3, 4, 6, 7],
    "rover-mission": [2, 3, 5],
}


@pytest.mark.parametrize("name", REACHED)
def test_reached_item_is_named_and_not_the_speed_command(name: Name) -> None:
    """ArduPilot 4.7 reports that a copter reached items 2, 3, 5 and 6: the take-off, a waypoint, the loiter, and a
    waypoint.
    """
    reached = [int.from_bytes(data[4:6], "big") for event_id, data in logged(name) if event_id == WAYPOINT]
    assert reached == REACHED[name]


def test_landed_plane_logs_its_arming_refusal_once() -> None:
    texts = [describe(event_id, data) for event_id, data in logged("plane-mission") if event_id == STATUS_TEXT]
    nagging = [text for text in texts if "PreArm: In landing sequence" in text]
    said = [
        message for _, message in messages("plane-mission") if getattr(message, "text", "").startswith("PreArm: In")
    ]
    assert (len(nagging), len(said)) == (1, 4)
