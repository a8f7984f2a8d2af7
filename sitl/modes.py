"""List the names and numbers (HEARTBEAT.custom_mode) of ArduPilot's flight modes by vehicle type. The numbers equal the
values of the parameter FLTMODE1 in ArduCopter and ArduPlane, and of MODE1 in ArduRover.
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
"""The flight mode after boot, before any command. In this mode a person flies the vehicle by remote control."""


def mode_name(vehicle_type: VehicleType, number: int | None) -> str:
    """Return the name of a flight mode, or its number if it is unknown."""
    return next((name for name, known in MODES[vehicle_type].items() if known == number), str(number))


def mav_type(number: int) -> str:
    """Return the type that a vehicle reports in its heartbeats (MAV_TYPE) in lower case, such as "surface boat"."""
    known = mavlink.enums["MAV_TYPE"].get(number)
    return known.name.removeprefix("MAV_TYPE_").replace("_", " ").lower() if known else str(number)
