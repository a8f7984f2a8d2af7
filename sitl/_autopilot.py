"""Simulate the autopilot of the embedded vehicle: modes, arming, flight and missions, without sockets, clocks or
parsers.

`Autopilot` is the vehicle. A client exchanges bytes with it through a `ClientChannel` (serial_channel.py). The module
streams.py defines the messages that the vehicle sends at intervals. Times are simulated seconds since boot.

The autopilot answers its clients as ArduPilot does. For example, it refuses to arm until its position is known. If a
client sets a mode in the first seconds after boot, the autopilot acknowledges the mode and then leaves it again. A
copter begins a mission on command. A plane and a rover begin a mission as soon as they are armed in AUTO mode. The
position of the vehicle follows from formulas, not from simulated time steps. A new movement begins exactly when the
previous movement ends, regardless of the step size of `advance`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from pymavlink.dialects.v20 import common as mavlink

from sitl._failsafes import STATION, WIND, WIND_FROM, Failsafe, Failsafes
from sitl._kinematics import FallSegment, LocalPlace, MotionSegment, MotionState, PlannedMotion, RestSegment, end_of
from sitl._models import AT_ONCE, MODELS, MotionModel
from sitl.modes import BOOT_MODES, MODES
from sitl.vehicle import READY_S, Home, VehicleType

MODE_SWITCH_READ_S = 3.0  # ArduPilot then reads its mode switch, and undoes a mode that was set before

BATTERY_FULL_MAH = 10_000.0
CURRENT_ARMED_A, CURRENT_IDLE_A = 10.0, 0.3

MAX_ALTITUDE_M = 10_000.0
MAX_SPEED_MS = 100.0
RTL_ALTITUDE_M: dict[VehicleType, float] = {"copter": 15.0, "plane": 100.0, "rover": 0.0}  # RTL_ALT, RTL_ALTITUDE
TKOFF_ALT_M = 50.0  # ArduPlane's parameter TKOFF_ALT, the altitude of mode TAKEOFF

ACCEPTED, FAILED = int(mavlink.MAV_RESULT_ACCEPTED), int(mavlink.MAV_RESULT_FAILED)


class MessageListener(Protocol):
    """An object that receives each message that the vehicle sends without a request, such as a text message."""

    def send(self, message: Any) -> None: ...


class Autopilot:
    """The autopilot of one vehicle. `epoch_us` is the time at which the vehicle boots, in microseconds since the Unix
    epoch.
    """

    takes_missions = True

    def __init__(self, sysid: int, home: Home, epoch_us: int, vehicle_type: VehicleType = "copter") -> None:
        self.sysid = sysid
        self.home = home
        self.epoch_us = epoch_us
        self.vehicle_type: VehicleType = vehicle_type
        self.mode = BOOT_MODES[vehicle_type]
        self.armed = False
        self.airborne = False
        self.now_s = 0.0
        self.used_mah = 0.0
        self.take_off_altitude_m = TKOFF_ALT_M
        self.listeners: list[MessageListener] = []
        self.mission: Sequence[Any] = ()  # MISSION_ITEM_INTs; the first is home, as in ArduPilot
        self.current_item = 0
        self.failsafes = Failsafes(vehicle_type)
        self.station_heard_s: float | None = None  # the last heartbeat of the ground station
        self._speed_ms = self._model.cruise_ms
        self._in_mission = False
        self._then: Callable[[], None] = self._stand
        self._goal: tuple[LocalPlace, float] | None = None  # in GUIDED: target and speed
        self._course = PlannedMotion(0.0, [RestSegment(MotionState(yaw_rad=math.radians(home.heading_deg)))])

    @property
    def _model(self) -> MotionModel:
        return (MODELS if self.mode == "AUTO" else AT_ONCE)[self.vehicle_type]

    @property
    def has_booted(self) -> bool:
        return self.now_s >= READY_S

    @property
    def ready(self) -> bool:
        """True if the vehicle knows its position. A vehicle without a known position cannot be armed."""
        return self.has_booted and self.failsafes.has_gps

    @property
    def battery_used(self) -> float:
        """The share of the battery charge that was used, from 0 to 1."""
        return self.used_mah / BATTERY_FULL_MAH

    @property
    def volts(self) -> float:
        return self.failsafes.volts(self.battery_used)

    @property
    def motion(self) -> MotionState:
        return self._course.at(self.now_s)

    def advance(self, now_s: float) -> None:
        """Advance the time to `now_s`."""
        before_s, until_s = self.now_s, max(self.now_s, now_s)
        current_a = CURRENT_ARMED_A if self.armed else CURRENT_IDLE_A
        self.used_mah = min(BATTERY_FULL_MAH, self.used_mah + current_a * (until_s - before_s) / 3.6)
        if before_s < MODE_SWITCH_READ_S <= until_s:
            self.mode = BOOT_MODES[self.vehicle_type]
        if before_s < READY_S <= until_s:
            self.say(mavlink.MAV_SEVERITY_INFO, "Position known, ready to arm")
        while self._course.end_s <= until_s:
            self.now_s = self._course.end_s
            self._then()
        self.now_s = until_s
        while self.has_booted and (failsafe := self._failsafe()):
            self._react_to_failsafe(failsafe)
        if self.failsafes.lacks_a_motor and self.armed and self.airborne:
            self._lose_thrust()

    def say(self, severity: int, text: str) -> None:
        """Send a text message (STATUSTEXT) to all clients."""
        self._tell(mavlink.MAVLink_statustext_message(severity, text.encode()))

    def _tell(self, message: Any) -> None:
        for listener in self.listeners:
            listener.send(message)

    # Commands: each returns a MAV_RESULT, and sends the reason of a refusal

    def arm(self) -> int:
        if self.armed:
            return ACCEPTED
        if not self.ready:
            return self._refuse("PreArm: Need Position Estimate")
        if self.airborne:
            return self._refuse("Arm: falling")
        if self.vehicle_type == "copter" and self.mode in ("AUTO", "RTL", "LAND"):
            return self._refuse(f"Arm: {self.mode} mode not armable")
        self.armed = True
        self.say(mavlink.MAV_SEVERITY_INFO, "Arming motors")
        if self.mode in ("AUTO", "TAKEOFF"):
            self._act()
        return ACCEPTED

    def disarm(self, force: bool = False) -> int:
        """Disarm the vehicle. Return the result code of the MAVLink command. If `force` is true, the vehicle also
        disarms in flight, and then falls. A client requests this with MAV_CMD_COMPONENT_ARM_DISARM and param2 = 21196.
        """
        if self.airborne and self.armed and not force:
            return self._refuse("Disarm refused: in flight")
        if self.armed:
            self._disarm()
            if self.airborne:
                fall = FallSegment(self.motion)
                self._begin([fall], lambda: self._hit_ground(fall.impact_ms))
            else:
                self._stand()
        return ACCEPTED

    def take_off(self, altitude_m: float) -> int:
        """Execute MAV_CMD_NAV_TAKEOFF of a copter, and return the result code."""
        if self.vehicle_type != "copter":
            return self._refuse(f"Take-off refused: a {self.vehicle_type} does not take off in GUIDED")
        if not self.armed:
            return self._refuse("Take-off refused: not armed")
        if self.mode != "GUIDED":
            return self._refuse(f"Take-off refused: mode is {self.mode}, not GUIDED")
        if self.airborne:
            return self._refuse("Take-off refused: already flying")
        if not 0 < altitude_m <= MAX_ALTITUDE_M:
            return self._refuse("Take-off refused: no such altitude")
        self._ascend(altitude_m)
        return ACCEPTED

    def set_mode(self, number: float) -> int:
        mode = next((name for name, known in MODES[self.vehicle_type].items() if known == number), None)
        if mode is None:
            return self._refuse("Mode change refused: no such mode")
        if mode == BOOT_MODES[self.vehicle_type] and self.airborne:
            return self._refuse("Mode change refused: no remote control")
        if mode == "AUTO" and len(self.mission) < 2:
            return self._refuse("Mode change to AUTO failed: no mission")
        if mode == self.mode:
            return ACCEPTED
        self.mode = mode
        self._speed_ms = self._model.cruise_ms
        if self.armed:
            self._act()
        return ACCEPTED

    def start_mission(self) -> int:
        """Execute MAV_CMD_MISSION_START, and return the result code."""
        if not self.armed or len(self.mission) < 2:
            return self._refuse("Mission start refused: not armed, or no mission")
        if self.mode != "AUTO":
            self.set_mode(MODES[self.vehicle_type]["AUTO"])
        if not self._in_mission:
            self._begin_item(max(1, self.current_item))
        return ACCEPTED

    def set_speed(self, speed_ms: float) -> int:
        """Execute MAV_CMD_DO_CHANGE_SPEED, and return the result code. The next movement has the new speed."""
        if not 0 < speed_ms <= MAX_SPEED_MS:
            return FAILED
        self._speed_ms = speed_ms
        return ACCEPTED

    def go_to(self, place: LocalPlace) -> int:
        """Go to a place and stay there, in GUIDED mode. Return the result code."""
        if self.mode != "GUIDED" or not self.armed or not (self.airborne or self.vehicle_type == "rover"):
            return FAILED
        if not all(map(math.isfinite, place)) or abs(place.up_m) > MAX_ALTITUDE_M:
            return FAILED
        if (goal := (place, self._speed_ms)) != self._goal:  # a repeated command changes nothing
            self._begin(self._model.loiter(self.motion, place, self._speed_ms, math.inf), self._stand)
            self._goal = goal
        return ACCEPTED

    def load(self, mission: Sequence[Any]) -> None:
        """Replace the mission. If a mission is in progress, the vehicle continues with the item that has the number of
        the current item in the new mission.
        """
        self.mission = mission
        if not self._in_mission:
            self.current_item = 0

    def _refuse(self, text: str) -> int:
        self.say(mavlink.MAV_SEVERITY_CRITICAL, text)
        return FAILED

    # Faults and failsafes

    def simulate(self, name: str, value: float) -> None:
        """Set a parameter of the simulation. A change of wind also affects the current movement."""
        self.failsafes.parameters[name] = value
        if name in (WIND, WIND_FROM) and self._in_mission and self.current_item < len(self.mission):
            item = self.mission[self.current_item]
            if item.command == mavlink.MAV_CMD_NAV_WAYPOINT:
                self._go_on_to(self.place(item.frame, item.x, item.y, item.z), self.current_item)

    def hear(self, system: int) -> None:
        """Process a heartbeat. `system` is the MAVLink system ID of its sender."""
        if system == self.failsafes.parameters[STATION]:
            self.station_heard_s = self.now_s

    def _failsafe(self) -> Failsafe | None:
        return self.failsafes.look(self.now_s, self.battery_used, self.motion.point, self.station_heard_s)

    def _react_to_failsafe(self, failsafe: Failsafe) -> None:
        """React to a failsafe as ArduPilot does. For example, if the position is lost, a copter lands and a rover
        stops.
        """
        can_land = self.vehicle_type == "copter"
        if failsafe == "ekf":
            self.say(mavlink.MAV_SEVERITY_CRITICAL, "EKF variance")
            if self.armed:
                mode = "LAND" if can_land else "HOLD"
                self.say(mavlink.MAV_SEVERITY_CRITICAL, f"EKF Failsafe: changed to {mode} Mode")
                self._switch_to(mode)
            return
        if failsafe.startswith("battery"):
            level = failsafe.removeprefix("battery ")
            used = f"{self.volts:.2f}V used {self.used_mah:.0f} mAh"
            self.say(mavlink.MAV_SEVERITY_WARNING, f"Battery 1 is {level} {used}")
        self.say(mavlink.MAV_SEVERITY_WARNING, SAID[failsafe])
        action = self.failsafes.action(failsafe)
        if self.armed and action and self.mode != "LAND":
            self._switch_to("LAND" if can_land and not self.ready else action)

    def _switch_to(self, mode: str) -> None:
        if mode != self.mode:
            self.set_mode(MODES[self.vehicle_type][mode])

    def _lose_thrust(self) -> None:
        """Let the vehicle fall. One of its four motors has failed, and with three motors it cannot stay level."""
        self.say(mavlink.MAV_SEVERITY_EMERGENCY, "Potential Thrust Loss (2)")
        self.say(mavlink.MAV_SEVERITY_EMERGENCY, "Crash: Disarming")
        self.disarm(force=True)

    # Movements

    def _begin(self, segments: Sequence[MotionSegment], then: Callable[[], None]) -> None:
        """Begin a movement. At its end, the autopilot calls `then`."""
        self._course, self._then, self._goal = PlannedMotion(self.now_s, segments), then, None

    def _act(self) -> None:
        """Begin the movement that the current flight mode requires. The vehicle must be armed."""
        self._in_mission = False
        match self.mode:
            case "AUTO" if self.airborne or self.vehicle_type != "copter":
                self._begin_item(max(1, self.current_item))
            case "TAKEOFF" if not self.airborne:
                self._ascend(self.take_off_altitude_m)
            case "RTL":
                self._return_home(self._stay)
            case "LAND" if self.airborne:
                self._land(self.motion.point)
            case _:
                self._stay()

    def _ascend(self, altitude_m: float) -> None:
        self.airborne = True
        self._begin(self._model.ascent(self.motion, altitude_m), self._stand)

    def _stay(self) -> None:
        if self.airborne:
            self._begin(self._model.loiter(self.motion, self.motion.point, self._speed_ms, math.inf), self._stand)
        else:
            self._stand()

    def _stand(self) -> None:
        self._begin([RestSegment(self.motion)], self._stand)

    def _land(self, place: LocalPlace, before: LocalPlace | None = None) -> None:
        self._begin(self._model.land(self.motion, place, before), self._landed)

    def _landed(self) -> None:
        self.airborne = False
        self._disarm()
        self._stand()

    def _hit_ground(self, impact_ms: float) -> None:
        self.airborne = False
        self.say(mavlink.MAV_SEVERITY_INFO, f"SIM Hit ground at {impact_ms:f} m/s")
        self._stand()

    def _disarm(self) -> None:
        self.armed = self._in_mission = False
        self.current_item = 0
        self.say(mavlink.MAV_SEVERITY_INFO, "Disarming motors")

    def _return_home(self, then: Callable[[], None]) -> None:
        """Return home at the altitude of RTL. A copter then lands."""
        if not self.airborne and self.vehicle_type != "rover":
            self._stand()
            return
        altitude_m = max(self.motion.up_m, RTL_ALTITUDE_M[self.vehicle_type])
        home = LocalPlace(0.0, 0.0, altitude_m if self.airborne else self.motion.up_m)
        if self.vehicle_type == "copter":
            up = self._model.take_off(self.motion, altitude_m)
            self._begin([*up, *self._model.go_to(end_of(up), home, self._speed_ms)], lambda: self._land(home))
        else:
            self._begin(self._model.go_to(self.motion, home, self._speed_ms), then)

    # The mission

    def _begin_item(self, number: int) -> None:
        """Continue the mission with this item. Items without a duration are executed immediately."""
        self._in_mission = True
        while number < len(self.mission) and self.mission[number].command == mavlink.MAV_CMD_DO_CHANGE_SPEED:
            self.set_speed(self.mission[number].param2)
            number += 1
        if number >= len(self.mission):
            self._end_mission()
            return
        item, self.current_item = self.mission[number], number
        grounded = self.vehicle_type != "rover" and not self.airborne
        if grounded and item.command != mavlink.MAV_CMD_NAV_TAKEOFF:
            self._in_mission = False
            self.say(mavlink.MAV_SEVERITY_CRITICAL, "Auto: Missing Takeoff Cmd")
            return
        self.say(mavlink.MAV_SEVERITY_INFO, f"Mission: {number} {ITEM_NAMES[item.command]}")
        place = self.place(item.frame, item.x, item.y, item.z)
        match item.command:
            case mavlink.MAV_CMD_NAV_TAKEOFF:
                self.airborne = True
                self._begin(self._model.take_off(self.motion, item.z), self._item_reached)
            case mavlink.MAV_CMD_NAV_WAYPOINT:
                self._go_on_to(place, number)
            case mavlink.MAV_CMD_NAV_LOITER_TIME:
                after = self._place_after(number)
                circling = self._model.loiter(self.motion, place, self._speed_ms, item.param1, after)
                self._begin(circling, self._item_reached)
            case mavlink.MAV_CMD_NAV_LOITER_UNLIM:
                self._begin(self._model.loiter(self.motion, place, self._speed_ms, math.inf), self._item_reached)
            case mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH:
                self._return_home(self._stay)
            case mavlink.MAV_CMD_NAV_LAND:
                self._land(place, self._place_before(number))

    def _go_on_to(self, place: LocalPlace, number: int) -> None:
        """Fly from the current position to a place. The current wind changes the ground speed."""
        here = self.motion.point
        bearing_rad = math.atan2(place.east_m - here.east_m, place.north_m - here.north_m)
        speed_ms = self.failsafes.over_ground(self._speed_ms, bearing_rad)
        self._begin(self._model.go_to(self.motion, place, speed_ms, self._place_before(number)), self._item_reached)

    def _place_before(self, number: int) -> LocalPlace | None:
        """Return the place of the previous mission item. Skip items that change the speed. Return None if the previous
        item has no place.
        """
        for item in reversed(self.mission[1:number]):
            match item.command:
                case mavlink.MAV_CMD_NAV_WAYPOINT | mavlink.MAV_CMD_NAV_LOITER_TIME:
                    return self.place(item.frame, item.x, item.y, item.z)
                case mavlink.MAV_CMD_DO_CHANGE_SPEED:
                    continue
            return None
        return None

    def _place_after(self, number: int) -> LocalPlace | None:
        """Return the place of the next mission item that is not a change of speed. Return None if there is no such
        item.
        """
        places = (item for item in self.mission[number + 1 :] if item.command != mavlink.MAV_CMD_DO_CHANGE_SPEED)
        item = next(places, None)
        return None if item is None else self.place(item.frame, item.x, item.y, item.z)

    def _item_reached(self) -> None:
        number = self.current_item
        self._tell(mavlink.MAVLink_mission_item_reached_message(number))
        self.say(mavlink.MAV_SEVERITY_INFO, f"Reached command #{number}")
        self._begin_item(number + 1)

    def _end_mission(self) -> None:
        """End the mission. A copter and a rover stay, and a plane flies home."""
        self._in_mission, self.current_item = False, 0
        if self.vehicle_type == "plane":
            self.set_mode(MODES["plane"]["RTL"])
        else:
            self._stay()

    def place(self, frame: int, lat_e7: int, lon_e7: int, alt_m: float) -> LocalPlace:
        """Convert a place to metres from home. `frame` is one of the coordinate frames in `FRAMES`. A latitude and
        longitude of 0 stand for the current position.
        """
        up_m = alt_m - self.home.alt_m if frame in ABSOLUTE_FRAMES else alt_m
        if lat_e7 == lon_e7 == 0:
            return self.motion.point._replace(up_m=up_m)
        north_m, east_m, _ = self.home.metres_to(lat_e7 / 1e7, lon_e7 / 1e7, 0.0)
        return LocalPlace(north_m, east_m, up_m)


SAID: dict[Failsafe, str] = {
    **dict.fromkeys(("battery low", "battery critical"), "Battery Failsafe"),
    "station": "GCS Failsafe",
    "radio": "Radio Failsafe",
    "fence": "fence breached",
}
"""Failsafe -> the text with which ArduPilot reports it."""

ABSOLUTE_FRAMES = (mavlink.MAV_FRAME_GLOBAL, mavlink.MAV_FRAME_GLOBAL_INT)
FRAMES = (*ABSOLUTE_FRAMES, mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT, mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT)

ITEM_NAMES: dict[int, str] = {
    mavlink.MAV_CMD_NAV_WAYPOINT: "WP",
    mavlink.MAV_CMD_NAV_LOITER_UNLIM: "LoitUnlim",
    mavlink.MAV_CMD_NAV_LOITER_TIME: "LoitTime",
    mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH: "RTL",
    mavlink.MAV_CMD_NAV_LAND: "Land",
    mavlink.MAV_CMD_NAV_TAKEOFF: "Takeoff",
    mavlink.MAV_CMD_DO_CHANGE_SPEED: "ChangeSpeed",
}
"""Number of a supported mission item -> its name in ArduPilot's texts."""
