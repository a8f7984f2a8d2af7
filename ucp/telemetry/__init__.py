"""The event source `mavlink`. It converts the MAVLink telemetry of a vehicle to loggable events.

`TelemetryEvents` translates the bytes of a vehicle into pairs of event ID and data. It does no I/O, and its methods
take the time as an argument. `VehicleConnection` connects to the vehicle and passes its bytes to the translator.
`describe` returns the data of an event as text, `position_of` returns it as a position, and `mode_name` returns the
name of a flight mode. A mission selects the events to log by kind (`EVENT_KINDS`).

    ID  kind      event             data, big-endian (source: MAVLink messages)
    1   mode      mode change       `>IBII`   vehicle time ms, MAV_TYPE, mode before (0xFFFFFFFF: unknown), mode
                                              (HEARTBEAT)
    2   arming    armed             `>II`     vehicle time ms, mode (HEARTBEAT)
    3   arming    disarmed          `>II`     vehicle time ms, mode (HEARTBEAT)
    4   text      status text       `>IB`     vehicle time ms, MAV_SEVERITY, then the text in UTF-8 (STATUSTEXT)
    5   position  position          64 bytes, see `Position` (GLOBAL_POSITION_INT, ATTITUDE, SYS_STATUS, SYSTEM_TIME)
    6   waypoint  waypoint reached  `>IH`     vehicle time ms, number of the mission item (MISSION_ITEM_REACHED,
                                              MISSION_CURRENT)
    7   failsafe  failsafe or over  `>IBI`    vehicle time ms, MAV_STATE, failed sensors (HEARTBEAT, SYS_STATUS)
    8   battery   battery level     `>IHhb`   vehicle time ms, mV (65535: unknown), 0.01 A (-1: unknown), % left
                                              (SYS_STATUS)

Vehicle time is the number of milliseconds since the vehicle's boot, by the vehicle's own clock. In a simulation this is
simulated time. A mode is ArduPilot's custom_mode. One position in 10 s fills about nine blocks of 1024 bytes in the 20
minutes of the thesis's mission.

The translator logs a position only while the vehicle reports a good position estimate (MAV_SYS_STATUS_AHRS of
SYS_STATUS). For some seconds after its boot, ArduPlane reports a position near 0 N, 0 E with a bad estimate.

While ArduPilot cannot be armed, it repeats the reasons every 30 s as texts `PreArm: ...`. The translator makes an event
of each such text only once, until the mode changes or the vehicle is armed or disarmed.

The translator detects failsafes from message fields, not from texts. While a failsafe acts (radio, battery, ground
station, EKF, terrain, dead reckoning), ArduPilot's HEARTBEAT has the state MAV_STATE_CRITICAL. A crashed plane has
MAV_STATE_EMERGENCY. Bits of MAV_SYS_STATUS_SENSOR in SYS_STATUS that are enabled and unhealthy name the failed sensors:
RC receiver, battery, compass, GPS, geofence, and AHRS, the estimate of attitude and position. A breached geofence or a
lost compass does not make the state critical. The bits count only while the vehicle is armed or its state is critical,
because the estimate is not healthy before a flight. Each change of state or sensors is an event, and so is the end of
the failsafe. A failsafe of the ground station has no bit. To see its name, log `text` too.

Battery levels are multiples of 10 %, and below 20 % also multiples of 5 %. The event occurs at the first known charge,
if the charge falls to a level, and if the battery was charged or changed. If a vehicle does not report its charge in
percent, there are no events of battery levels. Its battery failsafe is still an event with ID 7.
"""

from ucp.events import DEFAULT_LOG, EventKind
from ucp.telemetry._connection import VehicleConnection
from ucp.telemetry._event_text import describe, vehicle_type
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
    "vehicle_type",
]
