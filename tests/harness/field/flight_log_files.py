"""Write flight logs for tests. The module writes DataFlash files itself, and telemetry logs with pymavlink."""

import struct
from collections.abc import Iterable, Iterator
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

DEFINITIONS: dict[str, tuple[int, str, str]] = {
    "FMT": (128, "BBnNZ", "Type,Length,Name,Format,Columns"),
    "PARM": (64, "QNff", "TimeUS,Name,Value,Default"),
    "MSG": (65, "QZ", "TimeUS,Message"),
    "GPS": (66, "QBBIHBcLLeffffB", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U"),
    "POS": (67, "QLLfff", "TimeUS,Lat,Lng,Alt,RelHomeAlt,RelOriginAlt"),
    "MODE": (68, "QMBB", "TimeUS,Mode,ModeNum,Rsn"),
    "ARM": (69, "QBIBB", "TimeUS,ArmState,ArmChecks,Forced,Method"),
    "BAT": (70, "QBfffffcfBBB", "TimeUS,Inst,Volt,VoltR,Curr,CurrTot,EnrgTot,Temp,Res,RemPct,H,SH"),
    "XKF4": (71, "QBcccccfbbHBIb", "TimeUS,C,SV,SP,SH,SM,SVT,errRP,OFN,OFE,FS,TS,SS,PI"),
    "RAD": (72, "QBBBBBHH", "TimeUS,RSSI,RemRSSI,TxBuf,Noise,RemNoise,RxErrors,Fixed"),
    "IMU": (73, "QBfff", "TimeUS,I,GyrX,GyrY,GyrZ"),
}
"""The number, the types and the columns of each DataFlash message by its name, as in ArduPilot 4.7."""
_STRUCT = {
    **{code: code for code in "BbHIfQ"},
    **{"c": "h", "e": "i", "L": "i", "M": "B", "n": "4s", "N": "16s", "Z": "64s"},
}
_FACTOR = {"c": 100, "e": 100, "L": 10_000_000}
WEEK, WEEK_MS = 2446, 10_000_000
"""GPS time at the vehicle's boot."""
BOOT_UTC_US = (315_964_800 - 18) * 1_000_000 + WEEK * 604_800_000_000 + WEEK_MS * 1000
LAT_DEG, LON_DEG = 48.0, 2.0


def dataflash(name: str, *values: Any) -> bytes:
    """Return the bytes of one DataFlash message."""
    number, types, _ = DEFINITIONS[name]
    raw = [
        round(value * _FACTOR[code]) if code in _FACTOR else value for code, value in zip(types, values, strict=True)
    ]
    return b"\xa3\x95" + bytes([number]) + struct.pack("<" + "".join(_STRUCT[code] for code in types), *raw)


def definitions() -> bytes:
    """Return the DataFlash messages that define all message types (FMT)."""
    messages = []
    for name, (number, types, columns) in DEFINITIONS.items():
        length = 3 + struct.calcsize("<" + "".join(_STRUCT[code] for code in types))
        messages.append(dataflash("FMT", number, length, name.encode(), types.encode(), columns.encode()))
    return b"".join(messages)


def flight_messages(*, vehicle: int = 7, seconds: int = 60, first_us: int = 5_000_000) -> Iterator[bytes]:
    """Yield the DataFlash messages of a copter that flies north at 10 m/s."""
    yield dataflash("MSG", first_us, b"ArduCopter V4.7.0 (abcdef)")
    yield dataflash("PARM", first_us, b"MAV_SYSID", vehicle, 1)
    yield dataflash("PARM", first_us, b"LOG_BITMASK", 176126, 176126)
    yield dataflash("MODE", first_us, 4, 4, 1)
    yield dataflash("ARM", first_us, 1, 0, 0, 0)
    for second in range(seconds):
        at_us = first_us + second * 1_000_000
        lat_deg = LAT_DEG + second * 10 / 111_320
        week_ms = WEEK_MS + at_us // 1000
        yield dataflash("IMU", at_us, 0, 0.1, 0.2, 0.3)
        yield dataflash("GPS", at_us, 0, 3, week_ms, WEEK, 12, 0.8, lat_deg, LON_DEG, 130, 10, 0, 0, 0, 1)
        yield dataflash("POS", at_us + 1000, lat_deg, LON_DEG, 130, 30, 30)
        yield dataflash("BAT", at_us, 0, 12.5 - second / 100, 12.5, 8, 100, 2, 30, 0.01, 90, 1, 100)
        yield dataflash("XKF4", at_us, 0, 0.1, 0.2, 0.3, 0.4, 0, 0, 0, 0, 0, 0, 831, 0)
        yield dataflash("RAD", at_us, 200 - second, 190, 100, 40, 45, second, 2)
    yield dataflash("MODE", first_us + seconds * 1_000_000, 9, 9, 1)
    yield dataflash("ARM", first_us + seconds * 1_000_000, 0, 0, 0, 0)


def dataflash_file(messages: Iterable[bytes] | None = None) -> bytes:
    return definitions() + b"".join(flight_messages() if messages is None else messages)


def stamped(at_us: int, frame: bytes) -> bytes:
    """Return a MAVLink frame with its timestamp, as in a telemetry log."""
    return struct.pack(">Q", at_us) + frame


def telemetry_messages(
    *, vehicle: int = 7, seconds: int = 60, first_us: int = 1_700_000_000_000_000, ahead_us: int = 0
) -> Iterator[bytes]:
    """Yield the frames of a plane that flies north at 10 m/s, each with its timestamp.

    The vehicle's GPS time is `ahead_us` ahead of the computer's clock.
    """
    autopilot = mavlink.MAVLink(None, srcSystem=vehicle, srcComponent=1)
    station = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
    radio = mavlink.MAVLink(None, srcSystem=51, srcComponent=68)
    for second in range(seconds):
        at_us = first_us + second * 1_000_000
        lat = round((LAT_DEG + second * 10 / 111_320) * 1e7)
        mode = 10 if second < seconds // 2 else 11
        messages = [
            (station, station.heartbeat_encode(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 4)),
            (autopilot, autopilot.heartbeat_encode(1, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, 0x81, mode, 4)),
            (autopilot, autopilot.system_time_encode(at_us + ahead_us, second * 1000)),
            (
                autopilot,
                autopilot.global_position_int_encode(
                    second * 1000, lat, round(LON_DEG * 1e7), 130_000, 30_000, 1000, 0, 0, 0
                ),
            ),
            (autopilot, autopilot.sys_status_encode(0, 0, 0, 0, 12_500, 800, 90, 0, 0, 0, 0, 0, 0)),
            (autopilot, autopilot.gps_raw_int_encode(at_us, 3, lat, 0, 0, 80, 0, 0, 0, 12)),
            (autopilot, autopilot.ekf_status_report_encode(831, 0.1, 0.2, 0.3, 0.4, 0)),
            (autopilot, autopilot.param_value_encode(b"MAV_SYSID", vehicle, 9, 1, 0)),
            (autopilot, autopilot.attitude_encode(second * 1000, 0, 0, 0, 0, 0, 0)),
            (radio, radio.radio_status_encode(200 - second, 190, 100, 40, 45, second, 2)),
        ]
        for sender, message in messages:
            yield stamped(at_us, message.pack(sender))


def telemetry_file(messages: Iterable[bytes] | None = None) -> bytes:
    return b"".join(telemetry_messages() if messages is None else messages)
