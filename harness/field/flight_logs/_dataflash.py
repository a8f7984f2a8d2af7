"""Read DataFlash, the binary log that ArduPilot writes on the vehicle.

Each message begins with A3 95 and the number of its type. Messages of type FMT define the other types: name, length,
types and names of the columns. Messages have no checksum. A message is therefore used only if another message or the
end of the file follows it directly. The values in a message must have plausible ranges.

Only the messages in `_HANDLERS` are decoded. The others are skipped by their length.
"""

import math
import struct
from collections.abc import Callable, Iterator
from typing import Any, BinaryIO, NamedTuple

from harness.field.flight_logs._collecting import (
    DamagedBytes,
    LogClock,
    RecordBudget,
    RecordCollector,
    gps_time_from_week,
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

MAGIC = b"\xa3\x95"
FMT = 128
MAX_MESSAGES = 30_000_000
"""Maximum number of messages that are read from a file. A flight of about seven hours produces this number."""
_FMT_BYTES = 89
_MAX_DEFINITIONS = 4096
_CHUNK_BYTES = 1024 * 1024
_HEADER_BYTES = 3
_FMT_FIELDS = struct.Struct("<BB4s16s64s")
_COLUMN_TYPES: dict[str, tuple[str, float | None]] = {
    **{code: (code, None) for code in "bBhHiIfdqQ"},
    **{"a": ("64s", None), "g": ("e", None), "n": ("4s", None), "N": ("16s", None), "Z": ("64s", None)},
    **{"c": ("h", 100), "C": ("H", 100), "e": ("i", 100), "E": ("I", 100), "L": ("i", 1e7), "M": ("b", None)},
}
"""The meaning of each column type in FMT messages, by the code of the type. The meaning consists of the type code of
Python's `struct`, and the number by which a stored value is divided.
"""
_VEHICLE_PARAMETERS = ("MAV_SYSID", "SYSID_THISMAV")
_EVENT_ARMED, _EVENT_DISARMED = 10, 11
_FAILSAFES = {
    3: "radio failsafe",
    4: "battery failsafe",
    5: "ground station failsafe",
    6: "EKF failsafe",
    7: "GPS glitch",
    10: "fence breached",
    11: "terrain failsafe",
    17: "termination",
    19: "crash failsafe",
    25: "failsafe",
    29: "leak failsafe",
    50: "dead reckoning failsafe",
    51: "takeoff failsafe",
}
"""The description of each failsafe, by the number of ArduPilot's ModeReason (libraries/AP_Vehicle/ModeReason.h). A
rover has the general reason 25 if it lost its radio or its ground station.
"""
_FIRMWARE = {"ArduPlane": 1, "ArduCopter": 2, "ArduRover": 10, "Rover": 10}
"""The type of the vehicle (MAV_TYPE), by the first word of the text about the firmware."""

Values = dict[str, Any]


class _MessageDefinition(NamedTuple):
    name: str
    columns: list[str]
    layout: struct.Struct
    divisors: list[float | None]

    def values(self, buffer: bytes, at: int) -> Values:
        read = self.layout.unpack_from(buffer, at)
        return {
            column: value if divisor is None else value / divisor
            for column, value, divisor in zip(self.columns, read, self.divisors, strict=True)
        }


class DataFlashReader:
    """A reader for one DataFlash file. The method `read` stores the records in collectors."""

    def __init__(self) -> None:
        budget = RecordBudget()
        self.budget = budget
        self.vehicle = RecordCollector(budget)
        self.gps_positions = RecordCollector(budget)
        """Positions of the GPS receiver, which are used if the log contains no estimated positions."""
        self.clock = LogClock()
        self.damage = DamagedBytes()
        self.vehicle_id: int | None = None
        self.mav_type: int | None = None
        self.problems: list[str] = []
        self._jumps = 0
        self._primary_core: int | None = None

    def read(self, stream: BinaryIO) -> None:
        """Read the whole DataFlash file."""
        for definition, buffer, at in self._messages(stream):
            values = definition.values(buffer, at)
            at_us = values.get("TimeUS")
            if not isinstance(at_us, int) or not self.clock.accepts(at_us):
                continue
            if len(self.clock.jumps) != self._jumps:
                self._jumps = len(self.clock.jumps)
                self._end_segment()
            # A message of another firmware may lack a column or have it with another type.
            try:
                _HANDLERS[definition.name](self, at_us, values)
            except (KeyError, TypeError, ValueError, OverflowError):
                self.damage.unusable += 1
        self._end_segment()

    def _end_segment(self) -> None:
        self.vehicle.end_segment()
        self.gps_positions.end_segment()

    def _messages(self, stream: BinaryIO) -> Iterator[tuple[_MessageDefinition, bytes, int]]:
        """Yield the messages to decode. For each message, yield its definition, the buffer, and the position of its
        first column.
        """
        lengths = [0] * 256
        lengths[FMT] = _FMT_BYTES
        definitions: dict[int, _MessageDefinition] = {}
        defined = messages = 0
        buffer, at, offset, at_end = b"", 0, 0, False
        while True:
            if len(buffer) - at < 512 and not at_end:
                chunk = stream.read(_CHUNK_BYTES)
                at_end = not chunk
                offset += at
                buffer, at = buffer[at:] + chunk, 0
            size = len(buffer)
            if size - at < _HEADER_BYTES:
                if not at_end:
                    continue
                if size > at:
                    self.damage.skip(offset + at, size - at)
                return
            kind = buffer[at + 2]
            after = at + lengths[kind]
            if (
                buffer[at] != 0xA3
                or buffer[at + 1] != 0x95
                or after == at
                or after > size
                or buffer[after : after + 2] not in (MAGIC, MAGIC[: size - after] if at_end else MAGIC)
            ):
                found = buffer.find(MAGIC, at + 1)
                after = found if found >= 0 else max(size - 1, at + 1)
                self.damage.skip(offset + at, after - at)
                at = after
                if self.damage.ends_reading(offset + at):
                    return
                continue
            messages += 1
            if messages > MAX_MESSAGES:
                self.problems.append(f"only the first {MAX_MESSAGES:,} messages are read")
                return
            if kind == FMT:
                defined += 1
                if defined <= _MAX_DEFINITIONS:
                    self._define(buffer, at + _HEADER_BYTES, lengths, definitions)
            elif (definition := definitions.get(kind)) is not None:
                yield definition, buffer, at + _HEADER_BYTES
            at = after

    def _define(self, buffer: bytes, at: int, lengths: list[int], definitions: dict[int, _MessageDefinition]) -> None:
        kind, length, name_bytes, codes_bytes, columns_bytes = _FMT_FIELDS.unpack_from(buffer, at)
        if kind == FMT or length < _HEADER_BYTES:
            return
        lengths[kind] = length
        definitions.pop(kind, None)
        name, codes = _text(name_bytes), _text(codes_bytes)
        columns = _text(columns_bytes).split(",")
        if name not in _HANDLERS or len(columns) != len(codes) or not all(code in _COLUMN_TYPES for code in codes):
            return
        layout = struct.Struct("<" + "".join(_COLUMN_TYPES[code][0] for code in codes))
        if layout.size + _HEADER_BYTES == length:
            definitions[kind] = _MessageDefinition(name, columns, layout, [_COLUMN_TYPES[code][1] for code in codes])

    def _position(self, at_us: int, values: Values) -> None:
        if is_place(values["Lat"], values["Lng"], values["Alt"]):
            relative_alt_m = values.get("RelHomeAlt")
            self.vehicle.add(
                Position(at_us, None, values["Lat"], values["Lng"], values["Alt"], _finite_or_none(relative_alt_m))
            )

    def _gps(self, at_us: int, values: Values) -> None:
        instance, fix = values.get("I", 0), values["Status"]
        hdop = values.get("HDop")
        self.vehicle.add_sample(
            GpsStatus(at_us, None, instance, fix, values["NSats"], hdop if hdop and hdop < 99 else None), instance, fix
        )
        if instance != 0 or fix < 3:
            return
        if (time := gps_time_from_week(at_us, values["GWk"], values["GMS"])) is not None and (
            self.vehicle.add_gps_time(time)
        ):
            self.gps_positions.use_gps_time(time)
        if is_place(values["Lat"], values["Lng"], values["Alt"]):
            self.gps_positions.add(Position(at_us, None, values["Lat"], values["Lng"], values["Alt"], None))

    def _mode(self, at_us: int, values: Values) -> None:
        number = values["ModeNum"] if "ModeNum" in values else values["Mode"]
        failsafe = _FAILSAFES.get(values.get("Rsn", 0))
        self.vehicle.add_change(ModeChange(at_us, None, number, str(number), failsafe), number)

    def _arm(self, at_us: int, values: Values) -> None:
        armed = bool(values["ArmState"])
        self.vehicle.add_change(ArmingChange(at_us, None, armed), armed)

    def _event(self, at_us: int, values: Values) -> None:
        if values["Id"] in (_EVENT_ARMED, _EVENT_DISARMED):
            armed = values["Id"] == _EVENT_ARMED
            self.vehicle.add_change(ArmingChange(at_us, None, armed), armed)

    def _battery(self, at_us: int, values: Values) -> None:
        instance = values["Inst"] if "Inst" in values else values.get("Instance", 0)
        current_a, remaining = _finite_or_none(values.get("Curr")), _finite_or_none(values.get("RemPct"))
        if math.isfinite(values["Volt"]):
            self.vehicle.add_sample(Battery(at_us, None, instance, values["Volt"], current_a, remaining), instance)

    def _ekf(self, at_us: int, values: Values) -> None:
        core, primary = values.get("C", 0), values.get("PI", 0)
        if core == max(primary, 0):
            flags = values["SS"]
            variances = (values["SV"], values["SP"], values["SH"], values["SM"])
            self.vehicle.add_sample(EkfStatus(at_us, None, flags, *variances), "EKF", flags)

    def _radio(self, at_us: int, values: Values) -> None:
        self.vehicle.add(
            RadioStatus(
                at_us,
                None,
                values["RSSI"],
                values["RemRSSI"],
                values["Noise"],
                values["RemNoise"],
                values["TxBuf"],
                values["RxErrors"],
                values["Fixed"],
            )
        )

    def _parameter(self, at_us: int, values: Values) -> None:
        name, value = _text(values["Name"]), values["Value"]
        if not name.isprintable() or not math.isfinite(value):
            raise ValueError(name)
        if name in _VEHICLE_PARAMETERS and 1 <= value <= 255:
            self.vehicle_id = int(value)
        self.vehicle.add(Parameter(at_us, None, name, value))

    def _message(self, at_us: int, values: Values) -> None:
        words = _text(values["Message"]).split(maxsplit=1)
        if words:
            self.mav_type = _FIRMWARE.get(words[0], self.mav_type)


_HANDLERS: dict[str, Callable[[DataFlashReader, int, Values], None]] = {
    "POS": DataFlashReader._position,
    "GPS": DataFlashReader._gps,
    "MODE": DataFlashReader._mode,
    "ARM": DataFlashReader._arm,
    "EV": DataFlashReader._event,
    "BAT": DataFlashReader._battery,
    "CURR": DataFlashReader._battery,
    "XKF4": DataFlashReader._ekf,
    "NKF4": DataFlashReader._ekf,
    "RAD": DataFlashReader._radio,
    "PARM": DataFlashReader._parameter,
    "MSG": DataFlashReader._message,
}


def _finite_or_none(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def _text(value: bytes) -> str:
    return value.split(b"\0", 1)[0].decode("ascii", "replace")
