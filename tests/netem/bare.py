"""Open a virtual network, start programs that ignore signals in this network, and wait.

`bare.py FOLDER [ENGINE]` prints each step on standard output.
"""

from __future__ import annotations

import asyncio
import itertools
import os
import sys
from pathlib import Path

from netem.conditions import LinkConditions, NetworkConditions
from netem.lab import Lab

_STUBBORN = ["/bin/sh", "-c", "trap '' TERM HUP INT; setsid sleep 1000 & while :; do sleep 1000; done"]


def say(what: str) -> None:
    sys.stdout.write(f"{what}\n")
    sys.stdout.flush()


async def main(folder: Path) -> None:
    say("opening")
    lab = await Lab.open(range(1, 6), log=folder / "lab.log")
    say("open")
    for vehicle in (*lab.vehicles, None):
        output = folder / f"{vehicle}.log"
        await lab.spawn(vehicle, _STUBBORN, cwd=folder, env=os.environ, stdout=output, stderr=output)
    say("full")
    for step in itertools.count():
        conditions = NetworkConditions(LinkConditions(0.1 * (step % 10)))
        await lab.apply(conditions.with_partition([[1, 2]]) if step % 2 else conditions)


if __name__ == "__main__":
    asyncio.run(main(Path(sys.argv[1])))
