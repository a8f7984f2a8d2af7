"""Implement the vehicle's side of the MAVLink mission protocol. The vehicle receives a new mission from a client, and
sends its current mission to a client.

The vehicle requests one mission item after another. A new mission replaces the old mission when it is complete. The
vehicle needs no timers. A client that gets no answer sends MISSION_COUNT again, which restarts the transfer. The result
codes are the same as those of ArduPilot (https://mavlink.io/en/services/mission.html; MAV_MISSION_RESULT). Item 0 is
the home position. The vehicle keeps its own home position.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from sitl._autopilot import FRAMES, ITEM_NAMES, MAX_ALTITUDE_M, Autopilot

MAX_ITEMS = 1000


class MissionInbox:
    """The state of mission transfers with one client. `receive` takes a message and returns the answers."""

    def __init__(self, vehicle: Autopilot) -> None:
        self._vehicle = vehicle
        self._expected: int | None = None  # number of items in the mission that is being received
        self._items: list[Any] = []

    def receive(self, kind: str, message: Any) -> Iterable[Any]:
        if getattr(message, "mission_type", mavlink.MAV_MISSION_TYPE_MISSION) != mavlink.MAV_MISSION_TYPE_MISSION:
            return [self._ack(message, mavlink.MAV_MISSION_UNSUPPORTED)]
        match kind:
            case "MISSION_COUNT":
                return [self._count(message)]
            case "MISSION_ITEM_INT":
                return [self._item(message)]
            case "MISSION_ITEM":
                return [self._item(_with_integers(message))]
            case "MISSION_REQUEST_LIST":
                return [mavlink.MAVLink_mission_count_message(*_sender(message), len(self._vehicle.mission))]
            case "MISSION_REQUEST_INT" | "MISSION_REQUEST":
                return [self._requested(message)]
        return []

    def _count(self, message: Any) -> Any:
        self._expected, self._items = None, []
        if not self._vehicle.takes_missions:
            return self._ack(message, mavlink.MAV_MISSION_DENIED)
        if message.count > MAX_ITEMS:
            return self._ack(message, mavlink.MAV_MISSION_NO_SPACE)
        if message.count == 0:
            self._vehicle.load([])
            return self._ack(message, mavlink.MAV_MISSION_ACCEPTED)
        self._expected = message.count
        return mavlink.MAVLink_mission_request_int_message(*_sender(message), 0)

    def _item(self, item: Any) -> Any:
        if self._expected is None:
            return self._ack(item, mavlink.MAV_MISSION_ERROR)
        if item.seq != len(self._items):
            return self._ack(item, mavlink.MAV_MISSION_INVALID_SEQUENCE)
        if item.seq > 0 and (result := _check(item)) != mavlink.MAV_MISSION_ACCEPTED:
            self._expected = None
            return self._ack(item, result)
        self._items.append(item)
        if len(self._items) < self._expected:
            return mavlink.MAVLink_mission_request_int_message(*_sender(item), len(self._items))
        self._vehicle.load(self._items)
        self._expected, self._items = None, []
        return self._ack(item, mavlink.MAV_MISSION_ACCEPTED)

    def _requested(self, message: Any) -> Any:
        if message.seq >= len(self._vehicle.mission):
            return self._ack(message, mavlink.MAV_MISSION_INVALID_SEQUENCE)
        item, home = self._vehicle.mission[message.seq], self._vehicle.home
        fields = (item.frame, item.command, 0, 1, item.param1, item.param2, item.param3, item.param4)
        place = (item.x, item.y, item.z)
        if message.seq == 0:
            fields = (mavlink.MAV_FRAME_GLOBAL, mavlink.MAV_CMD_NAV_WAYPOINT, 0, 1, 0.0, 0.0, 0.0, 0.0)
            place = (round(home.lat_deg * 1e7), round(home.lon_deg * 1e7), home.alt_m)
        return mavlink.MAVLink_mission_item_int_message(*_sender(message), message.seq, *fields, *place)

    def _ack(self, message: Any, result: int) -> Any:
        return mavlink.MAVLink_mission_ack_message(*_sender(message), result)


def _sender(message: Any) -> tuple[int, int]:
    """Return the system and component ID of the sender, to which the answer must be sent."""
    return message.get_srcSystem(), message.get_srcComponent()


def _with_integers(item: Any) -> Any:
    """Convert a MISSION_ITEM, whose degrees are floats, to a MISSION_ITEM_INT, whose degrees are integers. Values that
    are too large become the largest integer.
    """
    x, y = (round(degrees * 1e7) if abs(degrees) <= 180 else 2**31 - 1 for degrees in (item.x, item.y))
    fields = (item.param1, item.param2, item.param3, item.param4, x, y, item.z)
    converted = mavlink.MAVLink_mission_item_int_message(
        item.target_system, item.target_component, item.seq, item.frame, item.command, 0, 1, *fields
    )
    converted._header = item._header  # the next request goes to its sender
    return converted


def _check(item: Any) -> int:
    """Return the result code (MAV_MISSION_RESULT) for one mission item."""
    if item.command not in ITEM_NAMES:
        return int(mavlink.MAV_MISSION_UNSUPPORTED)
    if item.frame not in FRAMES and item.command != mavlink.MAV_CMD_DO_CHANGE_SPEED:
        return int(mavlink.MAV_MISSION_UNSUPPORTED_FRAME)
    for name in ("param1", "param2", "param3", "param4"):
        value = getattr(item, name)
        if math.isinf(value) or (math.isnan(value) and name != "param4"):  # in param4, NaN means any yaw
            return int(getattr(mavlink, f"MAV_MISSION_INVALID_{name.upper()}"))
    if abs(item.x) > 90e7:
        return int(mavlink.MAV_MISSION_INVALID_PARAM5_X)
    if abs(item.y) > 180e7:
        return int(mavlink.MAV_MISSION_INVALID_PARAM6_Y)
    if not abs(item.z) <= MAX_ALTITUDE_M:
        return int(mavlink.MAV_MISSION_INVALID_PARAM7)
    if item.command == mavlink.MAV_CMD_NAV_LOITER_TIME and item.param1 < 0:
        return int(mavlink.MAV_MISSION_INVALID_PARAM1)
    return int(mavlink.MAV_MISSION_ACCEPTED)
