"""Simulate faults of the embedded vehicle, and decide when its failsafes act. The parameters have the same names as in
ArduPilot and its simulation. Each vehicle has a GPS, a battery, a receiver of a remote control, and a fence. Only a
copter has motors that can fail. Only a plane is affected by wind. No vehicle has a compass. A vehicle does not know the
parameters of parts that it lacks.
"""

from __future__ import annotations

import math
from typing import Literal

from sitl._kinematics import LocalPlace
from sitl.vehicle import VehicleType

BATTERY_FULL_V, BATTERY_USED_V = 16.8, 3.6  # voltage of a full battery, and its loss until the battery is empty
NO_GPS_S = 8.0  # time without GPS after which the EKF failsafe acts, measured with 4.7

SLOWEST_MS = 3.0  # minimum ground speed in any wind

GPS, VOLTS, THRUST, MOTOR = "SIM_GPS1_ENABLE", "SIM_BATT_VOLTAGE", "SIM_ENGINE_MUL", "SIM_ENGINE_FAIL"
WIND, WIND_FROM = "SIM_WIND_SPD", "SIM_WIND_DIR"

LOW_AT, CRITICAL_AT, LOW_FOR = "BATT_LOW_VOLT", "BATT_CRT_VOLT", "BATT_LOW_TIMER"
WHEN_LOW, WHEN_CRITICAL = "BATT_FS_LOW_ACT", "BATT_FS_CRT_ACT"
BATTERY = {LOW_AT: 0.0, CRITICAL_AT: 0.0, LOW_FOR: 10.0, WHEN_LOW: 0.0, WHEN_CRITICAL: 0.0}
"""ArduPilot's default parameters for the battery failsafes. With the defaults, only a copter detects a low battery, and
then only reports it.
"""
COPTER_LOW_V = 10.5

ACTIONS: dict[VehicleType, dict[float, str]] = {
    "copter": {1: "LAND", 2: "RTL", 3: "RTL", 4: "LAND"},
    "plane": {1: "RTL", 2: "RTL"},
    "rover": {1: "RTL", 2: "HOLD", 3: "RTL", 4: "HOLD"},
}
"""Value of a parameter BATT_FS_..._ACT -> mode that the vehicle enters. A value that is not listed selects no mode. In
ArduPilot, some of the listed values select another route home. The embedded vehicle has no other route.
"""

RC_FAIL, RC_SILENT_S = "SIM_RC_FAIL", 1.0
STATION = "MAV_GCS_SYSID"
STATION_SILENT = "FS_GCS_TIMEOUT"
WHEN_SILENT: dict[VehicleType, str] = {"copter": "FS_GCS_ENABLE", "plane": "FS_GCS_ENABL", "rover": "FS_GCS_ENABLE"}
WHEN_NO_RC: dict[VehicleType, str] = {"copter": "FS_THR_ENABLE", "plane": "THR_FAILSAFE", "rover": "FS_THR_ENABLE"}
LINKS: dict[VehicleType, dict[str, float]] = {
    "copter": {STATION_SILENT: 5.0, "FS_GCS_ENABLE": 0.0, "FS_THR_ENABLE": 1.0},
    "plane": {STATION_SILENT: 5.0, "FS_GCS_ENABL": 0.0, "THR_FAILSAFE": 1.0, "FS_LONG_ACTN": 0.0},
    "rover": {STATION_SILENT: 5.0, "FS_GCS_ENABLE": 0.0, "FS_THR_ENABLE": 1.0, "FS_ACTION": 2.0},
}
"""Parameters of the failsafes for a silent ground station and a silent remote control, with ArduPilot's default values.
In ArduPlane, the timeout has the name FS_LONG_TIMEOUT.
"""
LINK_ACTION: dict[VehicleType, str] = {"plane": "FS_LONG_ACTN", "rover": "FS_ACTION"}
"""Parameter that selects the action of both failsafes in `LINKS`. A copter has no such parameter, because the
parameters that enable its failsafes also select the action.
"""
STATION_ACTIONS = {1.0: "RTL", 2.0: "RTL", 3.0: "RTL", 4.0: "LAND", 5.0: "LAND", 6.0: "RTL", 7.0: "LAND"}
RC_ACTIONS = {1.0: "RTL", 2.0: "RTL", 3.0: "LAND", 4.0: "RTL", 5.0: "LAND", 6.0: "RTL", 7.0: "LAND"}

FENCE, FENCE_TYPE, FENCE_ACTION = "FENCE_ENABLE", "FENCE_TYPE", "FENCE_ACTION"
FENCE_TOP, FENCE_RADIUS = "FENCE_ALT_MAX", "FENCE_RADIUS"
TOP, CIRCLE = 1, 2  # bits of FENCE_TYPE
FENCE_ACTIONS: dict[VehicleType, dict[float, str]] = {
    "copter": {1: "RTL", 2: "LAND", 3: "RTL", 4: "LAND", 5: "RTL"},
    "plane": {1: "RTL", 6: "RTL", 7: "RTL"},
    "rover": {1: "RTL", 2: "HOLD", 3: "RTL", 4: "HOLD"},
}

Failsafe = Literal["ekf", "battery low", "battery critical", "station", "radio", "fence"]


