"""How a rover moves. The figures are those of ArduRover's SITL (rover.parm) and its defaults, parameters by name."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from sitl.kinematics import Line, Motion, Point, Rest, Segment, end_of

CRUISE_MS = 5.0  # CRUISE_SPEED
ACCEL_MS2 = 1.0  # ATC_ACCEL_MAX
TURN_RATE_RADS = math.radians(45.0)  # what it takes to turn round first, as measured with 4.7


@dataclass(frozen=True)
class Rover:
    """The `MotionModel` of a rover: straight from place to place on level ground, with a stop at each.

    `start_s` goes by before it moves; what is given is measured with 4.7, in AUTO.
    """

    start_s: float = 1.5

    cruise_ms = CRUISE_MS

    def take_off(self, start: Motion, altitude_m: float) -> Sequence[Segment]:
        """It cannot, and stays."""
        return [Rest(start, 0.0)]

    def go_to(self, start: Motion, place: Point, speed_ms: float, before: Point | None = None) -> Sequence[Segment]:
        there = Line(start, place._replace(up_m=start.up_m), speed_ms, ACCEL_MS2)
        if not there.duration_s:
            return [there]
        turn_rad = abs((there.at(0.0).yaw_rad - start.yaw_rad + math.pi) % math.tau - math.pi)
        return [Rest(start, self.start_s + turn_rad / TURN_RATE_RADS), there]

    def loiter(
        self, start: Motion, place: Point, speed_ms: float, seconds: float, after: Point | None = None
    ) -> Sequence[Segment]:
        there = self.go_to(start, place, speed_ms)
        return [*there, Rest(end_of(there), seconds)]

    def land(self, start: Motion, place: Point, before: Point | None = None) -> Sequence[Segment]:
        """It never left the ground, and stays."""
        return [Rest(start, 0.0)]

    def ascent(self, start: Motion, altitude_m: float) -> Sequence[Segment]:
        return [Rest(start, math.inf)]
