"""Where a vehicle is at which second of the mission, without flying it: for radio ranges in virtual time.

The same motion models that move the embedded vehicle, as a pure function: no MAVLink, no clock, no process.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from sitl.kinematics import Course, Motion, Rest, Segment, end_of
from sitl.models import MODELS, MotionModel
from sitl.plan import Plan
from sitl.route import Waypoint, route
from sitl.vehicle import VehicleType


@dataclass(frozen=True)
class Track:
    """The course of one vehicle. Times are mission seconds, lengths metres; a track never ends."""

    course: Course
    home_offset: tuple[float, float, float]

    def at(self, t_s: float) -> tuple[float, float, float]:
        """(north_m, east_m, up_m) relative to the vehicle's own home, at any second of the mission."""
        motion = self.course.at(t_s)
        return motion.north_m, motion.east_m, motion.up_m

    def in_field(self, t_s: float) -> tuple[float, float, float]:
        """(north_m, east_m, up_m) relative to the field's centre: `at` plus `home_offset`."""
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
) -> Track:
    """The track of a vehicle that is ready at mission second `begin_s`, and begins to fly `plan` then.

    It stands at home until then; after the plan it stays, a plane circling, unless it has landed. `home_offset` is the
    home's place in the field (metres north, east and up from its centre), `heading_deg` the home's heading. A `plan`
    of None is that of a vehicle in no plan: a copter takes off to `takeoff_altitude_m` and stays there, a plane
    circles, a rover stands. Raises PlanError if the type cannot fly the plan.
    """
    model = MODELS[vehicle_type]
    segments: list[Segment] = [Rest(Motion(yaw_rad=math.radians(heading_deg)), 0.0)]
    if plan is None:
        segments += model.take_off(end_of(segments), takeoff_altitude_m)
        segments += model.idle(end_of(segments))
    else:
        waypoints = route(plan, vehicle_type, heading_deg)
        for waypoint, before in zip(waypoints, (None, *waypoints), strict=False):
            segments += manoeuvre(model, waypoint, end_of(segments), before)
        last = waypoints[-1]
        if last.kind != "land":
            segments += model.loiter(end_of(segments), last.place, last.speed_ms, math.inf)
    return Track(Course(begin_s, segments), home_offset)


def manoeuvre(
    model: MotionModel, waypoint: Waypoint, start: Motion, before: Waypoint | None = None
) -> Sequence[Segment]:
    """How a vehicle does what one waypoint of a route asks for, from where it is, after the waypoint `before`."""
    led = before.place if before is not None and before.kind in ("go_to", "loiter") else None
    match waypoint.kind:
        case "take_off":
            return model.take_off(start, waypoint.place.up_m)
        case "go_to":
            return model.go_to(start, waypoint.place, waypoint.speed_ms, led)
        case "loiter":
            return model.loiter(start, waypoint.place, waypoint.speed_ms, waypoint.seconds)
        case "land":
            return model.land(start, waypoint.place, led)
