"""Compute the position of a vehicle at each mission second without flying, for radio ranges in virtual time.

The motion models are those of the embedded vehicle. The computation needs no MAVLink, no clock and no process.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from sitl._kinematics import MotionSegment, MotionState, PlannedMotion, RestSegment, end_of
from sitl._leg_by_leg import leg_by_leg
from sitl._models import AT_ONCE, MODELS, MotionModel
from sitl._route import Waypoint, landing_begins, route
from sitl.plan import By, Plan
from sitl.vehicle import VehicleType


@dataclass(frozen=True)
class VehicleTrack:
    """The computed path of one vehicle, in mission seconds and metres. The path has no end."""

    course: PlannedMotion
    home_offset: tuple[float, float, float]

    def at(self, t_s: float) -> tuple[float, float, float]:
        """Return (north_m, east_m, up_m) relative to the vehicle's home, at any mission second."""
        motion = self.course.at(t_s)
        return motion.north_m, motion.east_m, motion.up_m

    def in_field(self, t_s: float) -> tuple[float, float, float]:
        """Return (north_m, east_m, up_m) relative to the centre of the field."""
        north_m, east_m, up_m = self.at(t_s)
        return north_m + self.home_offset[0], east_m + self.home_offset[1], up_m + self.home_offset[2]


def track(
    vehicle_type: VehicleType,
    plan: Plan | None,
    home_offset: tuple[float, float, float] = (0.0, 0.0, 0.0),
    begin_s: float = 0.0,
    *,
    heading_deg: float = 0.0,
    takeoff_altitude_m: float = 20.0,
    by: By = "mission",
) -> VehicleTrack:
    """Return the path of a vehicle that begins to fly `plan` at mission second `begin_s`.

    Before `begin_s`, the vehicle stands at home. After a plan without a landing, a copter or rover stays at the last
    place, and a plane circles around it. `home_offset` is the position of home in metres north, east and up from the
    centre of the field. `heading_deg` is the heading of home. Without a plan, a copter takes off to
    `takeoff_altitude_m` and stays, a plane circles, and a rover stands. Raises PlanError if the type cannot fly the
    plan.
    """
    start = MotionState(yaw_rad=math.radians(heading_deg))
    segments: Sequence[MotionSegment]
    if plan is None:
        segments = AT_ONCE[vehicle_type].ascent(start, takeoff_altitude_m)
    else:
        fly = _mission if by == "mission" else _guided
        segments = fly(route(plan, vehicle_type, heading_deg), vehicle_type, start)
    return VehicleTrack(PlannedMotion(begin_s, segments), home_offset)


def _mission(waypoints: Sequence[Waypoint], vehicle_type: VehicleType, start: MotionState) -> Sequence[MotionSegment]:
    """Return the segments of a flight in AUTO mode. The last segment is infinite: the vehicle stays at the last
    waypoint.
    """
    model, last = MODELS[vehicle_type], waypoints[-1]
    segments: list[MotionSegment] = [RestSegment(start, 0.0)]
    for before, waypoint, after in zip((None, *waypoints), waypoints, (*waypoints[1:], None), strict=False):
        segments += _manoeuvre(model, waypoint, end_of(segments), before, after)
    if last.kind != "land":
        segments += model.loiter(end_of(segments), last.place, last.speed_ms, math.inf)
    return segments


def _guided(waypoints: Sequence[Waypoint], vehicle_type: VehicleType, start: MotionState) -> Sequence[MotionSegment]:
    """Return the segments in GUIDED mode. The landing of a plane is always a mission."""
    begins = landing_begins(waypoints, vehicle_type)
    led, staying = leg_by_leg(waypoints[:begins], vehicle_type, start)
    if begins is None or len(led) < begins:
        return led if len(led) == len(waypoints) and waypoints[-1].kind == "land" else [*led, staying]
    return [*led, *_mission(waypoints[begins:], vehicle_type, end_of(led))]


def _manoeuvre(
    model: MotionModel, waypoint: Waypoint, start: MotionState, before: Waypoint | None, after: Waypoint | None
) -> Sequence[MotionSegment]:
    """Return the segments for one waypoint. The first segment begins with the motion `start`. `before` and `after` are
    the previous and the next waypoint.
    """
    led = before.place if before is not None and before.kind in ("go_to", "loiter") else None
    match waypoint.kind:
        case "take_off":
            return model.take_off(start, waypoint.place.up_m)
        case "go_to":
            return model.go_to(start, waypoint.place, waypoint.speed_ms, led)
        case "loiter":
            next_place = None if after is None else after.place
            return model.loiter(start, waypoint.place, waypoint.speed_ms, waypoint.seconds, next_place)
        case "land":
            return model.land(start, waypoint.place, led)
