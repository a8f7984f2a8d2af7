"""The environment and the parts of the embedded vehicle, and the conditions of its failsafes.

Parameters have the names of ArduPilot and its simulation. The vehicle has a GPS, a battery and, if it is a copter,
motors. A plane is affected by wind. There is no compass. Parameters of missing parts are unknown to the vehicle.
"""

from __future__ import annotations

import math
from typing import Literal

from sitl.vehicle import VehicleType

BATTERY_FULL_V, BATTERY_USED_V = 16.8, 3.6  # full, and what of that a battery loses until it is empty
NO_GPS_S = 8.0  # an EKF does without that long, as measured with 4.7

SLOWEST_MS = 3.0  # over the ground, however strong the wind

GPS, VOLTS, THRUST, MOTOR = "SIM_GPS1_ENABLE", "SIM_BATT_VOLTAGE", "SIM_ENGINE_MUL", "SIM_ENGINE_FAIL"
WIND, WIND_FROM = "SIM_WIND_SPD", "SIM_WIND_DIR"

LOW_AT, CRITICAL_AT, LOW_FOR = "BATT_LOW_VOLT", "BATT_CRT_VOLT", "BATT_LOW_TIMER"
WHEN_LOW, WHEN_CRITICAL = "BATT_FS_LOW_ACT", "BATT_FS_CRT_ACT"
BATTERY = {LOW_AT: 0.0, CRITICAL_AT: 0.0, LOW_FOR: 10.0, WHEN_LOW: 0.0, WHEN_CRITICAL: 0.0}
"""ArduPilot's defaults: the battery is never low. A copter's battery can be low, but that has no effect."""
COPTER_LOW_V = 10.5

ACTIONS: dict[VehicleType, dict[float, str]] = {
    "copter": {1: "LAND", 2: "RTL", 3: "RTL", 4: "LAND"},
    "plane": {1: "RTL", 2: "RTL"},
    "rover": {1: "RTL", 2: "HOLD", 3: "RTL", 4: "HOLD"},
}
"""The modes that BATT_FS_..._ACT selects if no better way home is known. Other values select none."""

Failsafe = Literal["ekf", "battery low", "battery critical"]


class Failsafes:
    """The failsafes of one vehicle. Times are its own seconds."""

    def __init__(self, vehicle_type: VehicleType) -> None:
        self.parameters = {GPS: 1.0, VOLTS: BATTERY_FULL_V, **BATTERY}
        self._actions = ACTIONS[vehicle_type]
        self._needs_gps = vehicle_type != "plane"  # which knows its airspeed, and reckons from that where it is
        if vehicle_type == "copter":
            self.parameters |= {THRUST: 1.0, MOTOR: 0.0, LOW_AT: COPTER_LOW_V}
        if vehicle_type == "plane":
            self.parameters |= {WIND: 0.0, WIND_FROM: 180.0}
        self.acting: list[Failsafe] = []
        """Failsafes that have acted, and whose cause still exists."""
        self._since_s: dict[Failsafe, float] = {}
        """The time at which the cause of a pending failsafe began."""

    @property
    def has_gps(self) -> bool:
        return self.parameters[GPS] != 0

    @property
    def lacks_a_motor(self) -> bool:
        return self.parameters.get(THRUST, 1.0) < 0.5

    def over_ground(self, speed_ms: float, bearing_rad: float) -> float:
        """Return the ground speed for an air speed and a bearing, clockwise from north."""
        from_rad = math.radians(self.parameters.get(WIND_FROM, 0.0))
        head_ms = self.parameters.get(WIND, 0.0) * math.cos(bearing_rad - from_rad)
        return max(SLOWEST_MS, speed_ms - head_ms) if head_ms else speed_ms

    def volts(self, used: float) -> float:
        """Return the voltage of the battery after use of this share of it, 0 to 1."""
        return max(0.0, self.parameters[VOLTS] - BATTERY_USED_V * used)

    def action(self, failsafe: Failsafe) -> str | None:
        """Return the mode that a battery failsafe selects, or None."""
        return self._actions.get(self.parameters[WHEN_LOW if failsafe == "battery low" else WHEN_CRITICAL])

    def look(self, now_s: float, used: float) -> Failsafe | None:
        """Return the next failsafe that acts now, or None. The caller repeats the call until it returns None."""
        volts = self.volts(used)
        low_for_s = self.parameters[LOW_FOR]
        causes: dict[Failsafe, tuple[bool, float]] = {
            "ekf": (self._needs_gps and not self.has_gps, NO_GPS_S),
            "battery critical": (volts <= self.parameters[CRITICAL_AT], low_for_s),
            "battery low": (volts <= self.parameters[LOW_AT], low_for_s),
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
