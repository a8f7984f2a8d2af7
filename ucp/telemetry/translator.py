"""MAVLink in, loggable events out; no I/O and no clock."""

from __future__ import annotations

import math
import random
from collections.abc import Iterable
from typing import Any

from ucp.events import DEFAULT_LOG, EventKind
from ucp.telemetry import records
from ucp.telemetry.records import Position

_AUTOPILOT_COMPONENT = 1  # MAV_COMP_ID_AUTOPILOT1
_CHUNK_CHARS = 50  # STATUSTEXT: a full text is followed by more when it has an ID
_BATTERY_LEVELS = (0, 5, 10, 15, *range(20, 101, 10))  # percent
_CHARGED_PERCENT = 10  # a battery that has so much more than at the last level was charged or changed


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
        self._logged = frozenset(event_id for kind in log for event_id in records.EVENT_KINDS[kind])
        self._parser = common.MAVLink(None)
        self._parser.robust_parsing = True  # garbage is reported as BAD_DATA, not raised
        self._armed_flag: int = common.MAV_MODE_FLAG_SAFETY_ARMED
        self._no_autopilot: int = common.MAV_AUTOPILOT_INVALID
        self._position_due: float | None = None
        self._vehicle_ms = 0
        self._mode = records.UNKNOWN_MODE
        self._armed = False
        self._state = 0  # MAV_STATE_UNINIT
        self._failsafe = (0, 0)  # MAV_STATE if critical, what failed: as last logged
        self._text = ""
        self._text_key = (0, 0)  # ID and severity of the text that is being collected
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
        return [(event_id, data[: records.MAX_DATA_BYTES]) for event_id, data in events if event_id in self._logged]

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
                self._battery(message, events)
                self._failsafes(events)
            case "SYSTEM_TIME":
                self._vehicle_ms = message.time_boot_ms
                self._clock_us = message.time_unix_usec
            case "MISSION_ITEM_REACHED":
                events.append((records.WAYPOINT, records.WAYPOINT_DATA.pack(self._vehicle_ms, message.seq)))

    def _heartbeat(self, message: Any, events: list[tuple[int, bytes]]) -> None:
        mode, armed = message.custom_mode, bool(message.base_mode & self._armed_flag)
        if mode != self._mode:
            events.append(
                (records.MODE_CHANGE, records.MODE_CHANGE_DATA.pack(self._vehicle_ms, message.type, self._mode, mode))
            )
        if armed != self._armed:
            events.append(
                (records.ARMED if armed else records.DISARMED, records.ARMING_DATA.pack(self._vehicle_ms, mode))
            )
        self._mode, self._armed, self._state = mode, armed, message.system_status
        self._failsafes(events)

    def _failsafes(self, events: list[tuple[int, bytes]]) -> None:
        critical, failed = self._state if self._state in records.CRITICAL_STATES else 0, 0
        if self._status is not None and (self._armed or critical):
            unhealthy = self._status.onboard_control_sensors_enabled & ~self._status.onboard_control_sensors_health
            failed = unhealthy & sum(records.SENSORS)
        if (critical, failed) != self._failsafe:
            self._failsafe = critical, failed
            events.append((records.FAILSAFE, records.FAILSAFE_DATA.pack(self._vehicle_ms, self._state, failed)))

    def _battery(self, message: Any, events: list[tuple[int, bytes]]) -> None:
        left = min(message.battery_remaining, 100)
        if left < 0:  # unknown
            return
        level = next(level for level in _BATTERY_LEVELS if left <= level)
        before = self._battery_level
        if before is None or level < before or left >= before + _CHARGED_PERCENT:
            self._battery_level = level
            battery = message.voltage_battery, message.current_battery, left
            events.append((records.BATTERY, records.BATTERY_DATA.pack(self._vehicle_ms, *battery)))

    def _status_text(self, message: Any, events: list[tuple[int, bytes]]) -> None:
        """MAVLink 2 sends a long text in chunks of 50 characters with the same ID; the last chunk is shorter."""
        key = (message.id, message.severity)
        if self._text and (key != self._text_key or message.chunk_seq == 0):
            self._end_text(events)  # its last chunk was lost
        self._text_key = key
        self._text = (self._text + message.text)[: records.MAX_DATA_BYTES]
        if message.id == 0 or len(message.text) < _CHUNK_CHARS:
            self._end_text(events)

    def _end_text(self, events: list[tuple[int, bytes]]) -> None:
        head = records.STATUS_TEXT_DATA.pack(self._vehicle_ms, self._text_key[1])
        events.append((records.STATUS_TEXT, head + self._text.encode()))
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
        position = Position(
            vehicle_ms=message.time_boot_ms,
            clock_us=self._clock_us,
            lat_e7=message.lat,
            lon_e7=message.lon,
            alt_mm=message.alt,
            relative_alt_mm=message.relative_alt,
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
            battery_mv=status.voltage_battery if status else records.UNKNOWN_VOLTAGE,
            battery_ca=status.current_battery if status else -1,
            battery_percent=status.battery_remaining if status else -1,
            mode=self._mode,
            armed=self._armed,
        )
        events.append((records.POSITION, position.pack()))

    def _draw(self) -> float:
        return self._position_interval_s * self._rng.uniform(0.5, 1.5)


def _milli(value: float) -> int:
    """Thousandths in a signed 16-bit number; what does not fit, or is no number, is at the limit, or 0."""
    return 0 if math.isnan(value) else round(max(-32.768, min(32.767, value)) * 1000)
