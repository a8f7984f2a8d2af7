"""What the embedded vehicle's surroundings and parts are, and when its failsafes act: no flight, no clock, no MAVLink.

Parameters as in ArduPilot's simulation, as far as a vehicle of closed formulas can have them: it has a GPS, a battery
and, a copter, motors, and a plane feels wind; it has no compass. What it lacks it does not know as a parameter.
"""

from __future__ import annotations

import math
from typing import Literal

from sitl.vehicle import VehicleType

BATTERY_FULL_V, BATTERY_USED_V = 16.8, 3.6  # full, and what of that a battery loses until it is empty
BATTERY_LOW_V, BATTERY_CRITICAL_V = 10.5, 10.0  # BATT_LOW_VOLT; BATT_CRT_VOLT as an operator would set it
BATTERY_LOW_S = 10.0  # BATT_LOW_TIMER
NO_GPS_S = 5.0  # an EKF does without that long, about

SLOWEST_MS = 3.0  # over the ground, however strong the wind

GPS, VOLTS, THRUST, MOTOR = "SIM_GPS1_ENABLE", "SIM_BATT_VOLTAGE", "SIM_ENGINE_MUL", "SIM_ENGINE_FAIL"
WIND, WIND_FROM = "SIM_WIND_SPD", "SIM_WIND_DIR"

Failsafe = Literal["ekf", "battery low", "battery critical"]


class Failsafes:
    """Of one vehicle; times are its own seconds."""

    def __init__(self, vehicle_type: VehicleType) -> None:
        self.parameters = {GPS: 1.0, VOLTS: BATTERY_FULL_V}
        if vehicle_type == "copter":
            self.parameters |= {THRUST: 1.0, MOTOR: 0.0}
        if vehicle_type == "plane":
            self.parameters |= {WIND: 0.0, WIND_FROM: 180.0}
        self.acting: list[Failsafe] = []
        """That have acted, and whose cause is still there."""
        self._since_s: dict[Failsafe, float] = {}
        """When the cause of one that has not acted yet began."""

    @property
    def has_gps(self) -> bool:
        return self.parameters[GPS] != 0

    @property
    def lacks_a_motor(self) -> bool:
        return self.parameters.get(THRUST, 1.0) < 0.5

    def over_ground(self, speed_ms: float, bearing_rad: float) -> float:
        """How fast it goes in that direction, clockwise from north, which flies so fast through the air."""
        from_rad = math.radians(self.parameters.get(WIND_FROM, 0.0))
        head_ms = self.parameters.get(WIND, 0.0) * math.cos(bearing_rad - from_rad)
        return max(SLOWEST_MS, speed_ms - head_ms) if head_ms else speed_ms

    def volts(self, used: float) -> float:
        """What a battery has of which so much is used, 0 to 1."""
        return max(0.0, self.parameters[VOLTS] - BATTERY_USED_V * used)

    def look(self, now_s: float, used: float) -> Failsafe | None:
        """What acts now, if anything does; ask again until nothing does."""
        volts = self.volts(used)
        causes: dict[Failsafe, tuple[bool, float]] = {
            "ekf": (not self.has_gps, NO_GPS_S),
            "battery critical": (volts <= BATTERY_CRITICAL_V, BATTERY_LOW_S),
            "battery low": (volts <= BATTERY_LOW_V, BATTERY_LOW_S),
        }
        for failsafe, (is_there, after_s) in causes.items():
            if not is_there:
                self._since_s.pop(failsafe, None)
                if failsafe in self.acting:
                    self.acting.remove(failsafe)
            elif failsafe not in self.acting and now_s - self._since_s.setdefault(failsafe, now_s) >= after_s:
                del self._since_s[failsafe]
                self.acting.append(failsafe)
                return failsafe
        return None
