"""How each type of vehicle moves: a `MotionModel` turns a wish and the present motion into segments."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from sitl._copter import Copter
from sitl._kinematics import Motion, Point, Segment
from sitl._plane import Plane
from sitl._rover import TURN_RATE_RADS, Rover
from sitl.vehicle import VehicleType


class MotionModel(Protocol):
    """Speeds are metres per second over the ground, places metres from home. Nothing jumps: what begins, begins here.

    Every answer has at least one segment.
    """

    @property
    def cruise_ms(self) -> float:
        """The speed of one who was given none."""

    def take_off(self, start: Motion, altitude_m: float) -> Sequence[Segment]: ...

    def go_to(self, start: Motion, place: Point, speed_ms: float, before: Point | None = None) -> Sequence[Segment]:
        """A plane comes back to the line that leads there from `before`, the place that it was sent to before."""

    def loiter(
        self, start: Motion, place: Point, speed_ms: float, seconds: float, after: Point | None = None
    ) -> Sequence[Segment]:
        """Stay at `place` for so many seconds after having come there, which may be infinite.

        A plane circles on until it heads for `after`, the place that it is sent to then.
        """

    def land(self, start: Motion, place: Point, before: Point | None = None) -> Sequence[Segment]:
        """Come down at `place`, and stand there; `before` as in `go_to`."""

    def ascent(self, start: Motion, altitude_m: float) -> Sequence[Segment]:
        """Take off by itself, without a mission, and do what it does then when it is told nothing, for ever."""


MODELS: dict[VehicleType, MotionModel] = {"copter": Copter(), "plane": Plane(), "rover": Rover()}
"""As they fly missions, in AUTO."""

AT_ONCE: dict[VehicleType, MotionModel] = {
    "copter": Copter(turning_s=1.2, settling_s=0.0),
    "plane": Plane(),
    "rover": Rover(start_s=0.0, corner_rads=TURN_RATE_RADS),
}
"""As they do what they are told outside of a mission: in GUIDED, and when they are to land."""
