"""Convert a route to a MAVLink mission and upload the mission. This module is the pilot's side of the mission protocol.

https://mavlink.io/en/services/mission.html. Item 0 is the home position. ArduPilot replaces it by its own home
position.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl._kinematics import LocalPlace
from sitl._pilot_link import PilotLink
from sitl._route import Waypoint
from sitl.vehicle import Home, VehicleType

RESEND_S = 1.0  # wall time without an answer after which an upload restarts

TAKE_OFF_PITCH_DEG = 15.0  # for a plane, whose default is 4 degrees; a copter ignores it

PASSING = (  # results that a restart of the upload may change
    mavlink.MAV_MISSION_ERROR,
    mavlink.MAV_MISSION_DENIED,
    mavlink.MAV_MISSION_OPERATION_CANCELLED,
)

SPEED_TYPES: dict[VehicleType, int] = {
    "copter": mavlink.SPEED_TYPE_GROUNDSPEED,
    "plane": mavlink.SPEED_TYPE_AIRSPEED,
    "rover": mavlink.SPEED_TYPE_GROUNDSPEED,
}

_COMMANDS = {
    "take_off": mavlink.MAV_CMD_NAV_TAKEOFF,
    "go_to": mavlink.MAV_CMD_NAV_WAYPOINT,
    "loiter": mavlink.MAV_CMD_NAV_LOITER_TIME,
    "land": mavlink.MAV_CMD_NAV_LAND,
}


def on_earth(place: LocalPlace, home: Home) -> tuple[int, int]:
    """Return the latitude and longitude of a place, in units of 1e-7 degrees. `place` is in metres from home."""
    there = home.offset(place.north_m, place.east_m)
    return round(there.lat_deg * 1e7), round(there.lon_deg * 1e7)


class MissionItems:
    """The mission items (MISSION_ITEM_INT) of a route, and the item number of each waypoint.

    If a plane's plan does not end with a landing, the mission ends with a circle around the last place. Without it,
    ArduPlane would fly home.
    """

    def __init__(self, waypoints: Sequence[Waypoint], home: Home, sysid: int, vehicle_type: VehicleType) -> None:
        self.items: list[Any] = []
        self.numbers: list[int] = []  # of the item of each waypoint
        self._sysid = sysid
        self._add(mavlink.MAV_CMD_NAV_WAYPOINT, (0.0,) * 4, on_earth(LocalPlace(0, 0, 0), home), 0.0)
        speed_ms: float | None = None
        for waypoint in waypoints:
            if waypoint.kind != "take_off" and waypoint.speed_ms != speed_ms:
                speed_ms = waypoint.speed_ms
                self._add(mavlink.MAV_CMD_DO_CHANGE_SPEED, (SPEED_TYPES[vehicle_type], speed_ms, -1.0, 0.0))
            self.numbers.append(len(self.items))
            place = on_earth(waypoint.place, home)
            first = TAKE_OFF_PITCH_DEG if waypoint.kind == "take_off" else waypoint.seconds
            params = (first, 0.0, 0.0, 0.0)
            self._add(_COMMANDS[waypoint.kind], params, place, waypoint.place.up_m)
        if vehicle_type == "plane" and waypoints[-1].kind != "land":
            place = on_earth(waypoints[-1].place, home)
            self._add(mavlink.MAV_CMD_NAV_LOITER_UNLIM, (0.0,) * 4, place, waypoints[-1].place.up_m)

    def _add(
        self,
        command: int,
        params: tuple[float, float, float, float],
        place: tuple[int, int] = (0, 0),
        up_m: float = 0.0,
    ) -> None:
        frame = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT
        target = (self._sysid, mavlink.MAV_COMP_ID_AUTOPILOT1)
        number = len(self.items)
        self.items.append(
            mavlink.MAVLink_mission_item_int_message(*target, number, frame, command, 0, 1, *params, *place, up_m)
        )


class MissionUpload:
    """The upload of a mission. The vehicle requests each item, and finally accepts or refuses the mission.

    `ask` begins the upload. If the vehicle does not answer for RESEND_S seconds, `ask` restarts it. If the vehicle
    rejects the mission, `refused` is its MAV_MISSION_RESULT.
    """

    def __init__(self, link: PilotLink, mission: MissionItems) -> None:
        self.accepted = False
        self.refused: str | None = None
        self._link = link
        self._mission = mission
        self._heard_at: float | None = None
        link.on_mission = self._receive

    def ask(self) -> None:
        now = time.monotonic()
        if self._heard_at is None or now - self._heard_at > RESEND_S:
            self._heard_at = now
            target = (self._link.sysid, mavlink.MAV_COMP_ID_AUTOPILOT1)
            self._link.send(mavlink.MAVLink_mission_count_message(*target, len(self._mission.items)))

    def _receive(self, message: Any) -> None:
        if self.accepted or self._heard_at is None:
            return
        self._heard_at = time.monotonic()
        if message.get_type() == "MISSION_ACK":
            self._end(message.type)
        elif message.seq < len(self._mission.items):
            self._link.send(self._mission.items[message.seq])

    def _end(self, result: int) -> None:
        state = self._link.state
        if result == mavlink.MAV_MISSION_ACCEPTED:
            self.accepted = True
            state.item = state.reached = None  # they belong to the previous mission
        elif result in PASSING:
            self._heard_at = None
        elif result != mavlink.MAV_MISSION_INVALID_SEQUENCE:  # a duplicated item; the transfer continues
            known = mavlink.enums["MAV_MISSION_RESULT"].get(result)
            self.refused = known.name if known else str(result)
