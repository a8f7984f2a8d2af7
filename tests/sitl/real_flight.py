"""Fly a short plan with a real ArduPilot at speedup 8, for test_real_flight.py.

    python -m tests.sitl.real_flight DIRECTORY copter|plane|rover mission|guided

This command prints the time of the start of the flight, in seconds of the vehicle's clock. Run the command in its own
network namespace, because ArduPilot listens on every address and may send multicasts.
"""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
from pathlib import Path

from pymavlink import mavutil

from sitl.ardupilot import ArduPilot
from sitl.pilot import Pilot
from sitl.plan import By, GoTo, Land, Plan, TakeOff
from sitl.vehicle import VehicleType
from tests.sitl.flying import DEADLINE_S, HOME, connect

SPEEDUP = 8.0
PLANS: dict[VehicleType, Plan] = {
    "copter": Plan((TakeOff(10), GoTo(60, 30, speed_ms=8), Land())),
    "plane": Plan((TakeOff(40), GoTo(-300, -100), Land())),
    "rover": Plan((GoTo(40, 20), GoTo(0, 0))),
}


def fly(directory: Path, vehicle_type: VehicleType, by: By) -> float:
    """Fly the plan and write the telemetry log to `directory`. Return the time of the plan's start on the vehicle's
    clock.
    """
    launch = ArduPilot.find(None, os.environ, vehicle_type).launch(3, HOME, SPEEDUP, directory)

    async def flight() -> float:
        pilot = Pilot(3, connect(launch.pilot_port), directory / "3.tlog", SPEEDUP, HOME, vehicle_type)
        await pilot.start()
        try:
            plan = pilot.flight(PLANS[vehicle_type], by)
            await pilot.get_ready(plan)
            assert pilot.state.time_s is not None
            began_s = pilot.state.time_s
            await pilot.fly(plan)
        finally:
            await pilot.close()
        return began_s

    with (directory / "log").open("w") as log:
        vehicle = subprocess.Popen(
            launch.argv, cwd=directory, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT
        )
    try:
        return asyncio.run(flight())
    finally:
        vehicle.terminate()
        vehicle.wait(DEADLINE_S)


def track_of(tlog: Path, began_s: float) -> list[tuple[float, tuple[float, float, float]]]:
    """Return, for each recorded position, the seconds since the start and the metres from home."""
    log, points = mavutil.mavlink_connection(str(tlog)), []
    while (message := log.recv_match(type="GLOBAL_POSITION_INT")) is not None:
        if (second := message.time_boot_ms / 1e3 - began_s) >= 0:
            points.append((second, HOME.metres_to(message.lat / 1e7, message.lon / 1e7, message.alt / 1e3)))
    return points


if __name__ == "__main__":
    sys.stdout.write(f"{fly(Path(sys.argv[1]), sys.argv[2], sys.argv[3])}\n")  # type: ignore[arg-type]
