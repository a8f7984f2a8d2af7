"""Flies a square with a real ArduCopter, at speedup 4, and ends it: for test_real_flight.py, and to record a track.

    python -m tests.sitl.real_flight DIRECTORY mission|guided [TRACK.json NOTE]

Run it in a network namespace of its own: ArduPilot listens on every address and may send multicast.
"""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
from pathlib import Path

from pymavlink import mavutil

from sitl.ardupilot import ArduPilot
from sitl.pilot import Pilot
from sitl.plan import By, GoTo, Land, Plan, TakeOff
from tests.sitl.flying import DEADLINE_S, HOME, connect

SPEEDUP = 4.0
SQUARE = Plan(
    (TakeOff(20), *(GoTo(*corner, speed_ms=5) for corner in ((100, 0), (100, 100), (0, 100), (0, 0))), Land())
)


def fly(directory: Path, by: By) -> Path:
    """The telemetry log of a flight, in `directory`."""
    tlog = directory / "3.tlog"
    launch = ArduPilot.find(None, os.environ).launch(3, HOME, SPEEDUP, directory)

    async def flight() -> None:
        pilot = Pilot(3, connect(launch.pilot_port), tlog, SPEEDUP, HOME)
        await pilot.start()
        try:
            await pilot.fly(pilot.flight(SQUARE, by))
        finally:
            await pilot.close()

    with (directory / "log").open("w") as log:
        vehicle = subprocess.Popen(
            launch.argv, cwd=directory, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT
        )
    try:
        asyncio.run(flight())
    finally:
        vehicle.terminate()
        vehicle.wait(DEADLINE_S)
    return tlog


def track_of(tlog: Path) -> list[list[float]]:
    """One [time, north, east, up] a simulated second: seconds since boot, metres from home."""
    points: list[list[float]] = []
    log = mavutil.mavlink_connection(str(tlog))
    while (message := log.recv_match(type="GLOBAL_POSITION_INT")) is not None:
        time_s = message.time_boot_ms / 1e3
        if message.lat and (not points or time_s - points[-1][0] >= 1.0):
            north_m, east_m, _ = HOME.metres_to(message.lat / 1e7, message.lon / 1e7, 0.0)
            points.append([round(value, 2) for value in (time_s, north_m, east_m, message.relative_alt / 1e3)])
    return points


def main(directory: str, by: By, track: str | None = None, note: str = "") -> None:
    points = track_of(fly(Path(directory), by))
    if track is not None:
        rows = ",\n".join(json.dumps(point) for point in points)
        Path(track).write_text(
            f'{{"note": {json.dumps(note)},\n"columns": ["time_s", "north_m", "east_m", "up_m"],\n'
            f'"points": [\n{rows}\n]}}\n'
        )


if __name__ == "__main__":
    main(*sys.argv[1:])  # type: ignore[arg-type]
