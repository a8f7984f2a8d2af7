"""Fly a plan in GUIDED mode. The pilot sends the next place when the vehicle has reached the previous place. A plane
takes off in mode TAKEOFF. A plane cannot land in GUIDED mode, so its landing is a separate mission in AUTO mode.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl._by_mission import MissionFlight
from sitl._kinematics import LocalPlace
from sitl._mission_upload import SPEED_TYPES, on_earth
from sitl._pilot_link import PilotLink
from sitl._route import Waypoint, is_near, landing_begins, limit_s
from sitl._take_off import TakeOff
from sitl.procedure import Commander, HopelessError, ProcedureStep
from sitl.vehicle import VehicleType

GUIDED = ProcedureStep("mode GUIDED")

STANDING_MS = 0.3
POSITION_ONLY = (
    mavlink.POSITION_TARGET_TYPEMASK_VX_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_VY_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_VZ_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_AX_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_AY_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_AZ_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_YAW_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE
)


class GuidedFlight:
    """A flight in GUIDED mode: take off, then fly to one waypoint after another."""

    purpose = "fly its plan"

    def __init__(self, link: PilotLink, vehicle_type: VehicleType, waypoints: Sequence[Waypoint]) -> None:
        self._to = Commander(link, vehicle_type)
        self._waypoints = waypoints
        self._legs = [ProcedureStep(waypoint.leg, limit_s(waypoints, at)) for at, waypoint in enumerate(waypoints)]
        self._home = link.home
        self._take_off: TakeOff | None = TakeOff(link, vehicle_type, waypoints[0].place.up_m)
        self._landing: MissionFlight | None = None
        self._landing_begins = landing_begins(waypoints, vehicle_type)
        self._done = 0 if vehicle_type == "rover" else 1  # completed waypoints; the first waypoint is the take-off
        self._sent_to: int | None = None  # the waypoint that the vehicle was last sent to
        self._there_s: float | None = None  # time since which it has been there

    def next_step(self) -> ProcedureStep | None:
        if self._take_off is not None:
            if step := self._take_off.next_step():
                return step
            self._take_off = None
        if self._landing is not None:
            return self._landing.next_step()
        while self._done < len(self._waypoints):
            waypoint, leg = self._waypoints[self._done], self._legs[self._done]
            if not self._to.state.armed:
                if waypoint.kind == "land":
                    return None
                raise HopelessError(f"it disarmed on {leg.name}")
            if self._done == self._landing_begins:
                rest = self._waypoints[self._done :]  # the approach and the landing of a plane
                self._landing = MissionFlight(self._to.link, "plane", rest, under_way=True)
                return self._landing.next_step()
            if waypoint.kind == "land":
                return leg
            if not self._to.in_mode("GUIDED"):
                return GUIDED
            if not self._made(waypoint):
                return leg
            self._done, self._there_s = self._done + 1, None
        return None

    def ask(self, step: ProcedureStep) -> None:
        if self._take_off is not None:
            self._take_off.ask(step)
        elif self._landing is not None:
            self._landing.ask(step)
        elif step is GUIDED:
            self._to.set_mode("GUIDED")
        elif self._waypoints[self._done].kind == "land":
            if not self._to.in_mode("LAND"):
                self._to.set_mode("LAND")
        elif self._sent_to != self._done or not self._on_its_way():
            self._send_to(self._waypoints[self._done])

    def _made(self, waypoint: Waypoint) -> bool:
        if self._sent_to != self._done:
            return False
        if self._there_s is None and self._is_at(waypoint):
            self._there_s = self._to.state.time_s
        if self._there_s is None or self._to.state.time_s is None:
            return False
        return self._to.state.time_s - self._there_s >= waypoint.seconds

    def _is_at(self, waypoint: Waypoint) -> bool:
        position = self._to.state.position
        if position is None:
            return False
        place = LocalPlace(*self._home.metres_to(position.lat_deg, position.lon_deg, position.alt_m))
        return is_near(place, waypoint, self._to.vehicle_type)

    def _on_its_way(self) -> bool:
        """Return true if the vehicle has accepted its target. A plane acknowledges its target. A copter or a rover
        sends no acknowledgement, so the function checks whether the vehicle moves or has already reached the target.
        """
        if self._to.vehicle_type == "plane":
            return self._to.accepted(mavlink.MAV_CMD_DO_REPOSITION)
        position = self._to.state.position
        moves = position is not None and math.hypot(position.north_ms, position.east_ms, position.up_ms) > STANDING_MS
        return moves or self._is_at(self._waypoints[self._done])

    def _send_to(self, waypoint: Waypoint) -> None:
        self._sent_to = self._done
        self._set_speed(waypoint)
        frame = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT
        target = (self._to.link.sysid, mavlink.MAV_COMP_ID_AUTOPILOT1)
        place = (*on_earth(waypoint.place, self._home), waypoint.place.up_m)
        if self._to.vehicle_type == "plane":
            self._to.link.forget(mavlink.MAV_CMD_DO_REPOSITION)
            params = (-1.0, 0.0, 0.0, 0.0)
            reposition = mavlink.MAV_CMD_DO_REPOSITION
            self._to.link.send(mavlink.MAVLink_command_int_message(*target, frame, reposition, 0, 0, *params, *place))
            return
        self._to.link.send(
            mavlink.MAVLink_set_position_target_global_int_message(0, *target, frame, POSITION_ONLY, *place, *[0.0] * 8)
        )
        self._set_speed(waypoint)  # sent again, because ArduCopter forgets the speed at the first place

    def _set_speed(self, waypoint: Waypoint) -> None:
        kind = SPEED_TYPES[self._to.vehicle_type]
        self._to.link.command(mavlink.MAV_CMD_DO_CHANGE_SPEED, kind, waypoint.speed_ms, -1.0)
