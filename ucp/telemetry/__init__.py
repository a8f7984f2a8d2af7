"""The `mavlink` event source: what a vehicle says about itself becomes loggable events.

`TelemetryEvents` is the translator: bytes from the vehicle in, (event ID, data) out, with time as an argument.
`VehicleConnection` is the thin connection that feeds it. `describe` turns an event's data back into words,
`position_of` into a position. `mode_name` returns the name of a flight mode. A mission chooses what is logged, by kind
(`EVENT_KINDS`).

    ID  kind      event             data, big-endian (MAVLink messages it comes from)
    1   mode      mode change       `>IBII`   vehicle time ms, MAV_TYPE, mode before (0xFFFFFFFF: unknown), mode
                                              (HEARTBEAT)
    2   arming    armed             `>II`     vehicle time ms, mode (HEARTBEAT)
    3   arming    disarmed          `>II`     vehicle time ms, mode (HEARTBEAT)
    4   text      status text       `>IB`     vehicle time ms, MAV_SEVERITY, then the text in UTF-8 (STATUSTEXT)
    5   position  position          64 bytes, see `Position` (GLOBAL_POSITION_INT, ATTITUDE, SYS_STATUS, SYSTEM_TIME)
    6   waypoint  waypoint reached  `>IH`     vehicle time ms, number of the mission item (MISSION_ITEM_REACHED,
                                              MISSION_CURRENT)
    7   failsafe  failsafe or over  `>IBI`    vehicle time ms, MAV_STATE, what failed (HEARTBEAT, SYS_STATUS)
    8   battery   battery level     `>IHhb`   vehicle time ms, mV (65535: unknown), 0.01 A (-1: unknown), % left
                                              (SYS_STATUS)

Vehicle time is milliseconds since the vehicle's boot, in its own (perhaps simulated) time. A mode is ArduPilot's
custom_mode. A position record is large enough that positions alone, one in 10 s, fill about nine blocks of 1024 bytes
in the thesis's 20 minutes.

A position counts while the vehicle says that its estimate is good: MAV_SYS_STATUS_AHRS of SYS_STATUS. Before, and if it
is lost in flight, there are no positions: an ArduPlane that has booted says for some seconds that it is near 0 N, 0 E.

What ArduPilot says every 30 s while it cannot be armed (`PreArm: ...`) is an event once, until its mode or its arming
changes.

Failsafes are read from what is meant for machines. While one acts (radio, battery, ground station, EKF, terrain, dead
reckoning), ArduPilot's HEARTBEAT says MAV_STATE_CRITICAL; a plane that has crashed says MAV_STATE_EMERGENCY. Which one
it is, SYS_STATUS tells of some, by a bit of MAV_SYS_STATUS_SENSOR that is enabled and unhealthy: RC receiver, battery,
compass, GPS, geofence (neither a breach nor a lost compass is critical) and AHRS, the estimate of
attitude and position. These bits are "what failed". They count while the vehicle is armed or critical: before a flight
the estimate is not healthy yet. Every change is an event, and so is the end. A ground station failsafe has no bit: log
`text` too, where ArduPilot says which it is and what it does about it.

Battery levels are every 10 %, and every 5 % from 20 % down. A level reached is an event, and so is a battery that was
charged or changed. A vehicle that does not know its percentage has no levels; its battery failsafe is event 7.
"""

from ucp.events import DEFAULT_LOG, EventKind
from ucp.telemetry._connection import VehicleConnection
from ucp.telemetry._event_text import describe
from ucp.telemetry._mode_names import mode_name
from ucp.telemetry._records import (
    ARMED,
    BATTERY,
    DISARMED,
    EVENT_KINDS,
    FAILSAFE,
    MAX_DATA_BYTES,
    MODE_CHANGE,
    POSITION,
    STATUS_TEXT,
    WAYPOINT,
    Position,
    position_of,
)
from ucp.telemetry._translator import TelemetryEvents

__all__ = [
    "ARMED",
    "BATTERY",
    "DEFAULT_LOG",
    "DISARMED",
    "EVENT_KINDS",
    "FAILSAFE",
    "MAX_DATA_BYTES",
    "MODE_CHANGE",
    "POSITION",
    "STATUS_TEXT",
    "WAYPOINT",
    "EventKind",
    "Position",
    "TelemetryEvents",
    "VehicleConnection",
    "describe",
    "mode_name",
    "position_of",
]
