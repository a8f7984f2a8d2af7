"""Compute the motion of a plan in GUIDED mode, in which each leg ends when the pilot detects its end."""

from __future__ import annotations

import math
from collections.abc import Sequence

from sitl._kinematics import MotionInterval, MotionSegment, MotionState, PlannedMotion, end_of
from sitl._models import AT_ONCE
from sitl._route import CLIMBED, Waypoint, is_near, limit_s, to_go_m
from sitl.vehicle import VehicleType

LOOK_S = 0.25  # interval of the positions that the pilot receives
FAST = 4.0  # limit of a vehicle's speed as a multiple of the commanded one


def leg_by_leg(
    waypoints: Sequence[Waypoint], vehicle_type: VehicleType, start: MotionState
) -> tuple[list[MotionSegment], MotionSegment]:
    """Return the segments up to the last completed waypoint, and one further segment. The further segment is the motion
    of a vehicle that receives no more commands. If a waypoint takes longer than the pilot's time limit, the waypoint is
    not completed, and the pilot sends no more commands.
    """
    model, motion, goal = AT_ONCE[vehicle_type], start, None
    flown: list[MotionSegment] = []
    course, now_s = PlannedMotion(0.0, model.ascent(start, waypoints[0].place.up_m)), 0.0
    for index, waypoint in enumerate(waypoints):
        if waypoint.kind == "land":
            course, now_s = PlannedMotion(0.0, model.land(motion, motion.point)), 0.0
            made_s = course.end_s
        else:
            if waypoint.kind != "take_off" and (waypoint.place, waypoint.speed_ms) != goal:
                goal = waypoint.place, waypoint.speed_ms
                course, now_s = PlannedMotion(0.0, model.loiter(motion, *goal, math.inf)), 0.0
            made_s = _made_s(course, now_s, waypoint, vehicle_type, now_s + limit_s(waypoints, index))
        if math.isinf(made_s):
            break
        flown.append(MotionInterval(course, now_s, made_s))
        motion, now_s = end_of(flown), made_s
    return flown, MotionInterval(course, now_s, math.inf)


def _made_s(
    course: PlannedMotion, since_s: float, waypoint: Waypoint, vehicle_type: VehicleType, limit_s: float
) -> float:
    """Return the time at which the motion completes a waypoint. Return infinity if it does not complete the waypoint
    before `limit_s`.
    """
    now_s = since_s
    while now_s < limit_s:
        place = course.at(now_s).point
        if waypoint.kind == "take_off":
            if place.up_m >= CLIMBED * waypoint.place.up_m:
                return now_s
            now_s += LOOK_S
        elif is_near(place, waypoint, vehicle_type):
            return now_s + waypoint.seconds
        else:  # skip the time in which it cannot arrive
            now_s += max(LOOK_S, to_go_m(place, waypoint, vehicle_type) / (FAST * waypoint.speed_ms))
    return math.inf
