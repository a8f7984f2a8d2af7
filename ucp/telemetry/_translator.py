"""MAVLink in, loggable events out; no I/O and no clock."""

from __future__ import annotations

import math
import random
from collections.abc import Iterable
from typing import Any

from ucp.events import DEFAULT_LOG, EventKind
from ucp.telemetry import _records
from ucp.telemetry._records import Position

_AUTOPILOT_COMPONENT = 1  # MAV_COMP_ID_AUTOPILOT1
_CHUNK_CHARS = 50  # STATUSTEXT: a full text is followed by more when it has an ID
_BATTERY_LEVELS = (0, 5, 10, 15, *range(20, 101, 10))  # percent
_CHARGED_PERCENT = 10  # a battery that has so much more than at the last level was charged or changed
_NAGGING = "PreArm: "  # how a text begins that ArduPilot says again every 30 s while it cannot be armed
_MOST_NAGGED = 100
_BOOTED_MS = 1_000  # a clock that goes back as much as this has begun anew
_HOME_OFF_MM = 10_000  # a vehicle that stands so far above its home has set it before it knew its altitude
_HOME_MOVED_MM = 1_000
_NEVER_FLIES = frozenset({10, 11})  # MAV_TYPE_GROUND_ROVER, MAV_TYPE_SURFACE_BOAT


