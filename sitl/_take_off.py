"""Procedures for a take-off without a flight plan, for the take-off at the beginning of a plan, and for the forced end
of a flight.

The commands come from "Copter Commands in Guided Mode" in ArduPilot's developer documentation. A plane cannot take off
in GUIDED mode. It takes off in mode TAKEOFF, and climbs to the altitude in its parameter TKOFF_ALT. A rover only arms.
"""

from __future__ import annotations

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl._pilot_link import LOW_M, PilotLink
from sitl._route import CLIMBED
from sitl.procedure import ARM, HEARTBEAT, Commander, ProcedureStep
from sitl.vehicle import VehicleType

SLOWEST_CLIMB_MS = 0.5

PARAMETER = ProcedureStep("parameter TKOFF_ALT")
TAKE_OFF = ProcedureStep("the take-off command")
FALL = ProcedureStep("the fall")
FORCED_DISARM = ProcedureStep("disarming by force")

FORCE = 21196  # param2 of MAV_CMD_COMPONENT_ARM_DISARM: in flight, too
TKOFF_ALT = "TKOFF_ALT"


class TakeOff:
    """A take-off: set the mode, arm, and climb to `altitude_m` above home. A rover only arms."""

    purpose = "take off"

    def __init__(self, link: PilotLink, vehicle_type: VehicleType, altitude_m: float) -> None:
        self._to = Commander(link, vehicle_type)
        self._altitude_m = altitude_m
        self._climb = ProcedureStep("the climb", 60.0 + altitude_m / SLOWEST_CLIMB_MS)
        self._mode = "TAKEOFF" if vehicle_type == "plane" else "GUIDED"
        self._in_mode = ProcedureStep(f"mode {self._mode}")

    def next_step(self) -> ProcedureStep | None:
        link, state = self._to.link, self._to.state
        if state.mode is None:
            return HEARTBEAT
        if self._to.vehicle_type == "plane" and abs(link.parameters.get(TKOFF_ALT, 0.0) - self._altitude_m) > 0.01:
            return PARAMETER
        if not self._to.in_mode(self._mode):
            return self._in_mode
        if step := self._to.arming():
            return step
        if self._to.vehicle_type == "rover":
            return None
        if self._to.vehicle_type == "copter" and not self._to.accepted(mavlink.MAV_CMD_NAV_TAKEOFF):
            return TAKE_OFF
        if state.position is None or state.position.relative_alt_m < CLIMBED * self._altitude_m:
            return self._climb
        return None

    def ask(self, step: ProcedureStep) -> None:
        link = self._to.link
        if step is PARAMETER:
            link.set_parameter(TKOFF_ALT, self._altitude_m)
        elif step is self._in_mode:
            self._to.set_mode(self._mode)
        elif step is ARM:
            link.forget(mavlink.MAV_CMD_NAV_TAKEOFF)
            self._to.arm()
        elif step is TAKE_OFF:
            link.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, self._altitude_m)


class FlightTermination:
    """A forced end of a flight: disarm in the air, and fall to the ground."""

    purpose = "end its flight"

    def __init__(self, link: PilotLink) -> None:
        self._link = link
        self._disarmed_at: float | None = None

    def next_step(self) -> ProcedureStep | None:
        link, state = self._link, self._link.state
        if state.mode is None:
            return HEARTBEAT
        if state.armed:
            self._disarmed_at = None
            return FORCED_DISARM
        self._disarmed_at = self._disarmed_at or link.heard_at
        heard_since = link.position_at is not None and link.position_at > self._disarmed_at
        if not heard_since or state.position is None or state.position.relative_alt_m > LOW_M:
            return FALL
        return None

    def ask(self, step: ProcedureStep) -> None:
        if step is FORCED_DISARM:
            self._link.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, FORCE)
