"""The pilot: the client that flies a vehicle over MAVLink, real ArduPilot and the embedded vehicle alike.

One process runs a pilot for every vehicle of a run, so a pilot is an asyncio protocol and a timer, nothing more. From
`start` to `close` it keeps the vehicle's state up to date and writes all it hears to the telemetry log.

Take-off is not a script but a question asked at every heartbeat: what is the next step that this vehicle has not made?
(`Pilot._next_step`). A vehicle that acknowledges a mode and undoes it, or disarms itself while the machine was busy,
both of which ArduPilot does, is simply asked again. The commands are those of ArduPilot's developer documentation,
"Copter Commands in Guided Mode".
"""

from __future__ import annotations

import asyncio
import collections
import enum
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl.tlog import TelemetryLog
from sitl.vehicle import FlightError

GUIDED = 4  # ArduCopter flight mode (parameter FLTMODE1)

GCS_SYSTEM = 255  # what ArduPilot takes for its ground station unless told otherwise
HEARTBEAT_INTERVAL_S = 1.0  # of our time
MAX_HEARTBEAT_INTERVAL_S = 2.0  # simulated: ArduPilot's ground station failsafe acts after 5 (FS_GCS_TIMEOUT)
TELEMETRY_INTERVAL_S = 0.25  # simulated
MIN_TELEMETRY_INTERVAL_S = 0.1  # of our time, per message: what a pilot costs must not grow with the speedup
SILENCE_S = 10.0  # of our time; a vehicle says something every simulated second
ARRIVED = 0.95  # of the altitude asked for, as ArduPilot's own tests have it
MIN_RATE_SPAN_S = 1.0

TELEMETRY = (
    mavlink.MAVLINK_MSG_ID_SYS_STATUS,
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME,
    mavlink.MAVLINK_MSG_ID_ATTITUDE,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
)


class Step(enum.Enum):
    """The steps of a take-off, as an error names them."""

    HEARTBEAT = "the first heartbeat"
    GUIDED = "mode GUIDED"
    READY = "ready to arm"
    ARM = "arming"
    TAKE_OFF = "the take-off command"
    CLIMB = "the climb"


@dataclass(frozen=True)
class Position:
    """Where a vehicle says it is: degrees, metres above sea level, metres above home."""

    lat_deg: float
    lon_deg: float
    alt_m: float
    relative_alt_m: float


@dataclass
class VehicleState:
    """What a vehicle last said about itself; None is "not yet"."""

    mode: int | None = None  # ArduPilot's custom_mode
    armed: bool = False
    ready_to_arm: bool | None = None
    position: Position | None = None
    time_s: float | None = None  # simulated, since boot
    texts: collections.deque[str] = field(default_factory=lambda: collections.deque(maxlen=20))  # latest last
    messages: int = 0
    garbage: int = 0  # stretches of bytes that were no message
    log_error: str | None = None  # why the telemetry log ends early, when it does


