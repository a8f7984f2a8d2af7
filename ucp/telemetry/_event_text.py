"""Describe the data of `mavlink` events as text."""

import math
import struct

from ucp.telemetry import _records
from ucp.telemetry._mode_names import mode_name
from ucp.telemetry._records import Position

_SEVERITIES = ("emergency", "alert", "critical", "error", "warning", "notice", "info", "debug")  # MAV_SEVERITY
_STATES = (  # MAV_STATE
    *("uninitialised", "booting", "calibrating", "standby", "active"),
    *("critical", "emergency", "power off", "flight termination"),
)


def vehicle_type(event_id: int, data: bytes) -> int | None:
    """Return the vehicle type (MAV_TYPE) in a telemetry event. Return None if the event contains none."""
    if event_id != _records.MODE_CHANGE or len(data) != _records.MODE_CHANGE_DATA.size:
        return None
    kind: int = _records.MODE_CHANGE_DATA.unpack(data)[1]
    return kind


def describe(event_id: int, data: bytes, of_type: int | None = None) -> str:
    """Return a description of a `mavlink` event. For any other data, return 'unreadable'.

    `of_type` is the MAV_TYPE of the vehicle. Without it, some descriptions contain the number of a mode instead of its
    name.
    """
    try:
        match event_id:
            case _records.MODE_CHANGE:
                ms, kind, before, mode = _records.MODE_CHANGE_DATA.unpack(data)
                change = "" if before == _records.UNKNOWN_MODE else f" (was {mode_name(before, kind)})"
                return f"{_time_prefix(ms)} mode {mode_name(mode, kind)}{change}"
            case _records.ARMED | _records.DISARMED:
                ms, mode = _records.ARMING_DATA.unpack(data)
                change = "armed" if event_id == _records.ARMED else "disarmed"
                return f"{_time_prefix(ms)} {change} in mode {_mode(mode, of_type)}"
            case _records.STATUS_TEXT:
                ms, severity = _records.STATUS_TEXT_DATA.unpack_from(data)
                text = data[_records.STATUS_TEXT_DATA.size :].decode(errors="replace")
                printable = "".join(char if char.isprintable() else "?" for char in text)
                return f"{_time_prefix(ms)} {_SEVERITIES[severity]}: {printable}"
            case _records.POSITION:
                return _position(Position.unpack(data), of_type)
            case _records.WAYPOINT:
                ms, item = _records.WAYPOINT_DATA.unpack(data)
                return f"{_time_prefix(ms)} reached mission item {item}"
            case _records.FAILSAFE:
                return _failsafe(*_records.FAILSAFE_DATA.unpack(data))
            case _records.BATTERY:
                ms, millivolt, centiampere, left = _records.BATTERY_DATA.unpack(data)
                volts = "" if millivolt == _records.UNKNOWN_VOLTAGE else f", {millivolt / 1e3:.1f} V"
                amperes = "" if centiampere == -1 else f", {centiampere / 100:.1f} A"
                return f"{_time_prefix(ms)} battery {left} %{volts}{amperes}"
    except (struct.error, IndexError):
        pass
    return "unreadable"


def _mode(mode: int, of_type: int | None) -> str:
    return str(mode) if of_type is None else mode_name(mode, of_type)


def _position(position: Position, of_type: int | None) -> str:
    parts = [
        f"{_time_prefix(position.vehicle_ms)} at {position.lat_e7 / 1e7:.7f} {position.lon_e7 / 1e7:.7f}",
        f"{position.alt_mm / 1e3:.1f} m",
        f"{position.relative_alt_mm / 1e3:.1f} m above home",
        f"{math.hypot(position.north_cms, position.east_cms) / 100:.1f} m/s",
        f"climb {-position.down_cms / 100:.1f} m/s",
    ]
    if position.heading_cdeg != _records.UNKNOWN_HEADING:
        parts.append(f"heading {position.heading_cdeg / 100:.0f}")
    if position.battery_mv != _records.UNKNOWN_VOLTAGE:
        left = f" {position.battery_percent} %" if position.battery_percent >= 0 else ""
        parts.append(f"battery {position.battery_mv / 1e3:.1f} V{left}")
    parts.append(f"mode {_mode(position.mode, of_type)}" + (" armed" if position.armed else ""))
    return ", ".join(parts)


def _failsafe(ms: int, state: int, failed: int) -> str:
    name = _STATES[state]
    if state not in _records.CRITICAL_STATES and not failed:
        return f"{_time_prefix(ms)} failsafe over, {name}"
    sensors = [word for bit, word in _records.SENSORS.items() if failed & bit]
    return f"{_time_prefix(ms)} failsafe, {name}" + (f": {', '.join(sensors)}" if sensors else "")


def _time_prefix(vehicle_ms: int) -> str:
    return f"[{vehicle_ms / 1e3:.1f} s]"
