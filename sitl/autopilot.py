"""The embedded vehicle's autopilot: MAVLink in, MAVLink out, no socket and no clock.

`Autopilot` is the vehicle: mode, arming, flight. `Channel` is one client's view of it: its own parser, sequence
numbers and message intervals, as each serial port of an ArduPilot has. Times are simulated seconds since boot.

It answers as an ArduCopter does where a client can tell the difference: arming is refused until the position is known,
take-off until armed and in GUIDED, and a mode set in the first seconds after boot is acknowledged and then undone.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from sitl.kinematics import Copter, Phase
from sitl.vehicle import Home

# ArduCopter flight modes (parameter FLTMODE1)
STABILIZE, GUIDED, LAND = 0, 4, 9
MODE_NAMES = {STABILIZE: "STABILIZE", GUIDED: "GUIDED", LAND: "LAND"}

MODE_SWITCH_READ_S = 3.0  # ArduPilot reads its mode switch about now, and undoes a mode set earlier
READY_S = 10.0  # the simulated GPS has a fix

HEARTBEAT_INTERVAL_S = 1.0
DEFAULT_INTERVAL_S = 1.0
MIN_INTERVAL_S = 0.02

BATTERY_FULL_MAH, BATTERY_FULL_MV, BATTERY_EMPTY_MV = 10_000.0, 16_800, 13_200
CURRENT_ARMED_A, CURRENT_IDLE_A = 10.0, 0.3

SENSORS = (
    mavlink.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | mavlink.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    | mavlink.MAV_SYS_STATUS_SENSOR_GPS
    | mavlink.MAV_SYS_STATUS_SENSOR_BATTERY
    | mavlink.MAV_SYS_STATUS_PREARM_CHECK
)
NOT_YET = mavlink.MAV_SYS_STATUS_SENSOR_GPS | mavlink.MAV_SYS_STATUS_PREARM_CHECK


class Autopilot:
    """One vehicle. `epoch_us` is the time of its boot, microseconds since the Unix epoch."""

    def __init__(self, sysid: int, home: Home, epoch_us: int) -> None:
        self.sysid = sysid
        self.home = home
        self.epoch_us = epoch_us
        self.copter = Copter(home.heading_deg)
        self.mode = STABILIZE
        self.armed = False
        self.now_s = 0.0
        self.used_mah = 0.0
        self.channels: list[Channel] = []

    @property
    def ready(self) -> bool:
        return self.now_s >= READY_S

    def advance(self, now_s: float) -> None:
        """Let the time until `now_s` pass."""
        before_s, self.now_s = self.now_s, max(self.now_s, now_s)
        current_a = CURRENT_ARMED_A if self.armed else CURRENT_IDLE_A
        self.used_mah = min(BATTERY_FULL_MAH, self.used_mah + current_a * (self.now_s - before_s) / 3.6)
        if before_s < MODE_SWITCH_READ_S <= self.now_s:
            self.mode = STABILIZE
        if before_s < READY_S <= self.now_s:
            self.say(mavlink.MAV_SEVERITY_INFO, "Position known, ready to arm")
        was = self.copter.phase
        self.copter.advance(self.now_s)
        if was is Phase.LAND and self.copter.phase is Phase.GROUND:
            self._disarm()

    def say(self, severity: int, text: str) -> None:
        """Tell every client: a STATUSTEXT."""
        for channel in self.channels:
            channel.send(mavlink.MAVLink_statustext_message(severity, text.encode()))

    def arm_or_disarm(self, arm: bool) -> int:
        if arm == self.armed:
            return int(mavlink.MAV_RESULT_ACCEPTED)
        if not arm and self.copter.phase is not Phase.GROUND:
            return self._refuse("Disarm refused: in flight")
        if arm and not self.ready:
            return self._refuse("PreArm: Need Position Estimate")
        if arm and self.mode == LAND:
            return self._refuse("Arm: LAND mode not armable")
        if arm:
            self.armed = True
            self.say(mavlink.MAV_SEVERITY_INFO, "Arming motors")
        else:
            self._disarm()
        return int(mavlink.MAV_RESULT_ACCEPTED)

    def take_off(self, altitude_m: float) -> int:
        if not self.armed:
            return self._refuse("Take-off refused: not armed")
        if self.mode != GUIDED:
            return self._refuse(f"Take-off refused: mode is {MODE_NAMES[self.mode]}, not GUIDED")
        if self.copter.phase is not Phase.GROUND:
            return self._refuse("Take-off refused: already flying")
        if not (math.isfinite(altitude_m) and 0 < altitude_m <= 10_000):
            return self._refuse("Take-off refused: no such altitude")
        self.copter.take_off(altitude_m, self.now_s)
        return int(mavlink.MAV_RESULT_ACCEPTED)

    def set_mode(self, mode: float) -> int:
        if mode not in MODE_NAMES:
            return self._refuse("Mode change refused: no such mode")
        if mode == STABILIZE and self.copter.phase is not Phase.GROUND:
            return self._refuse("Mode change refused: nobody has the sticks")
        self.mode = int(mode)
        if mode == LAND:
            self.copter.land(self.now_s)
        elif mode == GUIDED:
            self.copter.hold(self.now_s)
        return int(mavlink.MAV_RESULT_ACCEPTED)

    def _disarm(self) -> None:
        self.armed = False
        self.say(mavlink.MAV_SEVERITY_INFO, "Disarming motors")

    def _refuse(self, text: str) -> int:
        self.say(mavlink.MAV_SEVERITY_CRITICAL, text)
        return int(mavlink.MAV_RESULT_FAILED)

    # What the vehicle says about itself, one method per message of `STREAMS`.

    def heartbeat(self) -> Any:
        base_mode = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        if self.armed:
            base_mode |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
        flying = self.copter.phase is not Phase.GROUND
        return mavlink.MAVLink_heartbeat_message(
            mavlink.MAV_TYPE_QUADROTOR,
            mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
            base_mode,
            self.mode,
            mavlink.MAV_STATE_ACTIVE if flying else mavlink.MAV_STATE_STANDBY,
            3,  # MAVLink 2 still says 3 here
        )

    def sys_status(self) -> Any:
        left = 1 - self.used_mah / BATTERY_FULL_MAH
        return mavlink.MAVLink_sys_status_message(
            onboard_control_sensors_present=SENSORS,
            onboard_control_sensors_enabled=SENSORS,
            onboard_control_sensors_health=SENSORS if self.ready else SENSORS & ~NOT_YET,
            load=50,
            voltage_battery=round(BATTERY_EMPTY_MV + left * (BATTERY_FULL_MV - BATTERY_EMPTY_MV)),
            current_battery=round(100 * (CURRENT_ARMED_A if self.armed else CURRENT_IDLE_A)),
            battery_remaining=round(100 * left),
            drop_rate_comm=0,
            errors_comm=0,
            errors_count1=0,
            errors_count2=0,
            errors_count3=0,
            errors_count4=0,
        )

    def system_time(self) -> Any:
        return mavlink.MAVLink_system_time_message(self.epoch_us + round(self.now_s * 1e6), self._boot_ms())

    def attitude(self) -> Any:
        motion = self.copter.motion
        yaw = (motion.yaw_rad + math.pi) % math.tau - math.pi
        return mavlink.MAVLink_attitude_message(
            self._boot_ms(), motion.roll_rad, 0.0, yaw, 0.0, 0.0, motion.yaw_rate_rads
        )

    def global_position_int(self) -> Any:
        motion = self.copter.motion
        # as ArduPilot before its first fix: nowhere
        place = self.home.offset(motion.north_m, motion.east_m) if self.ready else Home(0.0, 0.0)
        return mavlink.MAVLink_global_position_int_message(
            self._boot_ms(),
            round(place.lat_deg * 1e7),
            round(place.lon_deg * 1e7),
            round((self.home.alt_m + motion.up_m) * 1e3),
            round(motion.up_m * 1e3),
            round(motion.north_ms * 100),
            round(motion.east_ms * 100),
            round(-motion.up_ms * 100),
            round(math.degrees(motion.yaw_rad) * 100) % 36_000,
        )

    def _boot_ms(self) -> int:
        return int(self.now_s * 1e3) & 0xFFFFFFFF


STREAMS: dict[int, Callable[[Autopilot], Any]] = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: Autopilot.heartbeat,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: Autopilot.sys_status,
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: Autopilot.system_time,
    mavlink.MAVLINK_MSG_ID_ATTITUDE: Autopilot.attitude,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: Autopilot.global_position_int,
}


class Channel:
    """One client of an autopilot, from connection to disconnection."""

    def __init__(self, autopilot: Autopilot) -> None:
        self._autopilot = autopilot
        self._mav = mavlink.MAVLink(None, srcSystem=autopilot.sysid, srcComponent=mavlink.MAV_COMP_ID_AUTOPILOT1)
        self._mav.robust_parsing = True  # garbage is reported as BAD_DATA, not raised
        self._out = bytearray()
        self._interval_s = dict.fromkeys(STREAMS, DEFAULT_INTERVAL_S)
        self._interval_s[mavlink.MAVLINK_MSG_ID_HEARTBEAT] = HEARTBEAT_INTERVAL_S
        self._due_s = dict.fromkeys(STREAMS, autopilot.now_s)
        autopilot.channels.append(self)

    def close(self) -> None:
        self._autopilot.channels.remove(self)

    def receive(self, data: bytes) -> None:
        """Take bytes from the client, in any pieces, with anything in them."""
        for message in self._mav.parse_buffer(data) or ():
            if message.get_type() == "COMMAND_LONG":
                self._command(message)
        # the parser frees its buffer only when a read ends with a message
        del self._mav.buf[: self._mav.buf_index]
        self._mav.buf_index = 0

    def send(self, message: Any) -> None:
        self._out += message.pack(self._mav)
        self._mav.seq = (self._mav.seq + 1) % 256

    def send_due(self) -> None:
        """Send every message whose interval has passed, once: a client behind schedule gets the latest, not a burst."""
        now_s = self._autopilot.now_s
        for message_id, due_s in self._due_s.items():
            if due_s <= now_s:
                self.send(STREAMS[message_id](self._autopilot))
                self._due_s[message_id] = max(due_s + self._interval_s[message_id], now_s)

    def next_due_s(self) -> float:
        return min(self._due_s.values())

    def take(self) -> bytes:
        """What is to be sent to the client."""
        data = bytes(self._out)
        self._out.clear()
        return data

    def _command(self, message: Any) -> None:
        vehicle = self._autopilot
        if message.target_system not in (0, vehicle.sysid):
            return
        if message.target_component not in (0, mavlink.MAV_COMP_ID_AUTOPILOT1):
            return
        match message.command:
            case mavlink.MAV_CMD_COMPONENT_ARM_DISARM:
                result = vehicle.arm_or_disarm(message.param1 == 1)
            case mavlink.MAV_CMD_NAV_TAKEOFF:
                result = vehicle.take_off(message.param7)
            case mavlink.MAV_CMD_NAV_LAND:
                result = vehicle.set_mode(LAND)
            case mavlink.MAV_CMD_DO_SET_MODE:
                result = vehicle.set_mode(message.param2)
            case mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
                result = self._set_interval(message.param1, message.param2)
            case mavlink.MAV_CMD_REQUEST_MESSAGE:
                result = self._request(message.param1)
            case _:
                result = mavlink.MAV_RESULT_UNSUPPORTED
        self.send(
            mavlink.MAVLink_command_ack_message(
                message.command,
                result,
                target_system=message.get_srcSystem(),
                target_component=message.get_srcComponent(),
            )
        )

    def _set_interval(self, message_id: float, interval_us: float) -> int:
        """MAV_CMD_SET_MESSAGE_INTERVAL: microseconds; 0 is the default interval, -1 is never."""
        if message_id not in STREAMS or not math.isfinite(interval_us):
            return int(mavlink.MAV_RESULT_FAILED)
        if interval_us < 0:
            interval_s = math.inf
        elif interval_us == 0:
            interval_s = DEFAULT_INTERVAL_S
        else:
            interval_s = max(MIN_INTERVAL_S, interval_us / 1e6)
        self._interval_s[int(message_id)] = interval_s
        self._due_s[int(message_id)] = self._autopilot.now_s + interval_s
        return int(mavlink.MAV_RESULT_ACCEPTED)

    def _request(self, message_id: float) -> int:
        if message_id not in STREAMS:
            return int(mavlink.MAV_RESULT_FAILED)
        self.send(STREAMS[int(message_id)](self._autopilot))
        return int(mavlink.MAV_RESULT_ACCEPTED)
