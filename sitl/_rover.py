"""Compute the motion of a rover, with ArduRover's default parameters and the parameters of its SITL (rover.parm)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from sitl._kinematics import LocalPlace, MotionSegment, MotionState, RestSegment, StraightLine, end_of

CRUISE_MS = 5.0  # CRUISE_SPEED
ACCEL_MS2 = 1.0  # ATC_ACCEL_MAX
TURN_RATE_RADS = math.radians(45.0)  # rate of a standing rover, measured with 4.7
CORNER_MS = 0.5  # it does not stop completely at a corner


@dataclass(frozen=True)
class RoverMotion:
    """The motion of a rover. It drives in straight lines on level ground, and almost stops at each place.

    A standing rover waits `start_s` before it moves. At corners it turns at `corner_rads` radians per second. The
    default values were measured with ArduRover 4.7 in AUTO mode, in which it smooths corners.
    """

    start_s: float = 1.5
    corner_rads: float = math.inf

    cruise_ms = CRUISE_MS

    def take_off(self, start: MotionState, altitude_m: float) -> Sequence[MotionSegment]:
        """Stay, because a rover cannot take off."""
        return [RestSegment(start, 0.0)]

    def go_to(
        self, start: MotionState, place: LocalPlace, speed_ms: float, before: LocalPlace | None = None
    ) -> Sequence[MotionSegment]:
        end = place._replace(up_m=start.up_m)
        passes_ms = min(CORNER_MS, math.sqrt(2 * ACCEL_MS2 * math.dist(start.point, end)))
        there = StraightLine(start, end, speed_ms, ACCEL_MS2, to_ms=min(passes_ms, speed_ms))
        if not there.duration_s:
            return [there]
        turn_rad = abs((there.at(0.0).yaw_rad - start.yaw_rad + math.pi) % math.tau - math.pi)
        if start == start.halted:
            return [RestSegment(start, self.start_s + turn_rad / TURN_RATE_RADS), there]
        return [RestSegment(start, turn_rad / self.corner_rads), there]

    def loiter(
        self, start: MotionState, place: LocalPlace, speed_ms: float, seconds: float, after: LocalPlace | None = None
    ) -> Sequence[MotionSegment]:
        there = self.go_to(start, place, speed_ms)
        return [*there, RestSegment(end_of(there), seconds)]

    def land(self, start: MotionState, place: LocalPlace, before: LocalPlace | None = None) -> Sequence[MotionSegment]:
        """Stay, because a rover is always on the ground."""
        return [RestSegment(start, 0.0)]

    def ascent(self, start: MotionState, altitude_m: float) -> Sequence[MotionSegment]:
        return [RestSegment(start, math.inf)]
