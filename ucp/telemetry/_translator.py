"""Convert a MAVLink byte stream to loggable events, without I/O and without a clock."""

from __future__ import annotations

import math
import random
from collections.abc import Iterable
from typing import Any

from ucp.events import DEFAULT_LOG, EventKind
from ucp.telemetry import _records
from ucp.telemetry._records import Position

_AUTOPILOT_COMPONENT = 1  # MAV_COMP_ID_AUTOPILOT1
_CHUNK_CHARS = 50  # length of a STATUSTEXT chunk; a full chunk with an ID is followed by another one
_BATTERY_LEVELS = (0, 5, 10, 15, *range(20, 101, 10))  # percent
_CHARGED_PERCENT = 10  # a battery this much above its last level was charged or changed
_PREARM_PREFIX = "PreArm: "  # prefix of the texts that ArduPilot repeats every 30 s while it cannot be armed
_MAX_PREARM_TEXTS = 100
_REBOOT_MS = 1_000  # if the vehicle's clock goes back by more than this, the vehicle has rebooted
_HOME_ERROR_MM = 10_000  # a vehicle on the ground this far from its home altitude has a wrong home altitude
_HOME_MOVED_MM = 1_000  # a change of the home altitude by more than this is a new home
_CANNOT_FLY = frozenset({10, 11})  # MAV_TYPE_GROUND_ROVER, MAV_TYPE_SURFACE_BOAT