class Failsafes:
    """The failsafes of one vehicle. Times are seconds on the vehicle's own clock."""

    def __init__(self, vehicle_type: VehicleType) -> None:
        self.parameters = {GPS: 1.0, VOLTS: BATTERY_FULL_V, **BATTERY, RC_FAIL: 0.0, STATION: 255.0}
        self.parameters |= {**LINKS[vehicle_type], FENCE: 0.0, FENCE_TYPE: 2.0, FENCE_ACTION: 1.0, FENCE_RADIUS: 300.0}
        self._vehicle_type: VehicleType = vehicle_type
        self._actions = ACTIONS[vehicle_type]
        self._needs_gps = vehicle_type != "plane"  # a plane estimates its position from its airspeed
        if vehicle_type == "copter":
            self.parameters |= {THRUST: 1.0, MOTOR: 0.0, LOW_AT: COPTER_LOW_V}
        if vehicle_type != "rover":
            self.parameters |= {FENCE_TYPE: 3.0, FENCE_TOP: 100.0}
        if vehicle_type == "plane":
            self.parameters |= {WIND: 0.0, WIND_FROM: 180.0}
        self.acting: list[Failsafe] = []
        """Failsafes that have acted, and whose cause still exists. A failsafe in this list does not act again."""
        self._since_s: dict[Failsafe, float] = {}
        """Failsafe -> the time at which its cause began. Only failsafes that have not acted yet are included."""

    @property
    def has_gps(self) -> bool:
        return self.parameters[GPS] != 0

    @property
    def lacks_a_motor(self) -> bool:
        return self.parameters.get(THRUST, 1.0) < 0.5

    def over_ground(self, speed_ms: float, bearing_rad: float) -> float:
        """Return the ground speed in the current wind. `speed_ms` is the air speed. `bearing_rad` is the direction of
        the flight, clockwise from north.
        """
        from_rad = math.radians(self.parameters.get(WIND_FROM, 0.0))
        head_ms = self.parameters.get(WIND, 0.0) * math.cos(bearing_rad - from_rad)
        return max(SLOWEST_MS, speed_ms - head_ms) if head_ms else speed_ms

    def volts(self, used: float) -> float:
        """Return the battery voltage after the share `used` (0 to 1) of the charge was used."""
        return max(0.0, self.parameters[VOLTS] - BATTERY_USED_V * used)

    def action(self, failsafe: Failsafe) -> str | None:
        """Return the flight mode that the vehicle enters when this failsafe acts. Return None if the vehicle stays in
        its mode. The failsafe must not be "ekf".
        """
        kind = self._vehicle_type
        if failsafe == "fence":
            return FENCE_ACTIONS[kind].get(self.parameters[FENCE_ACTION])
        if failsafe in ("station", "radio"):
            enabled = (WHEN_SILENT if failsafe == "station" else WHEN_NO_RC)[kind]
            if kind != "copter":
                return self._actions.get(self.parameters[LINK_ACTION[kind]])
            return (STATION_ACTIONS if failsafe == "station" else RC_ACTIONS).get(self.parameters[enabled])
        return self._actions.get(self.parameters[WHEN_LOW if failsafe == "battery low" else WHEN_CRITICAL])

    def breaches_fence(self, place: LocalPlace) -> bool:
        """Return true if a place, in metres from home, is outside the fence."""
        kind = int(self.parameters[FENCE_TYPE])
        too_high = bool(kind & TOP) and place.up_m >= self.parameters.get(FENCE_TOP, math.inf)
        too_far = bool(kind & CIRCLE) and math.hypot(place.north_m, place.east_m) >= self.parameters[FENCE_RADIUS]
        return self.parameters[FENCE] != 0 and (too_high or too_far)

    def _is_on(self, parameter: dict[VehicleType, str]) -> bool:
        return self.parameters[parameter[self._vehicle_type]] != 0

    def _misses_station(self, now_s: float, heard_s: float | None) -> bool:
        silent = heard_s is not None and now_s - heard_s >= self.parameters[STATION_SILENT]
        return silent and self._is_on(WHEN_SILENT)

    def look(self, now_s: float, used: float, place: LocalPlace, station_heard_s: float | None) -> Failsafe | None:
        """Return the next failsafe that acts now. Return None if none acts. The caller repeats the call until the
        result is None.

        `place` is in metres from home. `station_heard_s` is the time of the last heartbeat of the ground station. If it
        is None, no heartbeat was ever received, and the failsafe of the ground station does not act.
        """
        volts = self.volts(used)
        low_for_s = self.parameters[LOW_FOR]
        causes: dict[Failsafe, tuple[bool, float]] = {
            "ekf": (self._needs_gps and not self.has_gps, NO_GPS_S),
            "battery critical": (volts <= self.parameters[CRITICAL_AT], low_for_s),
            "battery low": (volts <= self.parameters[LOW_AT], low_for_s),
            "station": (self._misses_station(now_s, station_heard_s), 0.0),
            "radio": (self._is_on(WHEN_NO_RC) and self.parameters[RC_FAIL] != 0, RC_SILENT_S),
            "fence": (self.breaches_fence(place), 0.0),
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