class TelemetryEvents:
    """Translates one vehicle's MAVLink stream. No I/O; `now` is in mission seconds and never goes back.

    Counts what it could not read in `garbage`.
    """

    def __init__(self, position_interval_s: float, rng: random.Random, log: Iterable[EventKind] = DEFAULT_LOG) -> None:
        """`position_interval_s` is the mean time between two position events, in mission seconds; `log` what to log.

        Each is due 0.5 to 1.5 intervals after the last, drawn from `rng`: vehicles that logged in lockstep would
        complete their blocks in the same instant, which no real swarm does.
        """
        from pymavlink.dialects.v20 import common  # an agent without a vehicle need not load it

        self.garbage = 0
        self._position_interval_s = position_interval_s
        self._rng = rng
        self._logged = frozenset(event_id for kind in log for event_id in _records.EVENT_KINDS[kind])
        self._parser = common.MAVLink(None)
        self._parser.robust_parsing = True  # garbage is reported as BAD_DATA, not raised
        self._armed_flag: int = common.MAV_MODE_FLAG_SAFETY_ARMED
        self._no_autopilot: int = common.MAV_AUTOPILOT_INVALID
        self._estimate: int = common.MAV_SYS_STATUS_AHRS
        self._position_due: float | None = None
        self._vehicle_ms = 0
        self._mode = _records.UNKNOWN_MODE
        self._armed = self._never_flies = False
        self._state = 0  # MAV_STATE_UNINIT
        self._failsafe = (0, 0)  # MAV_STATE if critical, what failed: as last logged
        self._text = ""
        self._text_key = (0, 0)  # ID and severity of the text that is being collected
        self._nagged: set[str] = (
            set()
        )  # texts that it says again and again, since it was last armed or changed its mode
        self._heading_for: int | None = None  # item of its mission, if it has said so since it reached another
        self._ground: _Ground | None = None
        self._attitude: Any = None
        self._status: Any = None
        self._battery_level: int | None = None
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
        return [(event_id, data[: _records.MAX_DATA_BYTES]) for event_id, data in events if event_id in self._logged]

    def _translate(self, kind: str, message: Any, now: float, events: list[tuple[int, bytes]]) -> None:
        match kind:
            case "HEARTBEAT" if message.autopilot != self._no_autopilot:
                self._heartbeat(message, events)
            case "STATUSTEXT":
                self._status_text(message, events)
            case "GLOBAL_POSITION_INT":
                if message.time_boot_ms < self._vehicle_ms - _BOOTED_MS:
                    self._boot()
                self._vehicle_ms = message.time_boot_ms
                self._position(message, now, events)
            case "ATTITUDE":
                self._vehicle_ms = message.time_boot_ms
                self._attitude = message
            case "SYS_STATUS":
                self._status = message
                self._battery(message, events)
                self._failsafes(events)
            case "SYSTEM_TIME":
                self._vehicle_ms = message.time_boot_ms
                self._clock_us = message.time_unix_usec
            case "MISSION_CURRENT":
                self._heading_for = message.seq
            case "MISSION_ITEM_REACHED":
                self._waypoint(message.seq, events)

    def _boot(self) -> None:
        """It has been started again: nothing that it said of its place and its mission is true any more."""
        self._status = self._attitude = self._heading_for = self._ground = None
        self._nagged.clear()

    def _heartbeat(self, message: Any, events: list[tuple[int, bytes]]) -> None:
        mode, armed = message.custom_mode, bool(message.base_mode & self._armed_flag)
        if mode != self._mode:
            events.append(
                (_records.MODE_CHANGE, _records.MODE_CHANGE_DATA.pack(self._vehicle_ms, message.type, self._mode, mode))
            )
        if (mode, armed) != (self._mode, self._armed):
            self._nagged.clear()
        if armed != self._armed:
            events.append(
                (_records.ARMED if armed else _records.DISARMED, _records.ARMING_DATA.pack(self._vehicle_ms, mode))
            )
        self._mode, self._armed, self._state = mode, armed, message.system_status
        self._never_flies = message.type in _NEVER_FLIES
        self._failsafes(events)

    def _failsafes(self, events: list[tuple[int, bytes]]) -> None:
        critical, failed = self._state if self._state in _records.CRITICAL_STATES else 0, 0
        if self._status is not None and (self._armed or critical):
            unhealthy = self._status.onboard_control_sensors_enabled & ~self._status.onboard_control_sensors_health
            failed = unhealthy & sum(_records.SENSORS)
        if (critical, failed) != self._failsafe:
            self._failsafe = critical, failed
            events.append((_records.FAILSAFE, _records.FAILSAFE_DATA.pack(self._vehicle_ms, self._state, failed)))

    def _battery(self, message: Any, events: list[tuple[int, bytes]]) -> None:
        left = min(message.battery_remaining, 100)
        if left < 0:  # unknown
            return
        level = next(level for level in _BATTERY_LEVELS if left <= level)
        before = self._battery_level
        if before is None or level < before or left >= before + _CHARGED_PERCENT:
            self._battery_level = level
            battery = message.voltage_battery, message.current_battery, left
            events.append((_records.BATTERY, _records.BATTERY_DATA.pack(self._vehicle_ms, *battery)))

    def _status_text(self, message: Any, events: list[tuple[int, bytes]]) -> None:
        """MAVLink 2 sends a long text in chunks of 50 characters with the same ID; the last chunk is shorter."""
        key = (message.id, message.severity)
        if self._text and (key != self._text_key or message.chunk_seq == 0):
            self._end_text(events)  # its last chunk was lost
        self._text_key = key
        self._text = (self._text + message.text)[: _records.MAX_DATA_BYTES]
        if message.id == 0 or len(message.text) < _CHUNK_CHARS:
            self._end_text(events)

    def _end_text(self, events: list[tuple[int, bytes]]) -> None:
        text, self._text = self._text, ""
        if text in self._nagged:
            return
        if text.startswith(_NAGGING) and len(self._nagged) < _MOST_NAGGED:
            self._nagged.add(text)
        head = _records.STATUS_TEXT_DATA.pack(self._vehicle_ms, self._text_key[1])
        events.append((_records.STATUS_TEXT, head + text.encode()))

    def _waypoint(self, reached: int, events: list[tuple[int, bytes]]) -> None:
        """It has reached what it was heading for, of which ArduPilot 4.7 names the last command behind: a speed, say.

        Item 0 is home, where it is heading before its mission begins: nothing has been reached then.
        """
        item = reached if self._heading_for is None else min(self._heading_for, reached)
        self._heading_for = None
        if item or not reached:
            events.append((_records.WAYPOINT, _records.WAYPOINT_DATA.pack(self._vehicle_ms, item)))

    def _means_its_position(self) -> bool:
        """Whether it says that its estimate is good; firmware that says nothing of it is believed."""
        if self._status is None:
            return False
        says = self._status.onboard_control_sensors_present & self._estimate
        return not says or bool(self._status.onboard_control_sensors_health & self._estimate)

    def _position(self, message: Any, now: float, events: list[tuple[int, bytes]]) -> None:
        if not self._means_its_position() or (message.lat == 0 and message.lon == 0):  # no fix yet
            return
        if self._ground is None and self._mode != _records.UNKNOWN_MODE:
            self._ground = _Ground(message, stands=self._never_flies or not self._armed)
        if self._position_due is None:
            self._position_due = now + self._draw()
        if now < self._position_due:
            return
        self._position_due = now + self._draw()
        attitude, status = self._attitude, self._status
        position = Position(
            vehicle_ms=message.time_boot_ms,
            clock_us=self._clock_us,
            lat_e7=message.lat,
            lon_e7=message.lon,
            alt_mm=message.alt,
            relative_alt_mm=self._ground.height_mm(message) if self._ground else message.relative_alt,
            north_cms=message.vx,
            east_cms=message.vy,
            down_cms=message.vz,
            heading_cdeg=message.hdg,
            roll_rad=attitude.roll if attitude else math.nan,
            pitch_rad=attitude.pitch if attitude else math.nan,
            yaw_rad=attitude.yaw if attitude else math.nan,
            roll_mrads=_milli(attitude.rollspeed) if attitude else 0,
            pitch_mrads=_milli(attitude.pitchspeed) if attitude else 0,
            yaw_mrads=_milli(attitude.yawspeed) if attitude else 0,
            battery_mv=status.voltage_battery if status else _records.UNKNOWN_VOLTAGE,
            battery_ca=status.current_battery if status else -1,
            battery_percent=status.battery_remaining if status else -1,
            mode=self._mode,
            armed=self._armed,
        )
        events.append((_records.POSITION, position.pack()))

    def _draw(self) -> float:
        return self._position_interval_s * self._rng.uniform(0.5, 1.5)


class _Ground:
    """What a vehicle's height above its home is off by, since its first good position.

    A rover of ArduPilot 4.7 sets its home before it knows its altitude, and is 584 m above it ever after.
    """

    def __init__(self, message: Any, stands: bool) -> None:
        """`stands`: it is on the ground, as high as its home, as it has not been armed or cannot fly."""
        self._home_mm = message.alt - message.relative_alt
        self._error_mm = message.relative_alt if stands and abs(message.relative_alt) > _HOME_OFF_MM else 0

    def height_mm(self, message: Any) -> int:
        """Above its home: as it says, once its home has been set to another altitude."""
        moved_mm = abs(message.alt - message.relative_alt - self._home_mm)
        height_mm = message.relative_alt - (self._error_mm if moved_mm <= _HOME_MOVED_MM else 0)
        return int(max(-(2**31), min(2**31 - 1, height_mm)))


def _milli(value: float) -> int:
    """Thousandths in a signed 16-bit number; what does not fit, or is no number, is at the limit, or 0."""
    return 0 if math.isnan(value) else round(max(-32.768, min(32.767, value)) * 1000)
