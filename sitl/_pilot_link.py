"""Connect a pilot to its vehicle: track the vehicle's state, write the telemetry log, and send messages.

One process has a link for each vehicle of a run. To save threads, a link consists of an asyncio protocol and a timer.
"""

from __future__ import annotations

import asyncio
import math
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl._tlog import TelemetryLog
from sitl._vehicle_state import Battery, FirmwareVersion, ReportedPosition, VehicleState
from sitl.parameters import MAX_PARAMETERS
from sitl.vehicle import Home

STATION_SYSTEM = 255  # ArduPilot's default for the ground station
STATION_PARAMETERS = ("MAV_GCS_SYSID", "SYSID_MYGCS")
"""Two names of the parameter that contains the system ID of the vehicle's ground station: the name since ArduPilot 4.7,
and the older name.
"""
PILOT_SYSTEMS = (254, 253)
"""System IDs of the pilot. The pilot uses the second ID if its vehicle itself has the first ID."""
HEARTBEAT_INTERVAL_S = 1.0  # wall time
MAX_HEARTBEAT_INTERVAL_S = 2.0  # simulated: ArduPilot's ground station failsafe acts after 5 (FS_GCS_TIMEOUT)
LOW_M = 2.0  # a vehicle below this may lie on the ground
TELEMETRY_INTERVAL_S = 0.25  # simulated
MIN_TELEMETRY_INTERVAL_S = 0.1  # wall time per message: the cost of a link must not grow with the speedup
PATIENCE_INTERVALS = 4  # a repeated request postpones the messages
MIN_RATE_SPAN_S = 1.0
HEIGHTS_DIFFER_M = 10.0

TELEMETRY = (
    mavlink.MAVLINK_MSG_ID_SYS_STATUS,
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME,
    mavlink.MAVLINK_MSG_ID_ATTITUDE,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
    mavlink.MAVLINK_MSG_ID_MISSION_CURRENT,
)


