"""Compute the motion of a copter. The values are ArduCopter's default parameters, or measurements with ArduCopter
4.7.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from sitl._kinematics import NEAR_M, LocalPlace, MotionSegment, MotionState, RestSegment, StraightLine, end_of

CRUISE_MS = 10.0  # WPNAV_SPEED
CLIMB_MS = 2.5  # WPNAV_SPEED_UP
DESCENT_MS = 1.5  # WPNAV_SPEED_DN
ACCEL_MS2 = 2.5  # WPNAV_ACCEL
VERTICAL_ACCEL_MS2 = 1.0  # WPNAV_ACCEL_Z
LAND_SLOWLY_M = 10.0  # LAND_ALT_LOW
LANDING_MS = 0.5  # LAND_SPEED
SPIN_UP_S = 3.0  # from arming to the first movement, measured


@dataclass(frozen=True)
class CopterMotion:
    """The motion of a copter: it stops at each place, and flies straight to the next one.

    It waits `turning_s` before it leaves a place, and `settling_s` before it descends. The default values were measured
    in AUTO mode, in which ArduCopter smooths the path (WPNAV_JERK).
    """

    turning_s: float = 3.0
    settling_s: float = 3.0

    cruise_ms = CRUISE_MS

    def take_off(self, start: MotionState, altitude_m: float) -> Sequence[MotionSegment]:
        top = LocalPlace(start.north_m, start.east_m, max(start.up_m, altitude_m))
        spin_up = [RestSegment(start, SPIN_UP_S)] if start.up_m < NEAR_M else []
        return [*spin_up, StraightLine(start, top, CLIMB_MS, VERTICAL_ACCEL_MS2)]

    def go_to(
        self, start: MotionState, place: LocalPlace, speed_ms: float, before: LocalPlace | None = None
    ) -> Sequence[MotionSegment]:
        level_m = math.dist(start.point[:2], place[:2])
        climb_m = place.up_m - start.up_m
        length_m = math.hypot(level_m, climb_m)
        if not length_m:
            return [RestSegment(start, 0.0)]
        # on a slope, the slower of the two axes determines the speed
        limits = [(level_m, speed_ms, ACCEL_MS2)] if level_m else []
        if climb_m:
            limits.append((abs(climb_m), CLIMB_MS if climb_m > 0 else DESCENT_MS, VERTICAL_ACCEL_MS2))
        speed = min(limit * length_m / part_m for part_m, limit, _ in limits)
        accel = min(limit * length_m / part_m for part_m, _, limit in limits)
        return [RestSegment(start, self.turning_s), StraightLine(start, place, speed, accel)]

    def loiter(
        self, start: MotionState, place: LocalPlace, speed_ms: float, seconds: float, after: LocalPlace | None = None
    ) -> Sequence[MotionSegment]:
        there = self.go_to(start, place, speed_ms)
        return [*there, RestSegment(end_of(there), seconds)]

    def land(self, start: MotionState, place: LocalPlace, before: LocalPlace | None = None) -> Sequence[MotionSegment]:
        there = self.go_to(start, place._replace(up_m=start.up_m), CRUISE_MS)
        above = end_of(there)
        segments: list[MotionSegment] = [*there, RestSegment(above, self.settling_s)]
        if above.up_m > LAND_SLOWLY_M:
            low = place._replace(up_m=LAND_SLOWLY_M)
            segments.append(StraightLine(above, low, DESCENT_MS, VERTICAL_ACCEL_MS2, to_ms=LANDING_MS))
        ground = place._replace(up_m=0.0)
        segments.append(StraightLine(end_of(segments), ground, LANDING_MS, VERTICAL_ACCEL_MS2, LANDING_MS, LANDING_MS))
        return [*segments, RestSegment(end_of(segments), 0.0)]

    def ascent(self, start: MotionState, altitude_m: float) -> Sequence[MotionSegment]:
        """Take off, and stay above the place of the take-off."""
        climb = self.take_off(start, altitude_m)
        return [*climb, RestSegment(end_of(climb), math.inf)]