class TelemetryEvents:
    """A converter from the MAVLink byte stream of one vehicle to events.

    `garbage` counts the unreadable parts of the stream.
    """

    def __init__(self, position_interval_s: float, rng: random.Random, log: Iterable[EventKind] = DEFAULT_LOG) -> None:
        """Create the converter. At first, no flight mode and no position are known.

        `position_interval_s` is the mean time between two position events in mission seconds. Each interval is a random
        time from 0.5 to 1.5 times the mean, drawn from `rng`. If all intervals were equal, all vehicles would complete
        their blocks at the same moment, unlike real swarms. `log` lists the kinds of events to log.
        """
        from pymavlink.dialects.v20 import common  # an agent without a vehicle need not load it

        self.garbage = 0
        self._position_interval_s = position_interval_s
        self._rng = rng
        self._logged = frozenset(event_id for kind in log for event_id in _records.EVENT_KINDS[kind])
        self._parser = common.MAVLink(None)
        self._parser.robust_parsing = True  # the parser returns BAD_DATA instead of raising an error
        self._armed_flag: int = common.MAV_MODE_FLAG_SAFETY_ARMED
        self._no_autopilot: int = common.MAV_AUTOPILOT_INVALID
        self._estimate_bit: int = common.MAV_SYS_STATUS_AHRS
        self._position_due: float | None = None
        self._vehicle_ms = 0
        self._mode = _records.UNKNOWN_MODE
        self._armed = self._cannot_fly = False
        self._state = 0  # MAV_STATE_UNINIT
        self._failsafe = (0, 0)  # the last logged failsafe: MAV_STATE if critical, failed sensors
        self._text = ""
        self._text_key = (0, 0)  # ID and severity of the text whose chunks are being collected
        self._logged_prearm: set[str] = set()  # PreArm texts logged since the last change of mode or arming
        self._next_item: int | None = None  # number of MISSION_CURRENT, if received since the last item was reached
        self._home_error: _HomeError | None = None
        self._attitude: Any = None
        self._status: Any = None
        self._battery_level: int | None = None
        self._clock_us = 0

    def receive(self, data: bytes, now: float) -> list[tuple[int, bytes]]:
        """Return the events in the next bytes from the vehicle. A message may be split over several calls.

        `now` is the mission second, and never decreases. Malformed bytes are counted and raise nothing.
        """
        events: list[tuple[int, bytes]] = []
        for message in self._parser.parse_buffer(data) or ():
            kind = message.get_type()
            if kind == "BAD_DATA":
                self.garbage += 1
            elif message.get_srcComponent() == _AUTOPILOT_COMPONENT:
                self._translate(kind, message, now, events)
        # the parser frees its buffer only if the bytes end with a complete message
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
                if message.time_boot_ms < self._vehicle_ms - _REBOOT_MS:
                    self._reset_after_reboot()
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
                self._next_item = message.seq
            case "MISSION_ITEM_REACHED":
                self._waypoint(message.seq, events)

    def _reset_after_reboot(self) -> None:
        """Forget the position, estimate and mission item of the vehicle after it has rebooted."""
        self._status = self._attitude = self._next_item = self._home_error = None
        self._logged_prearm.clear()

    def _heartbeat(self, message: Any, events: list[tuple[int, bytes]]) -> None:
        mode, armed = message.custom_mode, bool(message.base_mode & self._armed_flag)
        if mode != self._mode:
            events.append(
                (_records.MODE_CHANGE, _records.MODE_CHANGE_DATA.pack(self._vehicle_ms, message.type, self._mode, mode))
            )
        if (mode, armed) != (self._mode, self._armed):
            self._logged_prearm.clear()
        if armed != self._armed:
            events.append(
                (_records.ARMED if armed else _records.DISARMED, _records.ARMING_DATA.pack(self._vehicle_ms, mode))
            )
        self._mode, self._armed, self._state = mode, armed, message.system_status
        self._cannot_fly = message.type in _CANNOT_FLY
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
        """Collect the parts of a text message. MAVLink 2 sends long texts in parts of 50 characters with the same ID.

        A part with fewer than 50 characters is the last part of the text.
        """
        key = (message.id, message.severity)
        if self._text and (key != self._text_key or message.chunk_seq == 0):
            self._end_text(events)  # its last chunk was lost
        self._text_key = key
        self._text = (self._text + message.text)[: _records.MAX_DATA_BYTES]
        if message.id == 0 or len(message.text) < _CHUNK_CHARS:
            self._end_text(events)

    def _end_text(self, events: list[tuple[int, bytes]]) -> None:
        text, self._text = self._text, ""
        if text in self._logged_prearm:
            return
        if text.startswith(_PREARM_PREFIX) and len(self._logged_prearm) < _MAX_PREARM_TEXTS:
            self._logged_prearm.add(text)
        head = _records.STATUS_TEXT_DATA.pack(self._vehicle_ms, self._text_key[1])
        events.append((_records.STATUS_TEXT, head + text.encode()))

    def _waypoint(self, reached: int, events: list[tuple[int, bytes]]) -> None:
        """Add an event: the vehicle reached an item of its mission.

        ArduPilot 4.7 reports the last command after the reached waypoint, for example a change of speed. The event
        therefore has the number of the current item in MISSION_CURRENT if this number is lower. Item 0 is home. If the
        current item is 0, the mission has not begun, and the vehicle has reached no item.
        """
        item = reached if self._next_item is None else min(self._next_item, reached)
        self._next_item = None
        if item or not reached:
            events.append((_records.WAYPOINT, _records.WAYPOINT_DATA.pack(self._vehicle_ms, item)))

    def _estimate_is_good(self) -> bool:
        """Return true if the vehicle reports a good position estimate. Return true if the firmware does not report the
        quality of its estimate.
        """
        if self._status is None:
            return False
        reported = self._status.onboard_control_sensors_present & self._estimate_bit
        return not reported or bool(self._status.onboard_control_sensors_health & self._estimate_bit)

    def _position(self, message: Any, now: float, events: list[tuple[int, bytes]]) -> None:
        if not self._estimate_is_good() or (message.lat == 0 and message.lon == 0):  # no fix yet
            return
        if self._home_error is None and self._mode != _records.UNKNOWN_MODE:
            self._home_error = _HomeError(message, on_ground=self._cannot_fly or not self._armed)
        if self._position_due is None:
            self._position_due = now + self._draw_interval()
        if now < self._position_due:
            return
        self._position_due = now + self._draw_interval()
        attitude, status = self._attitude, self._status
        position = Position(
            vehicle_ms=message.time_boot_ms,
            clock_us=self._clock_us,
            lat_e7=message.lat,
            lon_e7=message.lon,
            alt_mm=message.alt,
            relative_alt_mm=self._home_error.height_mm(message) if self._home_error else message.relative_alt,
            north_cms=message.vx,
            east_cms=message.vy,
            down_cms=message.vz,
            heading_cdeg=message.hdg,
            roll_rad=attitude.roll if attitude else math.nan,
            pitch_rad=attitude.pitch if attitude else math.nan,
            yaw_rad=attitude.yaw if attitude else math.nan,
            roll_mrads=_thousandths(attitude.rollspeed) if attitude else 0,
            pitch_mrads=_thousandths(attitude.pitchspeed) if attitude else 0,
            yaw_mrads=_thousandths(attitude.yawspeed) if attitude else 0,
            battery_mv=status.voltage_battery if status else _records.UNKNOWN_VOLTAGE,
            battery_ca=status.current_battery if status else -1,
            battery_percent=status.battery_remaining if status else -1,
            mode=self._mode,
            armed=self._armed,
        )
        events.append((_records.POSITION, position.pack()))

    def _draw_interval(self) -> float:
        return self._position_interval_s * self._rng.uniform(0.5, 1.5)


class _HomeError:
    """The error of the height above home in a vehicle's positions. The error is computed from the first good position.

    A rover of ArduPilot 4.7 sets its home before it knows its altitude, and afterwards reports a height of 584 m above
    home.
    """

    def __init__(self, message: Any, on_ground: bool) -> None:
        """Compute the error from this position. `on_ground` is true if the vehicle is not armed or cannot fly."""
        self._home_mm = message.alt - message.relative_alt
        self._error_mm = message.relative_alt if on_ground and abs(message.relative_alt) > _HOME_ERROR_MM else 0

    def height_mm(self, message: Any) -> int:
        """Return the corrected height above home in millimetres. The correction ends when the vehicle changes its home
        altitude.
        """
        moved_mm = abs(message.alt - message.relative_alt - self._home_mm)
        height_mm = message.relative_alt - (self._error_mm if moved_mm <= _HOME_MOVED_MM else 0)
        return int(max(-(2**31), min(2**31 - 1, height_mm)))


def _thousandths(value: float) -> int:
    """Return the value times 1000 as a signed 16-bit number. A value out of range becomes the nearest number in range.
    NaN becomes 0.
    """
    return 0 if math.isnan(value) else round(max(-32.768, min(32.767, value)) * 1000)
