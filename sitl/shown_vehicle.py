"""A vehicle that nobody flies: a computed track, as a ground station sees it.

It speaks through the same `Channel` as the embedded vehicle, and refuses in words whatever an operator commands.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from sitl._autopilot import Autopilot
from sitl._failsafes import BATTERY_FULL_V
from sitl._kinematics import Motion, Point
from sitl.track import Track
from sitl.vehicle import READY_S, Home, VehicleType

REFUSAL = "Virtual time: this track is computed"
LOW_M = 0.1


class ShownVehicle(Autopilot):
    """One vehicle on its track, armed from second 0 on. It knows no parameters but its system ID."""

    takes_missions = False

    def __init__(self, sysid: int, home: Home, epoch_us: int, vehicle_type: VehicleType, track: Track) -> None:
        super().__init__(sysid, home, epoch_us, vehicle_type)
        self._track = track
        self.armed = True
        self.mode = "AUTO"
        self.failsafes.parameters.clear()

    def show(self, mission_s: float) -> None:
        """From now on say where it is at this second of the mission, which began when it was ready."""
        self.now_s = READY_S + mission_s
        self.airborne = self.vehicle_type != "rover" and self.motion.up_m > LOW_M

    @property
    def volts(self) -> float:
        """Nobody asks it for current."""
        return BATTERY_FULL_V

    @property
    def ready(self) -> bool:
        return True

    @property
    def motion(self) -> Motion:
        return self._track.course.at(self.now_s - READY_S)

    def _no(self) -> int:
        self.say(mavlink.MAV_SEVERITY_WARNING, REFUSAL)
        return int(mavlink.MAV_RESULT_DENIED)

    def arm(self) -> int:
        return self._no()

    def disarm(self, force: bool = False) -> int:
        return self._no()

    def take_off(self, altitude_m: float) -> int:
        return self._no()

    def set_mode(self, number: float) -> int:
        return self._no()

    def start_mission(self) -> int:
        return self._no()

    def set_speed(self, speed_ms: float) -> int:
        return self._no()

    def go_to(self, place: Point) -> int:
        return self._no()

    def load(self, mission: Sequence[Any]) -> None:
        raise AssertionError("it takes no missions")
