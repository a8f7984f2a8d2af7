"""Read telemetry logs. They contain MAVLink frames of version 1 or 2, each preceded by the time of its arrival.

The time is a big-endian u64 in microseconds since the Unix epoch. A frame of a known message is used only if its
checksum is correct. A frame of an unknown message counts if a frame or the end of the file follows it.

The reader decodes frames of the autopilot (component 1) of each system, and RADIO_STATUS of any system. Only the
messages in `_HANDLERS` are decoded.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any, BinaryIO

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from harness.field.flight_logs._collecting import (
    DamagedBytes,
    LogClock,
    RecordBudget,
    RecordCollector,
    gps_time_from_utc,
    is_place,
)
from harness.field.flight_logs._records import (
    ArmingChange,
    Battery,
    EkfStatus,
    GpsStatus,
    ModeChange,
    Parameter,
    Position,
    RadioStatus,
)

MAX_MESSAGES = 10_000_000
"""Maximum number of messages that are read from a file. Ten vehicles send this number in about two hours."""
_CHUNK_BYTES = 1024 * 1024
_STAMP_BYTES = 8
_V1, _V2 = 0xFE, 0xFD
_SIGNED = 0x01
_MAX_FRAME_BYTES = 300
_AUTOPILOT_COMPONENT = 1
_UNKNOWN_U16 = 65535

Values = dict[str, Any]


class SystemLog:
    """The records of one sender (MAVLink system) in a telemetry log."""

    def __init__(self, budget: RecordBudget) -> None:
        self.collector = RecordCollector(budget)
        self.mav_type: int | None = None
        self.is_vehicle = False


class TelemetryReader:
    """A reader for one telemetry log. The method `read` stores the records in collectors."""

    def __init__(self) -> None:
        self.budget = RecordBudget()
        self.systems: dict[int, SystemLog] = {}
        self.radio = RecordCollector(self.budget)
        self.clock = LogClock()
        self.damage = DamagedBytes()
        self.problems: list[str] = []
        self._jumps = 0

    def read(self, stream: BinaryIO) -> None:
        """Read the whole telemetry log."""
        for at_us, system_id, component, message, payload in self._frames(stream):
            handler = _HANDLERS.get(message)
            is_radio = message == mavlink.MAVLINK_MSG_ID_RADIO_STATUS
            if (handler is None and not is_radio) or not self.clock.accepts(at_us):
                continue
            if len(self.clock.jumps) != self._jumps:
                self._jumps = len(self.clock.jumps)
                self._end_segment()
            if handler is None:
                self._radio(at_us, _values(message, payload))
            elif component == _AUTOPILOT_COMPONENT and system_id != 0:
                system = self.systems.get(system_id)
                if system is None:
                    system = self.systems[system_id] = SystemLog(self.budget)
                handler(self, system, at_us, _values(message, payload))
        self._end_segment()

    def _end_segment(self) -> None:
        self.radio.end_segment()
        for system in self.systems.values():
            system.collector.end_segment()

    def _frames(self, stream: BinaryIO) -> Iterator[tuple[int, int, int, int, bytes]]:
        """Yield the time, system ID, component ID, message ID and payload of each frame."""
        buffer, at, offset, at_end, messages = b"", 0, 0, False, 0
        while True:
            if len(buffer) - at < 2 * _MAX_FRAME_BYTES and not at_end:
                chunk = stream.read(_CHUNK_BYTES)
                at_end = not chunk
                offset += at
                buffer, at = buffer[at:] + chunk, 0
                if not at_end:
                    continue
            if at == len(buffer):
                return
            start = at + _STAMP_BYTES
            if (frame := _frame_at(buffer, start)) is None:
                after = _next_start(buffer, at)
                self.damage.skip(offset + at, after - at)
                at = after
                if self.damage.ends_reading(offset + at):
                    return
                continue
            messages += 1
            if messages > MAX_MESSAGES:
                self.problems.append(f"only the first {MAX_MESSAGES:,} messages are read")
                return
            after, system_id, component, message, payload = frame
            yield int.from_bytes(buffer[at:start], "big"), system_id, component, message, payload
            at = after

    def _radio(self, at_us: int, values: Values) -> None:
        self.radio.add(
            RadioStatus(
                at_us,
                None,
                values["rssi"],
                values["remrssi"],
                values["noise"],
                values["remnoise"],
                values["txbuf"],
                values["rxerrors"],
                values["fixed"],
            )
        )

    def _heartbeat(self, system: SystemLog, at_us: int, values: Values) -> None:
        if values["autopilot"] == mavlink.MAV_AUTOPILOT_INVALID or values["type"] == mavlink.MAV_TYPE_GCS:
            return
        system.is_vehicle, system.mav_type = True, values["type"]
        mode, armed = values["custom_mode"], bool(values["base_mode"] & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        system.collector.add_change(ModeChange(at_us, None, mode, str(mode)), mode)
        system.collector.add_change(ArmingChange(at_us, None, armed), armed)

    def _system_status(self, system: SystemLog, at_us: int, values: Values) -> None:
        voltage_mv, current_ca, remaining = (
            values["voltage_battery"],
            values["current_battery"],
            values["battery_remaining"],
        )
        if voltage_mv != _UNKNOWN_U16:
            system.collector.add_sample(
                Battery(
                    at_us,
                    None,
                    0,
                    voltage_mv / 1000,
                    current_ca / 100 if current_ca >= 0 else None,
                    float(remaining) if remaining >= 0 else None,
                ),
                0,
            )

    def _system_time(self, system: SystemLog, at_us: int, values: Values) -> None:
        if (time := gps_time_from_utc(at_us, values["time_unix_usec"])) is not None and (
            system.collector.add_gps_time(time)
        ):
            self.radio.use_gps_time(time)

    def _parameter(self, system: SystemLog, at_us: int, values: Values) -> None:
        name = values["param_id"].split(b"\0", 1)[0].decode("ascii", "replace")
        if name.isprintable() and math.isfinite(values["param_value"]):
            system.collector.add(Parameter(at_us, None, name, values["param_value"]))
        else:
            self.damage.unusable += 1

    def _gps(self, system: SystemLog, at_us: int, values: Values) -> None:
        hdop = values["eph"] / 100 if values["eph"] != _UNKNOWN_U16 else None
        fix = values["fix_type"]
        system.collector.add_sample(GpsStatus(at_us, None, 0, fix, values["satellites_visible"], hdop), 0, fix)

    def _position(self, system: SystemLog, at_us: int, values: Values) -> None:
        lat_deg, lon_deg, alt_m = values["lat"] / 1e7, values["lon"] / 1e7, values["alt"] / 1000
        if is_place(lat_deg, lon_deg, alt_m):
            system.is_vehicle = True
            system.collector.add(Position(at_us, None, lat_deg, lon_deg, alt_m, values["relative_alt"] / 1000))

    def _ekf(self, system: SystemLog, at_us: int, values: Values) -> None:
        flags = values["flags"]
        variances = (
            values["velocity_variance"],
            values["pos_horiz_variance"],
            values["pos_vert_variance"],
            values["compass_variance"],
        )
        system.collector.add_sample(EkfStatus(at_us, None, flags, *variances), "EKF", flags)


_HANDLERS: dict[int, Callable[[TelemetryReader, SystemLog, int, Values], None]] = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: TelemetryReader._heartbeat,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: TelemetryReader._system_status,
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: TelemetryReader._system_time,
    mavlink.MAVLINK_MSG_ID_PARAM_VALUE: TelemetryReader._parameter,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: TelemetryReader._gps,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: TelemetryReader._position,
    mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT: TelemetryReader._ekf,
}


def begins_with_frame(beginning: bytes) -> bool:
    """Return true if the bytes begin with a time and a frame of a known type with the right checksum."""
    return (frame := _frame_at(beginning, _STAMP_BYTES)) is not None and frame[3] in mavlink.mavlink_map


def _values(message: int, payload: bytes) -> Values:
    """Decode a payload. MAVLink 2 omits zero bytes at the end, and MAVLink 1 has no extension fields."""
    definition = mavlink.mavlink_map[message]
    size = definition.unpacker.size
    return dict(
        zip(definition.ordered_fieldnames, definition.unpacker.unpack(payload[:size].ljust(size, b"\0")), strict=True)
    )


def _frame_at(buffer: bytes, at: int) -> tuple[int, int, int, int, bytes] | None:
    """Return the end, system ID, component ID, message ID and payload of the frame at a position. Return None if no
    frame begins there.
    """
    if len(buffer) < at + _STAMP_BYTES:
        return None
    length = buffer[at + 1]
    if buffer[at] == _V2:
        header, message = 10, int.from_bytes(buffer[at + 7 : at + 10], "little")
        end = at + header + length + 2 + (13 if buffer[at + 2] & _SIGNED else 0)
        system_id, component = buffer[at + 5], buffer[at + 6]
    elif buffer[at] == _V1:
        header, message = 6, buffer[at + 5]
        end = at + header + length + 2
        system_id, component = buffer[at + 3], buffer[at + 4]
    else:
        return None
    if end > len(buffer):
        return None
    checked = at + header + length
    if (definition := mavlink.mavlink_map.get(message)) is not None:
        crc = mavlink.x25crc(buffer[at + 1 : checked])
        crc.accumulate(bytes([definition.crc_extra]))
        if crc.crc != int.from_bytes(buffer[checked : checked + 2], "little"):
            return None
    elif end < len(buffer) and (end + _STAMP_BYTES >= len(buffer) or buffer[end + _STAMP_BYTES] not in (_V1, _V2)):
        return None
    return end, system_id, component, message, buffer[at + header : checked]


def _next_start(buffer: bytes, at: int) -> int:
    """Return the next position in the log at which a time and a frame may begin."""
    first = at + 1 + _STAMP_BYTES
    found = [position for magic in (b"\xfd", b"\xfe") if (position := buffer.find(magic, first)) >= 0]
    return min(found) - _STAMP_BYTES if found else max(len(buffer) - _STAMP_BYTES, at + 1)
