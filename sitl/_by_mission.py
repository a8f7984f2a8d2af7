"""Fly a plan as a mission: upload it, and let the vehicle fly it in AUTO mode."""

from __future__ import annotations

from collections.abc import Sequence

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl._mission_upload import MissionItems, MissionUpload
from sitl._pilot_link import PilotLink
from sitl._route import Waypoint, limit_s
from sitl.procedure import ARM, HEARTBEAT, READY, Commander, HopelessError, ProcedureStep
from sitl.vehicle import VehicleType

GUIDED = ProcedureStep("mode GUIDED")
AUTO = ProcedureStep("mode AUTO")
UPLOAD = ProcedureStep("the upload of its mission")
START = ProcedureStep("the start of its mission")
STARTS = (mavlink.MAV_CMD_MISSION_START, mavlink.MAV_CMD_DO_SET_MODE)


class MissionFlight:
    """A flight as a mission: upload the plan, arm, start, and count the waypoints. A copter is armed in GUIDED mode,
    the other types in AUTO mode.

    `under_way` is true if the vehicle is already flying. In this case a disarmed vehicle has finished its flight, and
    the pilot does not arm it.
    """

    purpose = "fly its plan"

    def __init__(
        self, link: PilotLink, vehicle_type: VehicleType, waypoints: Sequence[Waypoint], under_way: bool = False
    ) -> None:
        self._to = Commander(link, vehicle_type)
        self._waypoints = waypoints
        self._legs = [ProcedureStep(waypoint.leg, limit_s(waypoints, at)) for at, waypoint in enumerate(waypoints)]
        self._mission = MissionItems(waypoints, link.home, link.sysid, vehicle_type)
        self._upload = MissionUpload(link, self._mission)
        self._under_way = under_way
        self._done = 0  # waypoints

    def next_step(self) -> ProcedureStep | None:
        state = self._to.state
        if state.mode is None:
            return HEARTBEAT
        if not ((state.ready_to_arm and state.position) or self._under_way):
            return READY
        if self._upload.refused is not None:
            raise HopelessError(f"it refused its mission with {self._upload.refused}")
        if not self._upload.accepted:
            return UPLOAD
        self._count()
        if self._done == len(self._waypoints):
            return None
        if not state.armed:
            if self._under_way:
                raise HopelessError(f"it disarmed on {self._legs[self._done].name}")
            return self._before_armed()
        if not self._to.in_mode("AUTO"):
            return AUTO if self._to.vehicle_type != "copter" or self._under_way else START
        if self._to.vehicle_type == "copter" and not self._to.accepted(mavlink.MAV_CMD_MISSION_START):
            return START
        return self._legs[self._done]

    def _count(self) -> None:
        """Count the waypoints that are complete. A landing is complete when the vehicle is disarmed."""
        state = self._to.state
        reached, heading_for = state.reached or 0, state.item or 0
        while self._done < len(self._waypoints):
            number = self._mission.numbers[self._done]
            landed = self._waypoints[self._done].kind == "land" and self._under_way and not state.armed
            if not (landed or reached >= number or heading_for > number):
                return
            self._done += 1
            self._under_way = True

    def _before_armed(self) -> ProcedureStep | None:
        mode = GUIDED if self._to.vehicle_type == "copter" else AUTO
        return self._to.arming() if self._to.in_mode("GUIDED" if mode is GUIDED else "AUTO") else mode

    def ask(self, step: ProcedureStep) -> None:
        if step in (AUTO, START) and self._to.refused(STARTS):
            # ArduCopter 3.5 forgets a mission that it was given before it had booted
            self._upload = MissionUpload(self._to.link, self._mission)
        elif step is UPLOAD:
            self._upload.ask()
        elif step is GUIDED:
            self._to.set_mode("GUIDED")
        elif step is AUTO:
            self._to.set_mode("AUTO")
        elif step is ARM:
            self._to.link.forget(mavlink.MAV_CMD_MISSION_START)
            self._to.arm()
        elif step is START:
            self._to.set_mode("AUTO")
            self._to.link.command(mavlink.MAV_CMD_MISSION_START)
