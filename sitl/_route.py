"""Convert a flight plan to a route. A route has a place, an altitude and a speed for each leg. If a plane lands, the
route also contains its approach. The pilot flies this route, and track.py computes the track from the same route.
Flight and track therefore agree.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from sitl._kinematics import LocalPlace
from sitl._models import MODELS
from sitl.plan import GoTo, Land, Loiter, Plan, TakeOff
from sitl.vehicle import VehicleType

SLOWEST = 0.25  # a vehicle below this share of the commanded speed is too slow
SLOWEST_CLIMB_MS = 0.25
GRACE_S = 120.0

CLIMBED = 0.95  # share of the commanded altitude that counts as reached, as in ArduPilot's tests
NEAR_M: dict[VehicleType, float] = {"copter": 2.0, "plane": 120.0, "rover": 5.0}
"""Distance in metres at which a place counts as reached in GUIDED mode. It is WPNAV_RADIUS for a copter, 1.5 times
WP_LOITER_RAD for a plane, and about WP_RADIUS for a rover.
"""
NEAR_UP_M = 10.0

APPROACH_SLOPE = 0.1  # altitude / distance at which a plane begins to land

Kind = Literal["take_off", "go_to", "loiter", "land"]


@dataclass(frozen=True)
class Waypoint:
    """One action of a route at `place`. `speed_ms` is the speed of the flight to this place, and `seconds` is the time
    to stay.
    """

    leg: str  # description of the leg in the plan, such as "leg 2 of 5 (...)"
    kind: Kind
    place: LocalPlace
    speed_ms: float
    seconds: float = 0.0


def route(plan: Plan, vehicle_type: VehicleType, heading_deg: float) -> tuple[Waypoint, ...]:
    """Return the waypoints of a plan for a vehicle whose home has this heading. Raises PlanError."""
    plan.check(vehicle_type)
    cruise_ms = MODELS[vehicle_type].cruise_ms
    place, speed_ms = LocalPlace(0.0, 0.0, 0.0), cruise_ms
    waypoints: list[Waypoint] = []
    for number, leg in enumerate(plan.legs, start=1):
        name = f"leg {number} of {len(plan.legs)} ({leg})"
        match leg:
            case TakeOff(altitude_m):
                place = place._replace(up_m=altitude_m)
                waypoints.append(Waypoint(name, "take_off", place, cruise_ms))
            case GoTo(north_m, east_m, altitude_m):
                place = LocalPlace(north_m, east_m, place.up_m if altitude_m is None else altitude_m)
                speed_ms = cruise_ms if leg.speed_ms is None else leg.speed_ms
                waypoints.append(Waypoint(name, "go_to", place, speed_ms))
            case Loiter(seconds):
                waypoints.append(Waypoint(name, "loiter", place, speed_ms, seconds))
            case Land():
                if vehicle_type == "plane":
                    waypoints.append(Waypoint(name, "go_to", _approach(place, heading_deg), cruise_ms))
                waypoints.append(Waypoint(name, "land", place._replace(up_m=0.0), cruise_ms))
    return tuple(waypoints)


def limit_s(waypoints: Sequence[Waypoint], index: int) -> float:
    """Return the time limit for a waypoint in simulated seconds, counted from the completion of the previous waypoint.
    The limit allows for a slow flight.
    """
    waypoint = waypoints[index]
    start = waypoints[index - 1].place if index else LocalPlace(0.0, 0.0, 0.0)
    way_s = math.dist(start[:2], waypoint.place[:2]) / (SLOWEST * waypoint.speed_ms)
    climb_s = abs(waypoint.place.up_m - start.up_m) / SLOWEST_CLIMB_MS
    return GRACE_S + way_s + climb_s + waypoint.seconds / SLOWEST


def is_near(place: LocalPlace, waypoint: Waypoint, vehicle_type: VehicleType) -> bool:
    """Return true if a vehicle in GUIDED mode has reached the waypoint."""
    level = vehicle_type == "rover" or abs(place.up_m - waypoint.place.up_m) <= NEAR_UP_M
    return level and to_go_m(place, waypoint, vehicle_type) <= 0


def to_go_m(place: LocalPlace, waypoint: Waypoint, vehicle_type: VehicleType) -> float:
    """Return the distance over the ground in metres until the vehicle has reached the waypoint. The result is negative
    if the vehicle has already reached the waypoint.
    """
    return math.dist(place[:2], waypoint.place[:2]) - NEAR_M[vehicle_type]


def landing_begins(waypoints: Sequence[Waypoint], vehicle_type: VehicleType) -> int | None:
    """Return the index of the waypoint at which a plane's landing begins. Return None if the route has no landing. A
    plane always lands by a mission, even in a flight in GUIDED mode.
    """
    return len(waypoints) - 2 if vehicle_type == "plane" and waypoints[-1].kind == "land" else None


def _approach(place: LocalPlace, heading_deg: float) -> LocalPlace:
    """Return the place at which a plane begins its approach to the landing at `place`. The plane then flies along the
    runway, in the direction of home's heading, until it reaches `place`.
    """
    before_m, heading = place.up_m / APPROACH_SLOPE, math.radians(heading_deg)
    return LocalPlace(
        place.north_m - before_m * math.cos(heading), place.east_m - before_m * math.sin(heading), place.up_m
    )
