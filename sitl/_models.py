"""Select the motion model for each type of vehicle. A motion model converts a goal and the current motion into
segments.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from sitl._copter import CopterMotion
from sitl._kinematics import LocalPlace, MotionSegment, MotionState
from sitl._plane import PlaneMotion
from sitl._rover import TURN_RATE_RADS, RoverMotion
from sitl.vehicle import VehicleType


class MotionModel(Protocol):
    """A motion model. Speeds are ground speeds in metres per second, and places are in metres from home.

    A movement begins at the current motion, without jumps. Each method returns at least one segment.
    """

    @property
    def cruise_ms(self) -> float:
        """The default speed in metres per second."""

    def take_off(self, start: MotionState, altitude_m: float) -> Sequence[MotionSegment]: ...

    def go_to(
        self, start: MotionState, place: LocalPlace, speed_ms: float, before: LocalPlace | None = None
    ) -> Sequence[MotionSegment]:
        """Go to a place. A plane first returns to the straight line from `before`, its previous place."""

    def loiter(
        self, start: MotionState, place: LocalPlace, speed_ms: float, seconds: float, after: LocalPlace | None = None
    ) -> Sequence[MotionSegment]:
        """Go to `place` and stay there for `seconds`, which may be infinite.

        A plane continues its circle until it flies towards `after`, its next place.
        """

    def land(self, start: MotionState, place: LocalPlace, before: LocalPlace | None = None) -> Sequence[MotionSegment]:
        """Land at `place`, and stop at this place. `before` is the previous place, as in `go_to`."""

    def ascent(self, start: MotionState, altitude_m: float) -> Sequence[MotionSegment]:
        """Take off without a mission. Afterwards, a plane circles forever, and any other vehicle stays at its place."""


MODELS: dict[VehicleType, MotionModel] = {"copter": CopterMotion(), "plane": PlaneMotion(), "rover": RoverMotion()}
"""Type of vehicle -> its motion when it flies a mission in AUTO mode."""

AT_ONCE: dict[VehicleType, MotionModel] = {
    "copter": CopterMotion(turning_s=1.2, settling_s=0.0),
    "plane": PlaneMotion(),
    "rover": RoverMotion(start_s=0.0, corner_rads=TURN_RATE_RADS),
}
"""Type of vehicle -> its motion outside of missions: in GUIDED mode, and during a commanded landing. The vehicle then
reacts to commands at once. In AUTO mode it reacts with a delay, because ArduPilot smooths the path.
"""
