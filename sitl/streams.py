"""Define the messages that the embedded vehicle sends at intervals, with a function for each message in `STREAMS`."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from sitl._autopilot import CURRENT_ARMED_A, CURRENT_IDLE_A, Autopilot
from sitl._failsafes import FENCE as FENCE_ENABLE
from sitl.modes import MODES
from sitl.vehicle import Home, VehicleType

MAV_TYPES: dict[VehicleType, int] = {
    "copter": mavlink.MAV_TYPE_QUADROTOR,
    "plane": mavlink.MAV_TYPE_FIXED_WING,
    "rover": mavlink.MAV_TYPE_GROUND_ROVER,
}

SENSORS = (
    mavlink.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | mavlink.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    | mavlink.MAV_SYS_STATUS_SENSOR_GPS
    | mavlink.MAV_SYS_STATUS_SENSOR_BATTERY
    | mavlink.MAV_SYS_STATUS_SENSOR_RC_RECEIVER
    | mavlink.MAV_SYS_STATUS_AHRS
    | mavlink.MAV_SYS_STATUS_PREARM_CHECK
)
FENCE = mavlink.MAV_SYS_STATUS_GEOFENCE
"""The MAVLink flag of the fence. The vehicle reports the fence as healthy even if none is set, as ArduPilot does.
Otherwise MAVProxy would report a breach of the fence.
"""
NOT_YET = mavlink.MAV_SYS_STATUS_SENSOR_GPS | mavlink.MAV_SYS_STATUS_AHRS | mavlink.MAV_SYS_STATUS_PREARM_CHECK


def heartbeat(vehicle: Autopilot) -> Any:
    base_mode = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
    if vehicle.armed:
        base_mode |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
    return mavlink.MAVLink_heartbeat_message(
        MAV_TYPES[vehicle.vehicle_type],
        mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
        base_mode,
        MODES[vehicle.vehicle_type][vehicle.mode],
        _state(vehicle),
        3,  # MAVLink 2 has the value 3 here, too
    )


def _state(vehicle: Autopilot) -> int:
    if vehicle.armed and vehicle.failsafes.acting:
        return int(mavlink.MAV_STATE_CRITICAL)
    active = vehicle.airborne or (vehicle.armed and vehicle.vehicle_type == "rover")
    return int(mavlink.MAV_STATE_ACTIVE if active else mavlink.MAV_STATE_STANDBY)


def _health(vehicle: Autopilot) -> int:
    """Return the MAVLink flags of all healthy sensors and healthy functions."""
    acting = vehicle.failsafes.acting
    low = any(failsafe.startswith("battery") for failsafe in acting)
    unwell = mavlink.MAV_SYS_STATUS_SENSOR_BATTERY if low else 0
    unwell |= mavlink.MAV_SYS_STATUS_SENSOR_RC_RECEIVER if "radio" in acting else 0
    unwell |= FENCE if "fence" in acting else 0
    if not vehicle.ready:
        unwell |= NOT_YET
    if vehicle.has_booted and vehicle.vehicle_type != "rover":  # without GPS they estimate their position
        unwell &= ~mavlink.MAV_SYS_STATUS_AHRS
    return int((SENSORS | FENCE) & ~unwell)


def sys_status(vehicle: Autopilot) -> Any:
    sensors = SENSORS | (FENCE if vehicle.failsafes.parameters.get(FENCE_ENABLE) else 0)
    return mavlink.MAVLink_sys_status_message(
        onboard_control_sensors_present=sensors,
        onboard_control_sensors_enabled=sensors,
        onboard_control_sensors_health=_health(vehicle),
        load=50,
        voltage_battery=round(vehicle.volts * 1e3),
        current_battery=round(100 * (CURRENT_ARMED_A if vehicle.armed else CURRENT_IDLE_A)),
        battery_remaining=round(100 * (1 - vehicle.battery_used)),
        drop_rate_comm=0,
        errors_comm=0,
        errors_count1=0,
        errors_count2=0,
        errors_count3=0,
        errors_count4=0,
    )


def system_time(vehicle: Autopilot) -> Any:
    return mavlink.MAVLink_system_time_message(vehicle.epoch_us + round(vehicle.now_s * 1e6), _boot_ms(vehicle))


def attitude(vehicle: Autopilot) -> Any:
    motion = vehicle.motion
    yaw = (motion.yaw_rad + math.pi) % math.tau - math.pi
    return mavlink.MAVLink_attitude_message(
        _boot_ms(vehicle), motion.roll_rad, 0.0, yaw, 0.0, 0.0, motion.yaw_rate_rads
    )


def global_position_int(vehicle: Autopilot) -> Any:
    motion = vehicle.motion
    # 0 N, 0 E, as ArduPilot reports before its first GPS fix
    place = vehicle.home.offset(motion.north_m, motion.east_m) if vehicle.has_booted else Home(0.0, 0.0)
    return mavlink.MAVLink_global_position_int_message(
        _boot_ms(vehicle),
        round(place.lat_deg * 1e7),
        round(place.lon_deg * 1e7),
        round((vehicle.home.alt_m + motion.up_m) * 1e3),
        round(motion.up_m * 1e3),
        _cms(motion.north_ms),
        _cms(motion.east_ms),
        _cms(-motion.up_ms),
        round(math.degrees(motion.yaw_rad) * 100) % 36_000,
    )


def mission_current(vehicle: Autopilot) -> Any:
    return mavlink.MAVLink_mission_current_message(vehicle.current_item)


def home_position(vehicle: Autopilot) -> Any:
    home = vehicle.home
    place = (round(home.lat_deg * 1e7), round(home.lon_deg * 1e7), round(home.alt_m * 1e3))
    level = [1.0, 0.0, 0.0, 0.0]
    return mavlink.MAVLink_home_position_message(*place, 0.0, 0.0, 0.0, level, 0.0, 0.0, 0.0)


def autopilot_version(vehicle: Autopilot) -> Any:
    """Return the message with the version of this package. The message contains no commit. The vehicle sends it only on
    request.
    """
    parts = [min(part, 255) for part in release(_installed())]
    number = int.from_bytes([*parts, mavlink.FIRMWARE_VERSION_TYPE_OFFICIAL], "big")
    capabilities = mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_INT | mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    none = [0] * 8
    return mavlink.MAVLink_autopilot_version_message(
        capabilities, number, 0, 0, 0, none, none, none, 0, 0, vehicle.sysid
    )


def release(installed: str) -> tuple[int, int, int]:
    """Return the three numbers of a version such as "1.2.3", "1.2.3rc1" or "1.3.dev7"."""
    found = re.match(r"(\d+)(?:\.(\d+))?(?:\.(\d+))?", installed)
    assert found is not None, "versions start with a number"
    major, minor, micro = (int(part or 0) for part in found.groups())
    return major, minor, micro


def _installed() -> str:
    """Return the version of the installed package. In a container image, the package has no version."""
    try:
        return version("ucp-harness")
    except PackageNotFoundError:
        return "0"


def _cms(speed_ms: float) -> int:
    """Return a speed in centimetres per second, limited to a signed 16-bit number."""
    return round(max(-327.68, min(327.67, speed_ms)) * 100)


def _boot_ms(vehicle: Autopilot) -> int:
    return int(vehicle.now_s * 1e3) & 0xFFFFFFFF


STREAMS: dict[int, Callable[[Autopilot], Any]] = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: heartbeat,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: sys_status,
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: system_time,
    mavlink.MAVLINK_MSG_ID_ATTITUDE: attitude,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: global_position_int,
    mavlink.MAVLINK_MSG_ID_MISSION_CURRENT: mission_current,
}
ON_REQUEST: dict[int, Callable[[Autopilot], Any]] = {
    **STREAMS,
    mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: autopilot_version,
    mavlink.MAVLINK_MSG_ID_HOME_POSITION: home_position,
}
"""Messages that are sent once after MAV_CMD_REQUEST_MESSAGE. The vehicle refuses requests for other messages."""
