"""Read recorded telemetry of ArduPilot 4.7.0-dev, shortened for the tests: `tests/sitl/recordings/*.tlog.gz`.

    python -m tests.sitl.recorded TELEMETRY.tlog OUT.tlog.gz

shortens a telemetry log. Messages about the position, the system status and the mission item are kept completely for
the first 50 s, and then every 2 s until 420 s. The result also has each change of the mode, of the arming and of the
mission item, all text messages, the reached mission items and the home positions.
"""

from __future__ import annotations

import gzip
import struct
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl.vehicle import Home

RECORDINGS = Path(__file__).parent / "recordings"
Name = Literal["copter-mission", "copter-guided", "plane-mission", "plane-guided", "rover-mission", "rover-guided"]

EVERYTHING_S = 50.0
EVERY_S = 2.0
END_S = 420.0
STREAMS = {"GLOBAL_POSITION_INT", "SYS_STATUS", "MISSION_CURRENT"}
EVENTS = {"STATUSTEXT", "MISSION_ITEM_REACHED", "HOME_POSITION"}


def frames(name: Name) -> Iterator[bytes]:
    """Yield the frames of a recording in the order in which the vehicle sent them."""
    for frame, _ in messages(name):
        yield frame


def messages(name: Name) -> Iterator[tuple[bytes, Any]]:
    """Yield each frame with its decoded message."""
    yield from _messages(gzip.decompress((RECORDINGS / f"{name}.tlog.gz").read_bytes()))


def flight(name: Name) -> list[tuple[float, float, float, float]]:
    """Return seconds since arming, and metres north, east and up from the start."""
    points: list[tuple[float, float, float, float]] = []
    home, armed_s, now_s = Home(0.0, 0.0), None, 0.0
    for _, message in messages(name):
        if message.get_type() == "HEARTBEAT" and message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED:
            armed_s = now_s if armed_s is None else armed_s
        elif message.get_type() == "GLOBAL_POSITION_INT":
            now_s, lat_deg, lon_deg, alt_m = (
                message.time_boot_ms / 1e3,
                message.lat / 1e7,
                message.lon / 1e7,
                message.alt / 1e3,
            )
            if armed_s is None:
                home = Home(lat_deg, lon_deg, 584.0)
            else:
                points.append((now_s - armed_s, *home.metres_to(lat_deg, lon_deg, alt_m)))
    return points


def _messages(log: bytes) -> Iterator[tuple[bytes, Any]]:
    parser, at = mavlink.MAVLink(None), 0
    while at < len(log):
        at += 8  # the time of its arrival
        end = at + 12 + log[at + 1] + 13 * (log[at + 2] & 1)  # MAVLink 2, perhaps signed
        yield log[at:end], parser.decode(bytearray(log[at:end]))
        at = end


def cut(log: bytes) -> bytes:
    kept, last, now_s, due = bytearray(), dict[str, Any](), 0.0, dict[str, float]()
    for frame, message in _messages(log):
        kind = message.get_type()
        if message.get_srcComponent() != mavlink.MAV_COMP_ID_AUTOPILOT1:
            continue
        now_s = getattr(message, "time_boot_ms", now_s * 1e3) / 1e3
        if now_s > END_S:
            break
        if kind == "HEARTBEAT":
            says = message.custom_mode, message.base_mode, message.system_status
            wanted, last[kind] = last.get(kind) != says, says
        elif kind == "MISSION_CURRENT" and last.get(kind) != message.seq:
            wanted, last[kind] = True, message.seq
        elif kind in STREAMS:
            wanted = now_s < EVERYTHING_S or now_s >= due.get(kind, 0.0)
        else:
            wanted = kind in EVENTS
        if wanted:
            due[kind] = now_s + EVERY_S
            kept += struct.pack(">Q", round(now_s * 1e6)) + frame
    return bytes(kept)


if __name__ == "__main__":
    Path(sys.argv[2]).write_bytes(gzip.compress(cut(Path(sys.argv[1]).read_bytes()), mtime=0))
