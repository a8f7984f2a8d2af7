"""The `mavlink` event source: what a vehicle says about itself becomes loggable events.

`TelemetryEvents` is the translator: bytes from the vehicle in, (event ID, data) out, with time as an argument.
`follow` is the thin connection that feeds it. `describe` turns an event's data back into words.

    ID  event          data, big-endian (MAVLink messages it comes from)
    1   mode change    `>IBII`  vehicle time ms, MAV_TYPE, mode before (0xFFFFFFFF: unknown), mode   (HEARTBEAT)
    2   armed          `>II`    vehicle time ms, mode                                                (HEARTBEAT)
    3   disarmed       `>II`    vehicle time ms, mode                                                (HEARTBEAT)
    4   status text    `>IB`    vehicle time ms, MAV_SEVERITY, then the text in UTF-8                (STATUSTEXT)
    5   position       64 bytes, see `_POSITION`        (GLOBAL_POSITION_INT, ATTITUDE, SYS_STATUS, SYSTEM_TIME)

Vehicle time is milliseconds since the vehicle's boot, in its own (perhaps simulated) time. A mode is ArduPilot's
custom_mode. A position record is large enough that positions alone, one in 10 s, fill about nine blocks of 1024 bytes
in the thesis's 20 minutes.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import random
import struct
from collections.abc import Callable
from typing import Any

MODE_CHANGE, ARMED, DISARMED, STATUS_TEXT, POSITION = 1, 2, 3, 4, 5

MAX_DATA_BYTES = 256  # longer data is cut

UNKNOWN_MODE = 0xFFFFFFFF
_MODE_CHANGE = struct.Struct(">IBII")
_ARMING = struct.Struct(">II")
_STATUS_TEXT = struct.Struct(">IB")
_POSITION = struct.Struct(
    ">IQ"  # vehicle time ms since boot; vehicle's clock, microseconds since the Unix epoch (0: unknown)
    "iiii"  # latitude, longitude 1e-7 degrees; mm above sea level; mm above home
    "hhhH"  # velocity north, east, down cm/s; heading 0.01 degrees (65535: unknown)
    "fffhhh"  # roll, pitch, yaw radians (NaN: unknown); their rates mrad/s
    "Hhb"  # battery mV (65535: unknown), 0.01 A (-1: unknown), % left (-1: unknown)
    "IB"  # mode; 1 when armed
)

_AUTOPILOT_COMPONENT = 1  # MAV_COMP_ID_AUTOPILOT1
_CHUNK_CHARS = 50  # STATUSTEXT: a full text is followed by more when it has an ID

_REQUESTED = {33: 1.0, 30: 1.0, 1: 2.0, 2: 2.0}  # message ID: interval in simulated seconds
_SET_MESSAGE_INTERVAL = 511  # MAV_CMD_SET_MESSAGE_INTERVAL

_COMPANION_SYSTEM, _COMPANION_COMPONENT = 255, 191  # MAV_COMP_ID_ONBOARD_COMPUTER

_FIRST_RETRY_S, _LAST_RETRY_S = 0.05, 1.0
_FIRST_REQUEST_S, _LAST_REQUEST_S = 1.0, 30.0


class TelemetryEvents:
    """Translates one vehicle's MAVLink stream. No I/O; `now` is in mission seconds and never goes back.

    Counts what it could not read in `garbage`.
    """

    def __init__(self, position_interval_s: float, rng: random.Random) -> None:
        """`position_interval_s` is the mean time between two position events, in mission seconds.

        Each is due 0.5 to 1.5 intervals after the last, drawn from `rng`: vehicles that logged in lockstep would
        complete their blocks in the same instant, which no real swarm does.
        """
        from pymavlink.dialects.v20 import common  # an agent without a vehicle need not load it

        self.garbage = 0
        self._position_interval_s = position_interval_s
        self._rng = rng
        self._parser = common.MAVLink(None)
        self._parser.robust_parsing = True  # garbage is reported as BAD_DATA, not raised
        self._armed_flag: int = common.MAV_MODE_FLAG_SAFETY_ARMED
        self._no_autopilot: int = common.MAV_AUTOPILOT_INVALID
        self._position_due: float | None = None
        self._vehicle_ms = 0
        self._mode = UNKNOWN_MODE
        self._armed = False
        self._text = ""
        self._text_key = (0, 0)  # ID and severity of the text that is being collected
        self._attitude: Any = None
        self._status: Any = None
        self._clock_us = 0

    def receive(self, data: bytes, now: float) -> list[tuple[int, bytes]]:
        """Take bytes from the vehicle, in any pieces; return the events that they make. Raises nothing."""
        events: list[tuple[int, bytes]] = []
        for message in self._parser.parse_buffer(data) or ():
            kind = message.get_type()
            if kind == "BAD_DATA":
                self.garbage += 1
            elif message.get_srcComponent() == _AUTOPILOT_COMPONENT:
                self._translate(kind, message, now, events)
        # the parser frees its buffer only when a read ends with a message
        del self._parser.buf[: self._parser.buf_index]
        self._parser.buf_index = 0
        return [(event_id, data[:MAX_DATA_BYTES]) for event_id, data in events]

    def _translate(self, kind: str, message: Any, now: float, events: list[tuple[int, bytes]]) -> None:
        match kind:
            case "HEARTBEAT" if message.autopilot != self._no_autopilot:
                self._heartbeat(message, events)
            case "STATUSTEXT":
                self._status_text(message, events)
            case "GLOBAL_POSITION_INT":
                self._vehicle_ms = message.time_boot_ms
                self._position(message, now, events)
            case "ATTITUDE":
                self._vehicle_ms = message.time_boot_ms
                self._attitude = message
            case "SYS_STATUS":
                self._status = message
            case "SYSTEM_TIME":
                self._vehicle_ms = message.time_boot_ms
                self._clock_us = message.time_unix_usec

    def _heartbeat(self, message: Any, events: list[tuple[int, bytes]]) -> None:
        mode, armed = message.custom_mode, bool(message.base_mode & self._armed_flag)
        if mode != self._mode:
            events.append((MODE_CHANGE, _MODE_CHANGE.pack(self._vehicle_ms, message.type, self._mode, mode)))
        if armed != self._armed:
            events.append((ARMED if armed else DISARMED, _ARMING.pack(self._vehicle_ms, mode)))
        self._mode, self._armed = mode, armed

    def _status_text(self, message: Any, events: list[tuple[int, bytes]]) -> None:
        """MAVLink 2 sends a long text in chunks of 50 characters with the same ID; the last chunk is shorter."""
        key = (message.id, message.severity)
        if self._text and (key != self._text_key or message.chunk_seq == 0):
            self._end_text(events)  # its last chunk was lost
        self._text_key = key
        self._text = (self._text + message.text)[:MAX_DATA_BYTES]
        if message.id == 0 or len(message.text) < _CHUNK_CHARS:
            self._end_text(events)

    def _end_text(self, events: list[tuple[int, bytes]]) -> None:
        head = _STATUS_TEXT.pack(self._vehicle_ms, self._text_key[1])
        events.append((STATUS_TEXT, head + self._text.encode()))
        self._text = ""

    def _position(self, message: Any, now: float, events: list[tuple[int, bytes]]) -> None:
        if message.lat == 0 and message.lon == 0:  # no fix yet
            return
        if self._position_due is None:
            self._position_due = now + self._draw()
        if now < self._position_due:
            return
        self._position_due = now + self._draw()
        attitude, status = self._attitude, self._status
        angles = (attitude.roll, attitude.pitch, attitude.yaw) if attitude else (math.nan,) * 3
        rates = (attitude.rollspeed, attitude.pitchspeed, attitude.yawspeed) if attitude else (0.0,) * 3
        battery = (
            (status.voltage_battery, status.current_battery, status.battery_remaining) if status else (0xFFFF, -1, -1)
        )
        data = _POSITION.pack(
            *(message.time_boot_ms, self._clock_us),
            *(message.lat, message.lon, message.alt, message.relative_alt),
            *(message.vx, message.vy, message.vz, message.hdg),
            *angles,
            *(_milli(rate) for rate in rates),
            *battery,
            *(self._mode, self._armed),
        )
        events.append((POSITION, data))

    def _draw(self) -> float:
        return self._position_interval_s * self._rng.uniform(0.5, 1.5)


def _milli(value: float) -> int:
    """Thousandths in a signed 16-bit number; what does not fit, or is no number, is at the limit, or 0."""
    return 0 if math.isnan(value) else round(max(-32.768, min(32.767, value)) * 1000)


# ArduCopter flight modes (parameter FLTMODE1) for MAV_TYPEs that are copters
_COPTER_TYPES = frozenset({2, 3, 4, 13, 14, 15, 29})
_COPTER_MODES = {
    0: "STABILIZE",
    1: "ACRO",
    2: "ALT_HOLD",
    3: "AUTO",
    4: "GUIDED",
    5: "LOITER",
    6: "RTL",
    7: "CIRCLE",
    9: "LAND",
    16: "POSHOLD",
    17: "BRAKE",
    21: "SMART_RTL",
}
_SEVERITIES = ("emergency", "alert", "critical", "error", "warning", "notice", "info", "debug")  # MAV_SEVERITY


def describe(event_id: int, data: bytes) -> str:
    """Say in words what an event of this source holds; 'unreadable' when it is none. Raises nothing."""
    try:
        match event_id:
            case 1:
                ms, kind, before, mode = _MODE_CHANGE.unpack(data)
                change = "" if before == UNKNOWN_MODE else f" (was {_mode(before, kind)})"
                return f"{_seconds(ms)} mode {_mode(mode, kind)}{change}"
            case 2 | 3:
                ms, mode = _ARMING.unpack(data)
                return f"{_seconds(ms)} {'armed' if event_id == ARMED else 'disarmed'} in mode {mode}"
            case 4:
                ms, severity = _STATUS_TEXT.unpack_from(data)
                text = data[_STATUS_TEXT.size :].decode(errors="replace")
                printable = "".join(char if char.isprintable() else "?" for char in text)
                return f"{_seconds(ms)} {_SEVERITIES[severity]}: {printable}"
            case 5:
                return _describe_position(*_POSITION.unpack(data))
    except (struct.error, IndexError):
        pass
    return "unreadable"


def _describe_position(*fields: Any) -> str:
    ms, _, lat, lon, alt, relative_alt, north, east, down, heading, *_, millivolt, _, left, mode, armed = fields
    words = [
        f"{_seconds(ms)} at {lat / 1e7:.7f} {lon / 1e7:.7f}, {alt / 1e3:.1f} m, {relative_alt / 1e3:.1f} m above home",
        f"{math.hypot(north, east) / 100:.1f} m/s, climb {-down / 100:.1f} m/s",
    ]
    if heading != 0xFFFF:
        words.append(f"heading {heading / 100:.0f}")
    if millivolt != 0xFFFF:
        words.append(f"battery {millivolt / 1e3:.1f} V" + (f" {left} %" if left >= 0 else ""))
    words.append(f"mode {mode}" + (" armed" if armed else ""))
    return ", ".join(words)


def _seconds(vehicle_ms: int) -> str:
    return f"[{vehicle_ms / 1e3:.1f} s]"


def _mode(mode: int, vehicle_type: int) -> str:
    names = _COPTER_MODES if vehicle_type in _COPTER_TYPES else {}
    return names.get(mode, str(mode))


async def follow(host: str, port: int, sink: Callable[[bytes], None]) -> None:
    """Hand everything that the vehicle at `host`:`port` sends to `sink`, until cancelled.

    Waits for the vehicle to listen, asks it for the messages that `TelemetryEvents` wants, and connects again when it
    restarts. What `sink` raises ends it.
    """
    retry_s = _FIRST_RETRY_S
    while True:
        try:
            reader, writer = await asyncio.open_connection(host, port)
        except OSError:
            await asyncio.sleep(retry_s)
            retry_s = min(2 * retry_s, _LAST_RETRY_S)
            continue
        asking = asyncio.create_task(_keep_asking(writer))
        try:
            while data := await _read(reader):
                retry_s = _FIRST_RETRY_S
                sink(data)
        finally:
            asking.cancel()
            writer.close()
        await asyncio.sleep(_FIRST_RETRY_S)  # a port that accepts and closes at once is not hammered


async def _read(reader: asyncio.StreamReader) -> bytes:
    try:
        return await reader.read(65536)
    except OSError:  # a vehicle that is killed resets its connections
        return b""


async def _keep_asking(writer: asyncio.StreamWriter) -> None:
    """Ask for the messages, and again ever more seldom: a vehicle that is booting acknowledges and forgets."""
    from pymavlink.dialects.v20 import common

    mav = common.MAVLink(None, srcSystem=_COMPANION_SYSTEM, srcComponent=_COMPANION_COMPONENT)
    pause_s = _FIRST_REQUEST_S
    while True:
        for message_id, interval_s in _REQUESTED.items():
            # target 0: every system on this link, which is one
            request = common.MAVLink_command_long_message(
                0, 0, _SET_MESSAGE_INTERVAL, 0, message_id, interval_s * 1e6, 0, 0, 0, 0, 0
            )
            writer.write(request.pack(mav))
            mav.seq = (mav.seq + 1) % 256
        with contextlib.suppress(OSError):
            await writer.drain()
        await asyncio.sleep(pause_s)
        pause_s = min(2 * pause_s, _LAST_REQUEST_S)
