"""Show a vehicle on a computed flight path in a ground station.

The vehicle uses the same `ClientChannel` as the embedded vehicle. It refuses each command of an operator with a text
message.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from sitl._autopilot import Autopilot
from sitl._failsafes import BATTERY_FULL_V
from sitl._kinematics import LocalPlace, MotionState
from sitl.track import VehicleTrack
from sitl.vehicle import READY_S, Home, VehicleType

REFUSAL = "Virtual time: this track is computed"
LOW_M = 0.1


class ShownVehicle(Autopilot):
    """A vehicle on its flight path, armed from second 0 on. Its only parameter is its system ID."""

    takes_missions = False

    def __init__(self, sysid: int, home: Home, epoch_us: int, vehicle_type: VehicleType, track: VehicleTrack) -> None:
        super().__init__(sysid, home, epoch_us, vehicle_type)
        self._track = track
        self.armed = True
        self.mode = "AUTO"
        self.failsafes.parameters.clear()

    def show(self, mission_s: float) -> None:
        """Move the vehicle to its position at this mission second. The mission begins when the vehicle is ready."""
        self.now_s = READY_S + mission_s
        self.airborne = self.vehicle_type != "rover" and self.motion.up_m > LOW_M

    @property
    def volts(self) -> float:
        """The voltage of a full battery, because no battery is simulated."""
        return BATTERY_FULL_V

    @property
    def ready(self) -> bool:
        return True

    @property
    def motion(self) -> MotionState:
        return self._track.course.at(self.now_s - READY_S)

    def _deny(self) -> int:
        self.say(mavlink.MAV_SEVERITY_WARNING, REFUSAL)
        return int(mavlink.MAV_RESULT_DENIED)

    def arm(self) -> int:
        return self._deny()

    def disarm(self, force: bool = False) -> int:
        return self._deny()

    def take_off(self, altitude_m: float) -> int:
        return self._deny()

    def set_mode(self, number: float) -> int:
        return self._deny()

    def start_mission(self) -> int:
        return self._deny()

    def set_speed(self, speed_ms: float) -> int:
        return self._deny()

    def go_to(self, place: LocalPlace) -> int:
        return self._deny()

    def load(self, mission: Sequence[Any]) -> None:
        raise AssertionError("it takes no missions")
