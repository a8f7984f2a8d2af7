"""What ArduPilot calls its flight modes, and their numbers on the wire (HEARTBEAT.custom_mode), by type of vehicle.

As in the parameters FLTMODE1 of ArduCopter and ArduPlane and MODE1 of ArduRover.
"""

from __future__ import annotations

from pymavlink.dialects.v20 import common as mavlink

from sitl.vehicle import VehicleType

MODES: dict[VehicleType, dict[str, int]] = {
    "copter": {"STABILIZE": 0, "AUTO": 3, "GUIDED": 4, "LOITER": 5, "RTL": 6, "LAND": 9},
    "plane": {"MANUAL": 0, "AUTO": 10, "RTL": 11, "LOITER": 12, "TAKEOFF": 13, "GUIDED": 15},
    "rover": {"MANUAL": 0, "HOLD": 4, "AUTO": 10, "RTL": 11, "GUIDED": 15},
}
BOOT_MODES: dict[VehicleType, str] = {"copter": "STABILIZE", "plane": "MANUAL", "rover": "MANUAL"}
"""What a vehicle is in when nobody has told it anything: somebody holds the sticks."""


def mode_name(vehicle_type: VehicleType, number: int | None) -> str:
    """The mode's name; its number if it is none of those above."""
    return next((name for name, known in MODES[vehicle_type].items() if known == number), str(number))


def mav_type(number: int) -> str:
    """What a vehicle calls itself in its heartbeats (MAV_TYPE), in lower case: "quadrotor", "surface boat"."""
    known = mavlink.enums["MAV_TYPE"].get(number)
    return known.name.removeprefix("MAV_TYPE_").replace("_", " ").lower() if known else str(number)