class PilotLink(asyncio.Protocol):
    """A connection to one vehicle over a connected socket. It may be used in one event loop only.

    The link sends two kinds of heartbeats. The heartbeats of the pilot have the pilot's system ID. The heartbeats of a
    ground station have the ID that the vehicle expects from its ground station. Without such heartbeats, the vehicle's
    failsafe would act. If the run has a real ground station, the link sends only the heartbeats of the pilot.
    """

    def __init__(self, sysid: int, sock: socket.socket, tlog: Path, speedup: float, home: Home) -> None:
        """Take over `sock`, a socket that is connected to the vehicle. The vehicle was started at `home`.

        Raises OSError if `tlog` cannot be opened.
        """
        self.sysid = sysid
        self.home = home
        self.speedup = speedup
        self.tlog_path = tlog
        self.state = VehicleState()
        self.closed = asyncio.Event()
        """An event that is set when the connection ends."""
        self.heard = asyncio.Event()
        """An event that is set when data arrives, and when the connection ends."""
        self.heard_at = time.monotonic()
        """Time of the last data from the vehicle. `heard_at`, `heartbeat_at` and `position_at` are values of
        time.monotonic().
        """
        self.heartbeat_at: float | None = None
        self.position_at: float | None = None
        self.heartbeats = 0
        self.plays_station = self.station_is_heard = True
        """`plays_station` is false if the run has a real ground station. `station_is_heard` is false while the loss of
        the ground station is simulated. The link sends heartbeats of a ground station only while both values are true.
        """
        self.foreign_sysid: int | None = None
        self.acks: dict[int, int] = {}  # MAV_CMD: the last MAV_RESULT
        self.accepted: set[int] = set()
        """The commands that the vehicle has accepted since the last `forget`. A vehicle may refuse the repetition of a
        command that it already carries out, for example a take-off.
        """
        self.parameters: dict[str, float] = {}
        self.parameter_count: int | None = None
        self.listed: set[int] = set()  # list indices of the received parameters
        self._asked_mode: int | None = None
        self._was_in_asked_mode = self._was_armed = False
        self.on_mission: Callable[[Any], None] | None = None  # receives the messages of the mission protocol
        self._socket = sock
        self._tlog: TelemetryLog | None = TelemetryLog(tlog)
        system = next(number for number in PILOT_SYSTEMS if number != sysid)
        self._mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=mavlink.MAV_COMP_ID_MISSIONPLANNER)
        self._station = mavlink.MAVLink(None, srcComponent=mavlink.MAV_COMP_ID_MISSIONPLANNER)
        self._mav.robust_parsing = True  # garbage is reported as BAD_DATA, not raised
        self._handlers: dict[str, Callable[[Any], None]] = {
            "HEARTBEAT": self._on_heartbeat,
            "SYS_STATUS": self._on_sys_status,
            "SYSTEM_TIME": self._on_time,
            "ATTITUDE": self._on_time,
            "GLOBAL_POSITION_INT": self._on_position,
            "STATUSTEXT": self._on_text,
            "COMMAND_ACK": self._on_ack,
            "PARAM_VALUE": self._on_parameter,
            "AUTOPILOT_VERSION": self._on_version,
            "MISSION_CURRENT": self._on_item,
            "MISSION_ITEM_REACHED": self._on_item_reached,
            **dict.fromkeys(("MISSION_REQUEST", "MISSION_REQUEST_INT", "MISSION_ACK"), self._on_mission),
        }
        self._transport: asyncio.Transport | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._asked_at: float | None = None  # for telemetry
        self._first_time: tuple[float, float] | None = None  # wall, simulated
        self._last_time: tuple[float, float] | None = None
        self._estimate_is_good = False
        self._knows_its_height: bool | None = None  # whether its height was right when its estimate became good

    async def start(self) -> None:
        """Start to read and log messages, and to send heartbeats."""
        self._socket.setblocking(False)
        self.heard_at = time.monotonic()
        await asyncio.get_running_loop().create_connection(lambda: self, sock=self._socket)

    async def close(self) -> None:
        """End the connection and complete the telemetry log. It may be called twice, and before `start`."""
        if self._transport is None:
            self._socket.close()
            self._end_log()
            return
        self._transport.abort()  # a stopped vehicle would never read the remaining data
        await self.closed.wait()

    @property
    def real_time_factor(self) -> float | None:
        """The number of simulated seconds per second of wall time since the first message, divided by the speedup. The
        value is 1.0 if the machine is fast enough, and less if it is too slow. It is None if too little time has
        passed.
        """
        if self._first_time is None or self._last_time is None:
            return None
        wall_s = self._last_time[0] - self._first_time[0]
        if wall_s < MIN_RATE_SPAN_S:
            return None
        return (self._last_time[1] - self._first_time[1]) / wall_s / self.speedup

    def request_telemetry(self) -> None:
        """Request the messages of TELEMETRY, unless they were requested very recently."""
        interval_s = max(TELEMETRY_INTERVAL_S, MIN_TELEMETRY_INTERVAL_S * self.speedup)
        now, patience_s = time.monotonic(), max(1.0, PATIENCE_INTERVALS * interval_s / self.speedup)
        if self._asked_at is not None and now - self._asked_at < patience_s:
            return
        self._asked_at = now
        for message_id in TELEMETRY:
            self.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, message_id, interval_s * 1e6)

    def command(self, command: int, *params: float) -> None:
        """Send a COMMAND_LONG. Missing parameters are 0."""
        padded = [*params, *[0.0] * (7 - len(params))]
        self.send(mavlink.MAVLink_command_long_message(self.sysid, mavlink.MAV_COMP_ID_AUTOPILOT1, command, 0, *padded))

    def forget(self, command: int) -> None:
        """Forget earlier answers of the vehicle to a command, before the command is sent again."""
        self.acks.pop(command, None)
        self.accepted.discard(command)

    def ask_for_mode(self, number: int) -> None:
        """Request a change of the mode (custom_mode)."""
        kind = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        if number != self._asked_mode:
            self._asked_mode, self._was_in_asked_mode = number, False
        self.command(mavlink.MAV_CMD_DO_SET_MODE, kind, float(number))
        if self.acks.get(mavlink.MAV_CMD_DO_SET_MODE) == mavlink.MAV_RESULT_UNSUPPORTED:  # ArduCopter 3.5
            self.send(mavlink.MAVLink_set_mode_message(self.sysid, kind, number))

    @property
    def has_left_its_mode(self) -> bool:
        """True if the vehicle was in the requested mode and has left it."""
        return self._was_in_asked_mode and self.state.mode != self._asked_mode

    @property
    def has_disarmed(self) -> bool:
        return self._was_armed and not self.state.armed

    @property
    def has_armed(self) -> bool:
        """True if the vehicle was armed at any time."""
        return self._was_armed

    def set_parameter(self, name: str, value: float) -> None:
        """Set a parameter. The answer of the vehicle appears in `parameters`."""
        target = (self.sysid, mavlink.MAV_COMP_ID_AUTOPILOT1)
        self.send(mavlink.MAVLink_param_set_message(*target, name.encode(), value, mavlink.MAV_PARAM_TYPE_REAL32))

    def request_parameter(self, name: str) -> None:
        """Request a parameter.

        The answer appears in `parameters`. A vehicle without the parameter may send no answer.
        """
        target = (self.sysid, mavlink.MAV_COMP_ID_AUTOPILOT1)
        self.send(mavlink.MAVLink_param_request_read_message(*target, name.encode(), -1))

    def request_parameter_at(self, index: int) -> None:
        """Request the parameter at an index of the vehicle's list."""
        target = (self.sysid, mavlink.MAV_COMP_ID_AUTOPILOT1)
        self.send(mavlink.MAVLink_param_request_read_message(*target, b"", index))

    def request_parameters(self) -> None:
        """Request all parameters, about 1,300 messages."""
        self.send(mavlink.MAVLink_param_request_list_message(self.sysid, mavlink.MAV_COMP_ID_AUTOPILOT1))

    @property
    def has_listed_parameters(self) -> bool:
        return self.parameter_count is not None and len(self.listed) >= self.parameter_count

    def send(self, message: Any) -> None:
        self._send(message, self._mav)

    def _send(self, message: Any, sender: mavlink.MAVLink) -> None:
        if self._transport is not None and not self._transport.is_closing():
            self._transport.write(message.pack(sender))
            sender.seq = (sender.seq + 1) % 256

    # asyncio.Protocol

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        self._send_heartbeat()

    def data_received(self, data: bytes) -> None:
        self.heard_at = time.monotonic()
        now_us = time.time_ns() // 1000
        for message in self._mav.parse_buffer(data) or ():
            kind = message.get_type()
            if kind == "BAD_DATA":
                self.state.garbage += 1
                continue
            self.state.messages += 1
            self._log(now_us, message.get_msgbuf())
            handler = self._handlers.get(kind)
            if handler is not None and message.get_srcComponent() == mavlink.MAV_COMP_ID_AUTOPILOT1:
                handler(message)
        # the parser frees its buffer only when a read ends with a message
        del self._mav.buf[: self._mav.buf_index]
        self._mav.buf_index = 0
        self.heard.set()

    def connection_lost(self, exc: Exception | None) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._end_log()
        self.closed.set()
        self.heard.set()

    def _send_heartbeat(self) -> None:
        heartbeat = mavlink.MAVLink_heartbeat_message(
            mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE, 3
        )
        self.send(heartbeat)
        if self.plays_station and self.station_is_heard:
            known = (self.parameters[name] for name in STATION_PARAMETERS if name in self.parameters)
            self._station.srcSystem = int(next(known, STATION_SYSTEM)) & 0xFF
            self._send(heartbeat, self._station)
        if self._tlog is not None:
            try:
                self._tlog.flush()
            except OSError as error:
                self._give_up_log(error)
        interval_s = min(HEARTBEAT_INTERVAL_S, MAX_HEARTBEAT_INTERVAL_S / self.speedup)
        self._timer = asyncio.get_running_loop().call_later(interval_s, self._send_heartbeat)

    def _log(self, now_us: int, frame: bytearray) -> None:
        if self._tlog is not None:
            try:
                self._tlog.write(now_us, frame)
            except OSError as error:
                self._give_up_log(error)

    def _end_log(self) -> None:
        if self._tlog is not None:
            try:
                self._tlog.close()
            except OSError as error:
                self._give_up_log(error)
            self._tlog = None

    def _give_up_log(self, error: OSError) -> None:
        """Stop writing the telemetry log after an error, for example on a full disk. The flight continues."""
        self.state.log_error = f"telemetry log {self.tlog_path}: {error.strerror}"
        if self._tlog is not None:
            self._tlog.abandon()
            self._tlog = None

    # Messages of the autopilot

    def _on_heartbeat(self, message: Any) -> None:
        if message.get_srcSystem() != self.sysid:
            self.foreign_sysid = message.get_srcSystem()
            return
        self.heartbeats += 1
        self.heartbeat_at = self.heard_at
        self.state.mode = message.custom_mode
        self.state.mav_type = message.type
        self._was_in_asked_mode |= message.custom_mode == self._asked_mode
        self.state.armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        self._was_armed |= self.state.armed

    def _on_sys_status(self, message: Any) -> None:
        check = mavlink.MAV_SYS_STATUS_PREARM_CHECK
        # Firmware older than 4.0 does not report its pre-arm checks. It refuses the command to arm instead.
        reports = message.onboard_control_sensors_present & check
        self.state.ready_to_arm = not reports or bool(message.onboard_control_sensors_health & check)
        estimator_bit = message.onboard_control_sensors_present & mavlink.MAV_SYS_STATUS_AHRS
        self._estimate_is_good = not estimator_bit or bool(message.onboard_control_sensors_health & estimator_bit)
        voltage, left = message.voltage_battery, message.battery_remaining
        self.state.battery = Battery(None if voltage == 0xFFFF else voltage / 1e3, None if left < 0 else left / 100)

    def _on_position(self, message: Any) -> None:
        self.position_at = self.heard_at
        self._on_time(message)
        if not self._estimate_is_good or (message.lat == 0 and message.lon == 0):
            return  # after boot, ArduPlane 4.7 reports a place near 0 N, 0 E, and a rover an altitude of 0
        height_m, says_m = message.alt / 1e3 - self.home.alt_m, message.relative_alt / 1e3
        if self._knows_its_height is None:  # a rover of 4.7 always reports 584 m above home
            self._knows_its_height = abs(says_m - height_m) < HEIGHTS_DIFFER_M
        if self._knows_its_height:  # without GPS, a copter of 4.7 does not update its altitude above the sea
            height_m = says_m
        self.state.position = ReportedPosition(
            message.lat / 1e7,
            message.lon / 1e7,
            self.home.alt_m + height_m,
            height_m,
            message.vx / 100,
            message.vy / 100,
            -message.vz / 100,
            None if message.hdg == 0xFFFF else message.hdg / 100,
        )
        away_m = math.hypot(*self.home.metres_to(message.lat / 1e7, message.lon / 1e7, self.home.alt_m)[:2])
        self.state.has_moved |= self.state.armed and (
            away_m > LOW_M or (bool(self._knows_its_height) and height_m > LOW_M)
        )

    def _on_time(self, message: Any) -> None:
        now = (self.heard_at, message.time_boot_ms / 1e3)
        if self._last_time is None or now[1] < self._last_time[1] - 1.0:  # first heard, or rebooted
            self._first_time = now
            self._estimate_is_good, self._knows_its_height = False, None
        self._last_time = now
        self.state.time_s = now[1]

    def _on_text(self, message: Any) -> None:
        self.state.texts.append(message.text)

    def _on_ack(self, message: Any) -> None:
        self.acks[message.command] = message.result
        if message.result == mavlink.MAV_RESULT_ACCEPTED:
            self.accepted.add(message.command)

    def _on_parameter(self, message: Any) -> None:
        if message.param_id not in self.parameters and len(self.parameters) >= MAX_PARAMETERS:
            return
        self.parameters[message.param_id] = message.param_value
        if message.param_index < message.param_count <= MAX_PARAMETERS:  # not requested by name
            self.parameter_count = message.param_count
            self.listed.add(message.param_index)

    def _on_version(self, message: Any) -> None:
        self.state.version = FirmwareVersion.of(message.flight_sw_version, bytes(message.flight_custom_version))

    def _on_item(self, message: Any) -> None:
        self.state.item = message.seq

    def _on_item_reached(self, message: Any) -> None:
        self.state.reached = message.seq

    def _on_mission(self, message: Any) -> None:
        if self.on_mission is not None:
            self.on_mission(message)