class Pilot(asyncio.Protocol):
    """Flies one vehicle over a connected socket. Not a thread's friend: use it in one event loop."""

    def __init__(self, sysid: int, sock: socket.socket, tlog: Path, speedup: float) -> None:
        """Take over `sock`, already connected to the vehicle's pilot port. `speedup` is what the vehicle was given.

        Raises OSError when `tlog` cannot be opened.
        """
        self.sysid = sysid
        self.state = VehicleState()
        self._socket = sock
        self._speedup = speedup
        self._tlog_path = tlog
        self._tlog: TelemetryLog | None = TelemetryLog(tlog)
        self._mav = mavlink.MAVLink(None, srcSystem=GCS_SYSTEM, srcComponent=mavlink.MAV_COMP_ID_MISSIONPLANNER)
        self._mav.robust_parsing = True  # garbage is reported as BAD_DATA, not raised
        self._handlers: dict[str, Callable[[Any], None]] = {
            "HEARTBEAT": self._on_heartbeat,
            "SYS_STATUS": self._on_sys_status,
            "SYSTEM_TIME": self._on_time,
            "ATTITUDE": self._on_time,
            "GLOBAL_POSITION_INT": self._on_position,
            "STATUSTEXT": self._on_text,
            "COMMAND_ACK": self._on_ack,
        }
        self._transport: asyncio.Transport | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._closed = asyncio.Event()
        self._heard = asyncio.Event()
        self._heard_at = time.monotonic()
        self._heartbeats = 0
        self._foreign_sysid: int | None = None
        self._take_off_accepted = False
        self._first_time: tuple[float, float] | None = None  # wall, simulated
        self._last_time: tuple[float, float] | None = None

    async def start(self) -> None:
        """Begin to read, to log and to send heartbeats."""
        self._socket.setblocking(False)
        self._heard_at = time.monotonic()
        await asyncio.get_running_loop().create_connection(lambda: self, sock=self._socket)

    async def follow(self) -> None:
        """Return when the connection has ended, from whichever side."""
        await self._closed.wait()

    async def close(self) -> None:
        """End the connection and complete the telemetry log. May be called twice, and before `start`."""
        if self._transport is None:
            self._socket.close()
            self._end_log()
            return
        self._transport.abort()  # a vehicle that is stopped would never take what is left to send
        await self._closed.wait()

    @property
    def real_time_factor(self) -> float | None:
        """Simulated seconds per second over the speedup, since first heard: 1.0 is a machine fast enough."""
        if self._first_time is None or self._last_time is None:
            return None
        wall_s = self._last_time[0] - self._first_time[0]
        if wall_s < MIN_RATE_SPAN_S:
            return None
        return (self._last_time[1] - self._first_time[1]) / wall_s / self._speedup

    async def take_off(self, altitude_m: float, deadline_s: float = 180.0) -> None:
        """Set GUIDED, arm, take off, and return at `altitude_m` above home.

        `deadline_s` is in simulated seconds, for all steps together. Raises FlightError, which names the vehicle, the
        step, and the last thing that the vehicle said, when the deadline passes, when the vehicle falls silent, when
        it ends the connection, or when it is not vehicle `sysid`.
        """
        began, began_s, asked_at_heartbeat = time.monotonic(), self.state.time_s, -1
        # a vehicle that crawls must end, too: no take-off takes longer than in real time
        limit = began + max(deadline_s, deadline_s / self._speedup)
        while (step := self._next_step(altitude_m)) is not None:
            if self._closed.is_set():
                raise self._failed(step, "it ended the connection")
            if self._foreign_sysid is not None:
                raise self._failed(step, f"it says that its system ID is {self._foreign_sysid}")
            if began_s is None:
                began_s = self.state.time_s
            flown_s = 0.0 if began_s is None or self.state.time_s is None else self.state.time_s - began_s
            now = time.monotonic()
            if flown_s >= deadline_s:
                raise self._failed(step, f"{deadline_s:g} simulated seconds were not enough")
            if now >= limit:
                raise self._failed(step, f"after {now - began:.0f} s it has flown {flown_s:.0f} simulated seconds")
            silence_ends = self._heard_at + SILENCE_S / min(1.0, self._speedup)
            if now >= silence_ends:
                raise self._failed(step, f"it has been silent for {now - self._heard_at:.1f} s")
            if asked_at_heartbeat != self._heartbeats:
                asked_at_heartbeat = self._heartbeats
                self._ask_for(step, altitude_m)
            self._heard.clear()
            try:
                async with asyncio.timeout(min(silence_ends, limit) - now):
                    await self._heard.wait()
            except TimeoutError:
                continue

    def _next_step(self, altitude_m: float) -> Step | None:
        state = self.state
        if state.mode is None:
            return Step.HEARTBEAT
        if state.mode != GUIDED:
            return Step.GUIDED
        if not state.armed:
            return Step.ARM if state.ready_to_arm else Step.READY
        if not self._take_off_accepted:
            return Step.TAKE_OFF
        if state.position is None or state.position.relative_alt_m < ARRIVED * altitude_m:
            return Step.CLIMB
        return None

    def _ask_for(self, step: Step, altitude_m: float) -> None:
        # more than once: a vehicle that is booting may acknowledge and forget
        heard = self.state.ready_to_arm is not None and self.state.position is not None
        if step in (Step.HEARTBEAT, Step.GUIDED) or not heard:
            self._request_telemetry()
        match step:
            case Step.GUIDED:
                self._command(mavlink.MAV_CMD_DO_SET_MODE, mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, float(GUIDED))
            case Step.ARM:
                self._take_off_accepted = False
                self._command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)
            case Step.TAKE_OFF:
                self._command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, altitude_m)

    def _request_telemetry(self) -> None:
        interval_s = max(TELEMETRY_INTERVAL_S, MIN_TELEMETRY_INTERVAL_S * self._speedup)
        for message_id in TELEMETRY:
            self._command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, message_id, interval_s * 1e6)

    def _command(self, command: int, *params: float) -> None:
        padded = [*params, *[0.0] * (7 - len(params))]
        self._send(
            mavlink.MAVLink_command_long_message(self.sysid, mavlink.MAV_COMP_ID_AUTOPILOT1, command, 0, *padded)
        )

    def _send(self, message: Any) -> None:
        if self._transport is not None and not self._transport.is_closing():
            self._transport.write(message.pack(self._mav))
            self._mav.seq = (self._mav.seq + 1) % 256

    def _failed(self, step: Step, reason: str) -> FlightError:
        said = f"its last words: {self.state.texts[-1]!r}" if self.state.texts else "it never said why"
        return FlightError(
            f"vehicle {self.sysid} did not take off: waiting for {step.value}, {reason}; {said} "
            f"(it is {'armed' if self.state.armed else 'not armed'}, in mode {self.state.mode}; "
            f"all it sent is in {self._tlog_path})"
        )

    # asyncio.Protocol

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        self._beat()

    def data_received(self, data: bytes) -> None:
        self._heard_at = time.monotonic()
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
        self._heard.set()

    def connection_lost(self, exc: Exception | None) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._end_log()
        self._closed.set()
        self._heard.set()

    def _beat(self) -> None:
        self._send(
            mavlink.MAVLink_heartbeat_message(
                mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE, 3
            )
        )
        if self._tlog is not None:
            try:
                self._tlog.flush()
            except OSError as error:
                self._give_up_log(error)
        interval_s = min(HEARTBEAT_INTERVAL_S, MAX_HEARTBEAT_INTERVAL_S / self._speedup)
        self._timer = asyncio.get_running_loop().call_later(interval_s, self._beat)

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
        """A full disk ends the log, not the flight."""
        self.state.log_error = f"telemetry log {self._tlog_path}: {error.strerror}"
        if self._tlog is not None:
            self._tlog.abandon()
            self._tlog = None

    # What the autopilot says

    def _on_heartbeat(self, message: Any) -> None:
        if message.get_srcSystem() != self.sysid:
            self._foreign_sysid = message.get_srcSystem()
            return
        self._heartbeats += 1
        self.state.mode = message.custom_mode
        self.state.armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)

    def _on_sys_status(self, message: Any) -> None:
        check = mavlink.MAV_SYS_STATUS_PREARM_CHECK
        # firmware older than 4.0 does not report its pre-arm checks; it is asked to arm and says no
        reports = message.onboard_control_sensors_present & check
        self.state.ready_to_arm = not reports or bool(message.onboard_control_sensors_health & check)

    def _on_position(self, message: Any) -> None:
        self.state.position = Position(
            message.lat / 1e7, message.lon / 1e7, message.alt / 1e3, message.relative_alt / 1e3
        )
        self._on_time(message)

    def _on_time(self, message: Any) -> None:
        now = (self._heard_at, message.time_boot_ms / 1e3)
        if self._last_time is None or now[1] < self._last_time[1] - 1.0:  # first heard, or rebooted
            self._first_time = now
        self._last_time = now
        self.state.time_s = now[1]

    def _on_text(self, message: Any) -> None:
        self.state.texts.append(message.text)

    def _on_ack(self, message: Any) -> None:
        if message.command == mavlink.MAV_CMD_NAV_TAKEOFF and message.result == mavlink.MAV_RESULT_ACCEPTED:
            self._take_off_accepted = True
