"""Takes a real ArduPilot off, at speedup 10, in the directory given, and ends it: a program for test_pilot.py."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
from pathlib import Path

from sitl.ardupilot import ArduPilot
from sitl.pilot import Pilot
from tests.sitl.flying import DEADLINE_S, HOME, connect

SPEEDUP = 10.0


def main(directory: Path) -> None:
    launch = ArduPilot.find(None, os.environ).launch(3, HOME, SPEEDUP, directory)

    async def fly() -> None:
        pilot = Pilot(3, connect(launch.pilot_port), directory / "3.tlog", SPEEDUP)
        await pilot.start()
        try:
            await pilot.take_off(20.0)
        finally:
            await pilot.close()

    with (directory / "log").open("w") as log:
        vehicle = subprocess.Popen(
            launch.argv, cwd=directory, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT
        )
    try:
        asyncio.run(fly())
    finally:
        vehicle.terminate()
        vehicle.wait(DEADLINE_S)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
