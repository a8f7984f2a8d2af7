"""Event IDs of the `mavlink` source, and the layout of the data of each event. The docstring of the package contains a
table of them.
"""

import struct
from typing import NamedTuple

from ucp.events import EventKind

MODE_CHANGE, ARMED, DISARMED, STATUS_TEXT, POSITION, WAYPOINT, FAILSAFE, BATTERY = range(1, 9)

EVENT_KINDS: dict[EventKind, tuple[int, ...]] = {
    "mode": (MODE_CHANGE,),
    "arming": (ARMED, DISARMED),
    "text": (STATUS_TEXT,),
    "waypoint": (WAYPOINT,),
    "failsafe": (FAILSAFE,),
    "position": (POSITION,),
    "battery": (BATTERY,),
}
"""Event IDs by kind of event."""

MAX_DATA_BYTES = 256
"""Maximum number of bytes of event data. Longer data is truncated."""

UNKNOWN_MODE = 0xFFFFFFFF
UNKNOWN_HEADING = UNKNOWN_VOLTAGE = 0xFFFF

CRITICAL_STATES = frozenset({5, 6, 8})
"""Values of MAV_STATE during a failsafe: critical, emergency and flight termination."""

SENSORS = {
    **{1 << 2: "compass", 1 << 5: "GPS"},
    **{1 << 16: "RC receiver", 1 << 20: "geofence", 1 << 21: "AHRS", 1 << 25: "battery"},
}
"""Bit of MAV_SYS_STATUS_SENSOR -> name of the sensor in a failsafe event."""

MODE_CHANGE_DATA = struct.Struct(">IBII")
ARMING_DATA = struct.Struct(">II")
STATUS_TEXT_DATA = struct.Struct(">IB")
WAYPOINT_DATA = struct.Struct(">IH")
FAILSAFE_DATA = struct.Struct(">IBI")
BATTERY_DATA = struct.Struct(">IHhb")

_POSITION_DATA = struct.Struct(">IQiiiihhhHfffhhhHhbIB")


class Position(NamedTuple):
    """A position event. The fields have the order and units of the encoded data: `>IQiiiihhhHfffhhhHhbIB`, 64 bytes."""

    vehicle_ms: int
    clock_us: int  # the vehicle's clock, microseconds since the Unix epoch; 0: unknown
    lat_e7: int  # 1e-7 degrees
    lon_e7: int
    alt_mm: int  # above mean sea level
    relative_alt_mm: int  # above home
    north_cms: int  # velocity, cm/s
    east_cms: int
    down_cms: int
    heading_cdeg: int  # 0.01 degrees; 65535: unknown
    roll_rad: float  # NaN: unknown
    pitch_rad: float
    yaw_rad: float
    roll_mrads: int  # rates, mrad/s
    pitch_mrads: int
    yaw_mrads: int
    battery_mv: int  # 65535: unknown
    battery_ca: int  # 0.01 A; -1: unknown
    battery_percent: int  # remaining charge; -1: unknown
    mode: int
    armed: int  # 1 if armed

    def pack(self) -> bytes:
        return _POSITION_DATA.pack(*self)

    @classmethod
    def unpack(cls, data: bytes) -> "Position":
        """Parse the 64 bytes of data of a position event. Raises struct.error for any other length."""
        return cls._make(_POSITION_DATA.unpack(data))


def position_of(event_id: int, data: bytes) -> Position | None:
    """Return the position in an event. Return None if the event is no position event, if its data cannot be parsed, or
    if the position is out of range.
    """
    if event_id != POSITION:
        return None
    try:
        position = Position.unpack(data)
    except struct.error:
        return None
    return position if abs(position.lat_e7) <= 90e7 and abs(position.lon_e7) <= 180e7 else None
