"""Compute the motion of a plane in arcs and straight lines, never slower than its minimum flying speed.

The values are those of ArduPlane's SITL (plane.parm), or measurements with ArduPlane 4.7 where this is noted. Turns are
as short as possible, as in the paths of Dubins (1957). The turns of ArduPlane's L1 controller differ from these turns
by some tens of metres.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from sitl._kinematics import (
    NEAR_M,
    CircularArc,
    ClimbingSegment,
    LocalPlace,
    MotionSegment,
    MotionState,
    RestSegment,
    StraightLine,
    end_of,
)

CRUISE_MS = 22.0  # AIRSPEED_CRUISE
OVER_GROUND = 1.064  # measured: ground speed / indicated air speed without wind, above 1 because of thin air
CLIMB_MS = 5.0  # TECS_CLMB_MAX
LOITER_RADIUS_M = 96.4  # measured: at CRUISE_MS; WP_LOITER_RAD is 80 m, and the radius grows in thin air
LOITER_RADIUS_M_PER_MS = 0.95  # measured: change of the radius per metre per second
ROLL_S = 1.4  # measured: time before the plane turns towards a circle
SWING_M = 120.0  # measured: distance to the centre at which the plane turns out for its circle
JOIN_RAD = 1.1  # measured: angle to the left at which a plane inside its circle flies to the circle
REACHED_M = 40.0  # measured: 20 to 28 m, and 52 m before a turn back
TURN_RADIUS_M = 55.0  # measured
WIDE_TURN_RADIUS_M, WIDE_TURN_RAD = 110.0, 1.0  # measured: turns of small angles have a larger radius
RATHER_LEFT_M = 60.0  # measured: the plane prefers a left turn before it circles to the right
STILL_RIGHT_M = 80.0  # measured: a right turn continues unless a left turn is shorter by this
SWAY_M = 2.0  # measured: distance by which the plane crosses the line before it follows the line
LINE_AHEAD_M = 147.0  # distance along the line to the point at which a returning plane aims
HEADING_RAD = math.radians(10.0)  # maximum error of the direction to the next place when the plane leaves a circle
LOW_M = 10.0  # altitude from which the plane can land after a circle of LOITER_RADIUS_M

SPOOL_UP_S = 0.7  # measured, as the other values of the take-off
RUNWAY_ACCEL_MS2 = 8.0
RUNWAY_M = CRUISE_MS**2 / (2 * RUNWAY_ACCEL_MS2)  # distance on the runway before the plane lifts off
TAKE_OFF_CLIMB_MS, TAKE_OFF_MS = 10.0, 26.5
LEVEL_OFF_M = 30.0  # distance straight ahead before the first turn
LEVEL_M = 30.0  # altitude of the first turn in mode TAKEOFF (three times TKOFF_LVL_ALT)
AHEAD_M = 200.0  # TKOFF_DIST: distance from the start to the centre of the circle in mode TAKEOFF

LANDING_MS = 17.5  # measured, as the other values of the landing
ROLL_OUT_M, PAST_M = 60.0, 9.0  # the plane touches down before its place, and stops behind it
ROLL_OUT_ACCEL_MS2 = LANDING_MS**2 / (2 * (ROLL_OUT_M + PAST_M))


class PlaneMotion:
    """The motion of a plane. The plane flies past the places of a plan. If it must stay at a place, it flies
    circles.
    """

    cruise_ms = CRUISE_MS

    def take_off(self, start: MotionState, altitude_m: float) -> Sequence[MotionSegment]:
        run, path = _lift_off(start, altitude_m, altitude_m)
        path.straight(LEVEL_OFF_M)
        return [*run, *path.segments]

    def ascent(self, start: MotionState, altitude_m: float) -> Sequence[MotionSegment]:
        """Take off as in mode TAKEOFF: fly to the left edge of a circle that lies ahead, and then circle forever."""
        run, path = _lift_off(start, altitude_m, min(LEVEL_M, altitude_m))
        place = _point_ahead(start, AHEAD_M)._replace(up_m=altitude_m)
        path.straight_to(_on_circle(place, LOITER_RADIUS_M, start.yaw_rad - math.pi / 2))
        circle = _PlanePath(end_of(path.segments), CRUISE_MS * OVER_GROUND, altitude_m, TAKE_OFF_CLIMB_MS)
        circle.arc(place[:2], math.inf)
        return [*run, *path.segments, *circle.segments]

    def go_to(
        self, start: MotionState, place: LocalPlace, speed_ms: float, before: LocalPlace | None = None
    ) -> Sequence[MotionSegment]:
        return _back_and_on(start, place, before, speed_ms * OVER_GROUND, CLIMB_MS, REACHED_M)

    def loiter(
        self, start: MotionState, place: LocalPlace, speed_ms: float, seconds: float, after: LocalPlace | None = None
    ) -> Sequence[MotionSegment]:
        """Circle clockwise around the place for `seconds`, counted from the turn onto the circle. A plane that is
        inside the circle flies straight until it crosses the circle. A plane that is outside flies towards the place
        and passes to the left of it.
        """
        path, radius_m = _PlanePath(start, speed_ms * OVER_GROUND, place.up_m, CLIMB_MS), loiter_radius_m(speed_ms)
        if math.dist(start.point[:2], place[:2]) < radius_m:
            joins_rad = start.yaw_rad - JOIN_RAD
        else:
            if not start.yaw_rate_rads:
                path.straight(ROLL_S * path.speed_ms)
            path.fly_by(place, SWING_M, 0.0 if start.yaw_rate_rads else RATHER_LEFT_M)
            joins_rad = path.bearing_rad(place) - math.pi / 2
        path.straight_to(_on_circle(place, radius_m, joins_rad))
        swing_s = path.segments[-1].duration_s
        path.arc(place[:2], max(0.0, seconds - swing_s) * path.speed_ms / radius_m)
        if after is not None and math.isfinite(seconds):
            path.arc(place[:2], _until_heading_for(after, place, end_of(path.segments)))
        return path.segments

    def land(self, start: MotionState, place: LocalPlace, before: LocalPlace | None = None) -> Sequence[MotionSegment]:
        """Glide in a straight line to a point on the ground that lies between the plane and `place`. Then roll, and
        stop near `place`. A plane that is too high circles down first.
        """
        touchdown = _towards(place, start.point, ROLL_OUT_M)._replace(up_m=0.0)
        glide_s = _duration_s(_back_and_on(start, touchdown, before, LANDING_MS, 0.0, 0.0))
        if start.up_m > CLIMB_MS * glide_s:
            circling = self.loiter(start, place._replace(up_m=LOW_M), CRUISE_MS, (start.up_m - LOW_M) / CLIMB_MS)
            return [*circling, *self.land(end_of(circling), place)]
        sink_ms = start.up_m / glide_s if glide_s else 0.0
        glide = _back_and_on(start, touchdown, before, LANDING_MS, sink_ms, 0.0)
        ground = replace(end_of(glide), up_m=0.0)
        stand = _point_ahead(ground, ROLL_OUT_M + PAST_M)
        return [*glide, StraightLine(ground, stand, LANDING_MS, ROLL_OUT_ACCEL_MS2, from_ms=LANDING_MS)]


def _until_heading_for(there: LocalPlace, centre: LocalPlace, here: MotionState) -> float:
    """Return the angle in radians through which a plane on a circle must continue until it flies towards the place
    `there`, within ArduPlane's tolerance.

    Return 0 if the place is so near the circle that the plane never flies towards it.
    """
    away_m, radius_m = math.dist(centre[:2], there[:2]), math.dist(centre[:2], here.point[:2])
    if away_m < 1.05 * radius_m:
        return 0.0
    leaves_rad = _bearing_rad(centre, there) - math.acos(radius_m / away_m) - HEADING_RAD
    turn_rad = (leaves_rad - _bearing_rad(centre, here.point)) % math.tau
    return 0.0 if turn_rad > math.tau - 2 * HEADING_RAD else turn_rad


def loiter_radius_m(speed_ms: float) -> float:
    """Return the radius in metres of the circle that a plane flies around a place at this airspeed."""
    return LOITER_RADIUS_M + LOITER_RADIUS_M_PER_MS * (speed_ms - CRUISE_MS)


def _duration_s(segments: Sequence[MotionSegment]) -> float:
    return sum(part.duration_s for part in segments)


class _PlanePath:
    """A path under construction at one speed, with a climb or descent to one altitude."""

    def __init__(self, start: MotionState, speed_ms: float, up_m: float, rate_ms: float) -> None:
        self.segments: list[MotionSegment] = []
        self.speed_ms = speed_ms
        self._end, self._up_m, self._rate_ms = start, up_m, rate_ms

    def straight(self, length_m: float) -> None:
        self.straight_to(_point_ahead(self._end, length_m))

    def straight_to(self, place: LocalPlace) -> None:
        end = place._replace(up_m=self._end.up_m)
        self._add(StraightLine(self._end, end, self.speed_ms, RUNWAY_ACCEL_MS2, self.speed_ms, self.speed_ms))

    def arc(self, centre: tuple[float, float], turn_rad: float) -> None:
        self._add(CircularArc(self._end, centre, turn_rad, self.speed_ms))

    def fly_by(self, place: LocalPlace, reached_m: float, rather_left_m: float = 0.0) -> None:
        """Turn towards `place`, and fly straight until the distance to `place` is `reached_m`. The plane turns left or
        right, whichever path is shorter. It turns right only if the path with the right turn is shorter by more than
        `rather_left_m`.
        """
        here = self._end
        if math.dist(here.point[:2], place[:2]) <= max(reached_m, NEAR_M):
            self.straight(0.0)
            return
        turn = _turn_towards(here, place, WIDE_TURN_RADIUS_M, rather_left_m)
        if turn is None or abs(turn.turn_rad) > WIDE_TURN_RAD:
            turn = _turn_towards(here, place, TURN_RADIUS_M, rather_left_m)
        if turn is None:  # the place is inside the circles of both turns, so fly straight first
            self.straight(2 * TURN_RADIUS_M)
            self.fly_by(place, reached_m, rather_left_m)
            return
        if abs(turn.turn_rad) > NEAR_M:
            self.arc(turn.centre, turn.turn_rad)
        self.straight(max(0.0, turn.ahead_m - reached_m))

    def bearing_rad(self, place: LocalPlace) -> float:
        """Return the bearing of a place from the end of the path."""
        return _bearing_rad(self._end.point, place)

    def _add(self, level: MotionSegment) -> None:
        self.segments.append(ClimbingSegment(level, self._up_m, self._rate_ms))
        if math.isfinite(level.duration_s):
            self._end = end_of(self.segments)


def _lift_off(
    start: MotionState, altitude_m: float, straight_to_m: float
) -> tuple[Sequence[MotionSegment], _PlanePath]:
    """Return the segments on the ground before the take-off, and a path that climbs to `altitude_m`."""
    run = StraightLine(start, _point_ahead(start, RUNWAY_M), CRUISE_MS, RUNWAY_ACCEL_MS2, to_ms=CRUISE_MS)
    path = _PlanePath(end_of([run]), TAKE_OFF_MS, altitude_m, TAKE_OFF_CLIMB_MS)
    path.straight(TAKE_OFF_MS * max(0.0, straight_to_m - start.up_m) / TAKE_OFF_CLIMB_MS)
    return [RestSegment(start, SPOOL_UP_S), run], path


def _back_and_on(
    start: MotionState, place: LocalPlace, before: LocalPlace | None, speed_ms: float, rate_ms: float, reached_m: float
) -> Sequence[MotionSegment]:
    """Return to the line from `before` to `place`, and follow it until the distance to `place` is `reached_m`."""
    aim = None if before is None else _back_on_line(start.point, before, place)
    if before is None or aim is None:
        return _fly_by(start, place, speed_ms, rate_ms, reached_m)
    line_rad = _bearing_rad(before, place)
    turn_rad = (line_rad - start.yaw_rad + math.pi) % math.tau - math.pi
    sways_m = math.copysign(SWAY_M, turn_rad) if abs(turn_rad) < math.pi / 2 else 0.0
    swayed = _point_beside(MotionState(*aim, yaw_rad=line_rad), sways_m)
    back = _fly_by(start, LocalPlace(*swayed, aim.up_m), max(speed_ms, CRUISE_MS * OVER_GROUND), rate_ms, REACHED_M)
    return [*back, *_fly_by(end_of(back), place, speed_ms, rate_ms, reached_m)]


def _fly_by(
    start: MotionState, place: LocalPlace, speed_ms: float, rate_ms: float, reached_m: float
) -> Sequence[MotionSegment]:
    path = _PlanePath(start, speed_ms, place.up_m, rate_ms)
    path.fly_by(place, reached_m)
    return path.segments


class _TurnToPlace(NamedTuple):
    """A turn after which a place is straight ahead. The fields are the centre of the turn, its clockwise angle, and the
    distance from the end of the turn to the place.
    """

    centre: tuple[float, float]
    turn_rad: float
    ahead_m: float


def _turn_towards(start: MotionState, place: LocalPlace, radius_m: float, rather_left_m: float) -> _TurnToPlace | None:
    """Return the turn, left or right, that gives the shorter path to the place. Return None if the place is inside the
    circles of both turns. Two rules change the lengths before the comparison. A right turn counts as longer by
    `rather_left_m`. If the plane is turning right now, a left turn counts as longer by `STILL_RIGHT_M`.
    """
    ways = []
    for side in (1, -1):  # to the right, to the left
        centre = _point_beside(start, side * radius_m)
        north, east = place.north_m - centre[0], place.east_m - centre[1]
        away_m = math.hypot(north, east)
        if away_m < radius_m:
            continue
        leaves = math.atan2(east, north) - side * math.acos(radius_m / away_m)
        enters = start.yaw_rad - side * math.pi / 2
        turn_rad = side * (leaves - enters) % math.tau
        if math.tau - turn_rad < NEAR_M:  # the place is straight ahead, apart from rounding errors
            turn_rad = 0.0
        ways.append(_TurnToPlace(centre, side * turn_rad, math.sqrt(away_m**2 - radius_m**2)))
    lengths_m = {way: abs(way.turn_rad) * radius_m + way.ahead_m for way in ways}
    still_right_m = STILL_RIGHT_M if start.yaw_rate_rads > 0 else 0.0
    return min(
        ways,
        key=lambda way: lengths_m[way] + (rather_left_m if way.turn_rad >= 0 else still_right_m),
        default=None,
    )


def _back_on_line(here: LocalPlace, before: LocalPlace, place: LocalPlace) -> LocalPlace | None:
    """Return the point to which the plane flies to return to the line from `before` to `place`. The point is on this
    line. Return None if the plane can fly directly to `place`.
    """
    north, east = place.north_m - before.north_m, place.east_m - before.east_m
    length_m = math.hypot(north, east)
    if length_m < NEAR_M:
        return None
    along_m = ((here.north_m - before.north_m) * north + (here.east_m - before.east_m) * east) / length_m + LINE_AHEAD_M
    if along_m > length_m - LINE_AHEAD_M:
        return None
    part = along_m / length_m
    return LocalPlace(before.north_m + part * north, before.east_m + part * east, place.up_m)


def _bearing_rad(here: LocalPlace, there: LocalPlace) -> float:
    return math.atan2(there.east_m - here.east_m, there.north_m - here.north_m)


def _on_circle(place: LocalPlace, radius_m: float, bearing_rad: float) -> LocalPlace:
    """Return the point on a circle around `place` that lies in the direction `bearing_rad` from `place`."""
    north_m, east_m = radius_m * math.cos(bearing_rad), radius_m * math.sin(bearing_rad)
    return LocalPlace(place.north_m + north_m, place.east_m + east_m, place.up_m)


def _towards(place: LocalPlace, other: LocalPlace, length_m: float) -> LocalPlace:
    """Return the point that lies `length_m` from `place` in the direction of `other`. If `other` is nearer than
    `length_m`, return `other`.
    """
    away_m = max(math.dist(place[:2], other[:2]), NEAR_M)
    part = min(1.0, length_m / away_m)
    north_m, east_m = (a + part * (b - a) for a, b in zip(place[:2], other[:2], strict=True))
    return LocalPlace(north_m, east_m, place.up_m)


def _point_ahead(start: MotionState, length_m: float) -> LocalPlace:
    return LocalPlace(
        start.north_m + length_m * math.cos(start.yaw_rad),
        start.east_m + length_m * math.sin(start.yaw_rad),
        start.up_m,
    )


def _point_beside(start: MotionState, right_m: float) -> tuple[float, float]:
    """Return the position (north, east) of the point at this distance to the right of the vehicle."""
    return start.north_m - right_m * math.sin(start.yaw_rad), start.east_m + right_m * math.cos(start.yaw_rad)
