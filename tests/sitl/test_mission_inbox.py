"""Test the vehicle's part of the mission protocol with a client that violates the protocol."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from sitl._mission_inbox import MAX_ITEMS
from sitl.plan import GoTo, Land, Plan, TakeOff
from tests.sitl.cockpit import Cockpit

PLAN = Plan((TakeOff(30), GoTo(200, 100), Land()))


def count(items: int, mission_type: int = 0) -> Any:
    return mavlink.MAVLink_mission_count_message(3, 1, items, mission_type)


def item(
    seq: int,
    command: int = mavlink.MAV_CMD_NAV_TAKEOFF,
    frame: int = 3,
    params: tuple[float, float, float, float] = (0, 0, 0, 0),
    place: tuple[int, int, float] = (-353632620, 1491652370, 30.0),
) -> Any:
    return mavlink.MAVLink_mission_item_int_message(3, 1, seq, frame, command, 0, 1, *params, *place)


def answer(cockpit: Cockpit, message: Any) -> tuple[str, int]:
    """Return the type of the only answer, and the value of its field `seq` or `type`."""
    (reply,) = cockpit.tell(message)
    kind = reply.get_type()
    assert (reply.target_system, reply.target_component) == (255, 190)
    return kind, reply.type if kind == "MISSION_ACK" else reply.count if kind == "MISSION_COUNT" else reply.seq


def test_items_are_requested_in_order_and_acknowledged() -> None:
    cockpit = Cockpit()
    assert answer(cockpit, count(2)) == ("MISSION_REQUEST_INT", 0)
    assert answer(cockpit, item(0)) == ("MISSION_REQUEST_INT", 1)
    assert cockpit.vehicle.mission == ()  # not before the mission is complete
    assert answer(cockpit, item(1)) == ("MISSION_ACK", mavlink.MAV_MISSION_ACCEPTED)
    assert [one.seq for one in cockpit.vehicle.mission] == [0, 1]


def test_item_out_of_order_is_refused_without_ending_the_transfer() -> None:
    cockpit = Cockpit()
    answer(cockpit, count(3))
    assert answer(cockpit, item(1)) == ("MISSION_ACK", mavlink.MAV_MISSION_INVALID_SEQUENCE)
    assert answer(cockpit, item(0)) == ("MISSION_REQUEST_INT", 1)
    assert answer(cockpit, item(0)) == ("MISSION_ACK", mavlink.MAV_MISSION_INVALID_SEQUENCE)
    assert answer(cockpit, item(1)) == ("MISSION_REQUEST_INT", 2)
    assert answer(cockpit, item(2)) == ("MISSION_ACK", mavlink.MAV_MISSION_ACCEPTED)


def test_unrequested_item_is_an_error() -> None:
    cockpit = Cockpit()
    assert answer(cockpit, item(0)) == ("MISSION_ACK", mavlink.MAV_MISSION_ERROR)
    cockpit.load(PLAN)
    assert answer(cockpit, item(0)) == ("MISSION_ACK", mavlink.MAV_MISSION_ERROR)
    assert len(cockpit.vehicle.mission) > 2


def test_large_mission_is_refused_and_empty_one_clears_it() -> None:
    cockpit = Cockpit()
    cockpit.load(PLAN)
    assert answer(cockpit, count(MAX_ITEMS + 1)) == ("MISSION_ACK", mavlink.MAV_MISSION_NO_SPACE)
    assert len(cockpit.vehicle.mission) > 2
    assert answer(cockpit, count(0)) == ("MISSION_ACK", mavlink.MAV_MISSION_ACCEPTED)
    assert list(cockpit.vehicle.mission) == []


def test_new_count_restarts_the_transfer() -> None:
    cockpit = Cockpit()
    answer(cockpit, count(3))
    answer(cockpit, item(0))
    assert answer(cockpit, count(1)) == ("MISSION_REQUEST_INT", 0)
    assert answer(cockpit, item(0)) == ("MISSION_ACK", mavlink.MAV_MISSION_ACCEPTED)


@pytest.mark.parametrize(
    ("bad", "result"),
    [
        ({"command": mavlink.MAV_CMD_DO_JUMP}, mavlink.MAV_MISSION_UNSUPPORTED),
        ({"frame": mavlink.MAV_FRAME_LOCAL_NED}, mavlink.MAV_MISSION_UNSUPPORTED_FRAME),
        ({"params": (math.nan, 0, 0, 0)}, mavlink.MAV_MISSION_INVALID_PARAM1),
        ({"params": (0, math.inf, 0, 0)}, mavlink.MAV_MISSION_INVALID_PARAM2),
        ({"command": mavlink.MAV_CMD_NAV_LOITER_TIME, "params": (-1, 0, 0, 0)}, mavlink.MAV_MISSION_INVALID_PARAM1),
        ({"place": (900_000_001, 0, 30.0)}, mavlink.MAV_MISSION_INVALID_PARAM5_X),
        ({"place": (0, -1_800_000_001, 30.0)}, mavlink.MAV_MISSION_INVALID_PARAM6_Y),
        ({"place": (0, 0, math.nan)}, mavlink.MAV_MISSION_INVALID_PARAM7),
        ({"place": (0, 0, 1e9)}, mavlink.MAV_MISSION_INVALID_PARAM7),
    ],
)
def test_impossible_item_ends_the_transfer_with_a_reason(bad: dict[str, Any], result: int) -> None:
    cockpit = Cockpit()
    cockpit.load(PLAN)
    before = cockpit.vehicle.mission
    answer(cockpit, count(3))
    answer(cockpit, item(0))
    assert answer(cockpit, item(1, **bad)) == ("MISSION_ACK", result)
    assert answer(cockpit, item(2)) == ("MISSION_ACK", mavlink.MAV_MISSION_ERROR)
    assert cockpit.vehicle.mission is before


@pytest.mark.parametrize("degrees", [math.nan, math.inf, 200.0])
def test_impossible_float_coordinates_are_refused(degrees: float) -> None:
    cockpit = Cockpit()
    answer(cockpit, count(2))
    answer(cockpit, item(0))
    floats = mavlink.MAVLink_mission_item_message(3, 1, 1, 3, 22, 0, 1, 0, 0, 0, 0, degrees, 149.0, 30.0)
    assert answer(cockpit, floats) == ("MISSION_ACK", mavlink.MAV_MISSION_INVALID_PARAM5_X)


def test_items_with_float_coordinates_are_accepted() -> None:
    cockpit = Cockpit()
    answer(cockpit, count(1))
    floats = mavlink.MAVLink_mission_item_message(3, 1, 0, 3, 22, 0, 1, 0, 0, 0, 0, -35.5, 149.25, 30.0)
    assert answer(cockpit, floats) == ("MISSION_ACK", mavlink.MAV_MISSION_ACCEPTED)
    assert (cockpit.vehicle.mission[0].x, cockpit.vehicle.mission[0].y) == (-355_000_000, 1_492_500_000)


def test_fence_is_not_accepted_as_a_mission() -> None:
    cockpit = Cockpit()
    assert answer(cockpit, count(1, mavlink.MAV_MISSION_TYPE_FENCE)) == ("MISSION_ACK", mavlink.MAV_MISSION_UNSUPPORTED)


def test_mission_is_read_back_with_home_as_first_item() -> None:
    cockpit = Cockpit()
    sent = cockpit.load(PLAN).items
    assert answer(cockpit, mavlink.MAVLink_mission_request_list_message(3, 1)) == ("MISSION_COUNT", len(sent))
    home, *others = (
        cockpit.tell(mavlink.MAVLink_mission_request_int_message(3, 1, seq))[0] for seq in range(len(sent))
    )
    assert (home.x, home.y, home.z) == (-353632620, 1491652370, 584.0)
    names = ("seq", "command", "frame", "param1", "param2", "x", "y", "z")
    for mine, back in zip(sent[1:], others, strict=True):
        assert [getattr(mine, name) for name in names] == pytest.approx([getattr(back, name) for name in names])
    beyond = mavlink.MAVLink_mission_request_int_message(3, 1, len(sent))
    assert answer(cockpit, beyond) == ("MISSION_ACK", mavlink.MAV_MISSION_INVALID_SEQUENCE)


floats = st.floats(width=32)
words = st.integers(-(2**31), 2**31 - 1)


@given(
    st.lists(st.tuples(st.sampled_from([16, 17, 19, 20, 21, 22, 178]), st.tuples(*[floats] * 4), words, words, floats))
)
def test_any_accepted_mission_is_flown_without_error(items: list[Any]) -> None:
    cockpit = Cockpit("plane")
    cockpit.ready()
    accepted = [item(0), item(1)]
    for command, params, x, y, z in items:
        candidate = item(len(accepted), command, 3, params, (x, y, z))
        probe = Cockpit("plane")
        answer(probe, count(len(accepted) + 2))
        for one in accepted:
            answer(probe, one)
        if answer(probe, candidate)[0] == "MISSION_REQUEST_INT":
            accepted.append(candidate)
    answer(cockpit, count(len(accepted)))
    for one in accepted:
        cockpit.tell(one)
    cockpit.mode("AUTO")
    cockpit.arm()
    for minutes in range(1, 20):
        cockpit.fly(60.0 * minutes, 13.0)
        cockpit.channel.send_due()
        assert all(map(math.isfinite, cockpit.place))
