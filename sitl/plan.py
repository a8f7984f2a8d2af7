"""Represent a flight plan: the legs of a flight, in metres from the home position of the vehicle.

A plan is a value without MAVLink. `Plan.check` checks that a type of vehicle can fly it. Vehicles with the same plan
keep the formation of their homes. sitl/_route.py adds missing values, such as altitudes, speeds and the approach of a
plane.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from sitl.vehicle import VehicleError, VehicleType

By = Literal["mission", "guided"]
"""`mission`: the vehicle flies the uploaded plan in AUTO mode. `guided`: the pilot commands each leg in GUIDED mode."""

MAX_LEGS = 100
MAX_DISTANCE_M = 100_000.0  # up to this distance, a flat earth is accurate enough
MAX_ALTITUDE_M = 5_000.0
MAX_LOITER_S = 65_535.0  # ArduPilot stores the seconds of a NAV_LOITER_TIME in 16 bits

SPEED_LIMITS_MS: dict[VehicleType, tuple[float, float]] = {
    "copter": (0.5, 20.0),  # WPNAV_SPEED goes to 2000 cm/s
    "plane": (10.0, 30.0),  # AIRSPEED_MIN and AIRSPEED_MAX of plane.parm
    "rover": (0.5, 20.0),
}


class PlanError(VehicleError):
    """An error: the vehicle cannot fly the plan."""


@dataclass(frozen=True)
class TakeOff:
    """Climb to `altitude_m` above home: a copter straight up, a plane along the heading of its home."""

    altitude_m: float

    def __str__(self) -> str:
        return f"take off to {self.altitude_m:g} m"


@dataclass(frozen=True)
class GoTo:
    """Go to a place in metres north and east of home.

    `altitude_m` is above home. With None, the altitude does not change. `speed_ms` is in metres per second. With None,
    it is the usual speed of the type of vehicle.
    """

    north_m: float
    east_m: float
    altitude_m: float | None = None
    speed_ms: float | None = None

    def __str__(self) -> str:
        return f"go to {self.north_m:g} m north, {self.east_m:g} m east"


@dataclass(frozen=True)
class Loiter:
    """Stay at the place of the previous leg for `seconds` of simulated time. A plane flies circles around the place."""

    seconds: float

    def __str__(self) -> str:
        return f"loiter for {self.seconds:g} s"


@dataclass(frozen=True)
class Land:
    """Land at the place of the previous leg: a copter straight down, a plane along the heading of its home."""

    def __str__(self) -> str:
        return "land"


Leg = TakeOff | GoTo | Loiter | Land


@dataclass(frozen=True)
class Plan:
    """A flight plan with 1 to MAX_LEGS legs, in order."""

    legs: tuple[Leg, ...]

    def check(self, vehicle_type: VehicleType) -> None:
        """Raise PlanError if this type of vehicle cannot fly the plan. The message names the leg (from 1)."""
        if not 1 <= len(self.legs) <= MAX_LEGS:
            raise PlanError(f"a plan has 1 to {MAX_LEGS} legs, this one has {len(self.legs)}")
        flies = vehicle_type != "rover"
        if flies and not isinstance(self.legs[0], TakeOff):
            raise PlanError(f"the plan of a {vehicle_type} begins with take_off, this one with {self.legs[0]}")
        for number, leg in enumerate(self.legs, start=1):
            if problem := _problem(leg, number == 1, number == len(self.legs), vehicle_type):
                raise PlanError(f"leg {number} ({leg}): {problem}")


def _problem(leg: Leg, first: bool, last: bool, vehicle_type: VehicleType) -> str | None:
    """Return a sentence about the error in a leg of the flight plan. Return None if the leg has no error."""
    if vehicle_type == "rover" and isinstance(leg, TakeOff | Land):
        return "a rover neither takes off nor lands"
    match leg:
        case TakeOff(altitude_m):
            return "a plan takes off once, at its beginning" if not first else _bad_altitude(altitude_m)
        case GoTo(north_m, east_m, altitude_m, speed_ms):
            if not math.hypot(north_m, east_m) <= MAX_DISTANCE_M:
                return f"it is farther than {MAX_DISTANCE_M / 1e3:g} km from home"
            if altitude_m is not None and vehicle_type == "rover":
                return "a rover has no altitude"
            low, high = SPEED_LIMITS_MS[vehicle_type]
            if speed_ms is not None and not low <= speed_ms <= high:
                return f"a {vehicle_type} goes {low:g} to {high:g} m/s"
            return None if altitude_m is None else _bad_altitude(altitude_m)
        case Loiter(seconds) if not 0 < seconds <= MAX_LOITER_S:
            return f"a loiter takes more than 0 s and at most {MAX_LOITER_S:g} s"
        case Land() if not last:
            return "nothing comes after a landing"
    return None


def _bad_altitude(altitude_m: float) -> str | None:
    if 0 < altitude_m <= MAX_ALTITUDE_M:
        return None
    return f"an altitude is more than 0 m and at most {MAX_ALTITUDE_M:g} m above home"
