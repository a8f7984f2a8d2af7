"""How a plane moves: never slower than it flies, in arcs and straight lines.

The figures are those of ArduPlane's SITL (plane.parm, parameters by name). Its paths are shortest turns, as those of
Dubins (1957), not those of ArduPlane's L1 controller: turns may differ from that by some tens of metres.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from sitl.kinematics import NEAR_M, Arc, Climbing, Line, Motion, Point, Segment, end_of

CRUISE_MS = 22.0  # AIRSPEED_CRUISE
CLIMB_MS = 5.0  # TECS_CLMB_MAX
LOITER_RADIUS_M = 80.0  # WP_LOITER_RAD, clockwise
REACHED_M = 50.0  # WP_RADIUS
TURN_RADIUS_M = 50.0  # so that a right angle, flown by at REACHED_M, meets the next leg
LOW_M = 10.0  # low enough to land from a circle of LOITER_RADIUS_M
RUNWAY_ACCEL_MS2 = 4.0
RUNWAY_M = CRUISE_MS**2 / (2 * RUNWAY_ACCEL_MS2)  # from standing to flying, and back


class Plane:
    """The `MotionModel` of a plane: it flies by the places of a plan and circles where it is to stay."""

    cruise_ms = CRUISE_MS

    def take_off(self, start: Motion, altitude_m: float) -> Sequence[Segment]:
        run = Line(start, _ahead(start, RUNWAY_M), CRUISE_MS, RUNWAY_ACCEL_MS2, to_ms=CRUISE_MS)
        path = _Path(end_of([run]), CRUISE_MS, altitude_m, CLIMB_MS)
        path.straight(CRUISE_MS * max(0.0, altitude_m - start.up_m) / CLIMB_MS)
        return [run, *path.segments]

    def go_to(self, start: Motion, place: Point, speed_ms: float) -> Sequence[Segment]:
        return _fly_by(start, place, speed_ms, CLIMB_MS, REACHED_M)

    def loiter(self, start: Motion, place: Point, speed_ms: float, seconds: float) -> Sequence[Segment]:
        """From one clockwise circle, the turn that begins here, along the tangent to the other, round the place."""
        path = _Path(start, speed_ms, place.up_m, CLIMB_MS)
        turning = _beside(start, LOITER_RADIUS_M)
        north, east = place.north_m - turning[0], place.east_m - turning[1]
        if (across_m := math.hypot(north, east)) > NEAR_M:
            path.arc(turning, (math.atan2(east, north) - start.yaw_rad) % math.tau)
            path.straight(across_m)
        path.arc(place[:2], seconds * speed_ms / LOITER_RADIUS_M)
        return path.segments

    def land(self, start: Motion, place: Point) -> Sequence[Segment]:
        """Glide straight to the place, and roll to a stand; who is too high for that circles down before."""
        glide_s = _duration_s(_fly_by(start, place, CRUISE_MS, 0.0, 0.0))
        if start.up_m > CLIMB_MS * glide_s:
            circling = self.loiter(start, place._replace(up_m=LOW_M), CRUISE_MS, (start.up_m - LOW_M) / CLIMB_MS)
            return [*circling, *self.land(end_of(circling), place)]
        ground = place._replace(up_m=0.0)
        glide = _fly_by(start, ground, CRUISE_MS, start.up_m / glide_s if glide_s else 0.0, 0.0)
        touchdown = replace(end_of(glide), up_m=0.0)
        return [*glide, Line(touchdown, _ahead(touchdown, RUNWAY_M), CRUISE_MS, RUNWAY_ACCEL_MS2, from_ms=CRUISE_MS)]

    def idle(self, start: Motion) -> Sequence[Segment]:
        return self.loiter(start, start.point, CRUISE_MS, math.inf)


def _duration_s(segments: Sequence[Segment]) -> float:
    return sum(part.duration_s for part in segments)


class _Path:
    """Segments in the making, at one speed, climbing or sinking to one altitude at one rate."""

    def __init__(self, start: Motion, speed_ms: float, up_m: float, rate_ms: float) -> None:
        self.segments: list[Segment] = []
        self.speed_ms = speed_ms
        self._end, self._up_m, self._rate_ms = start, up_m, rate_ms

    def straight(self, length_m: float) -> None:
        end = _ahead(self._end, length_m)
        self._add(Line(self._end, end, self.speed_ms, RUNWAY_ACCEL_MS2, self.speed_ms, self.speed_ms))

    def arc(self, centre: tuple[float, float], turn_rad: float) -> None:
        self._add(Arc(self._end, centre, turn_rad, self.speed_ms))

    def _add(self, level: Segment) -> None:
        self.segments.append(Climbing(level, self._up_m, self._rate_ms))
        if math.isfinite(level.duration_s):
            self._end = end_of(self.segments)


def _fly_by(start: Motion, place: Point, speed_ms: float, rate_ms: float, reached_m: float) -> Sequence[Segment]:
    """Turn towards `place`, whichever way is shorter, and go straight until it is `reached_m` away."""
    path = _Path(start, speed_ms, place.up_m, rate_ms)
    if math.dist(start.point[:2], place[:2]) > max(reached_m, NEAR_M):
        ways = [way for side in (1, -1) if (way := _turn_towards(start, place, side)) is not None]
        centre, turn_rad, straight_m = min(ways, key=lambda way: abs(way[1]) * TURN_RADIUS_M + way[2])
        if abs(turn_rad) > NEAR_M:
            path.arc(centre, turn_rad)
        path.straight(max(0.0, straight_m - reached_m))
    else:
        path.straight(0.0)
    return path.segments


def _turn_towards(start: Motion, place: Point, side: int) -> tuple[tuple[float, float], float, float] | None:
    """The turn to the right (side 1) or left (-1) after which `place` is straight ahead: centre, angle, metres ahead.

    None: the place is inside that circle.
    """
    centre = _beside(start, side * TURN_RADIUS_M)
    north, east = place.north_m - centre[0], place.east_m - centre[1]
    away_m = math.hypot(north, east)
    if away_m < TURN_RADIUS_M:
        return None
    leaves = math.atan2(east, north) - side * math.acos(TURN_RADIUS_M / away_m)
    enters = start.yaw_rad - side * math.pi / 2
    turn_rad = side * (leaves - enters) % math.tau
    if math.tau - turn_rad < NEAR_M:  # straight ahead, but for rounding
        turn_rad = 0.0
    return centre, side * turn_rad, math.sqrt(away_m**2 - TURN_RADIUS_M**2)


def _ahead(start: Motion, length_m: float) -> Point:
    return Point(
        start.north_m + length_m * math.cos(start.yaw_rad),
        start.east_m + length_m * math.sin(start.yaw_rad),
        start.up_m,
    )


def _beside(start: Motion, right_m: float) -> tuple[float, float]:
    """North and east of the point so far to the right."""
    return start.north_m - right_m * math.sin(start.yaw_rad), start.east_m + right_m * math.cos(start.yaw_rad)
