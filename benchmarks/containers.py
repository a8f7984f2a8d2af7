"""Measure the start and stop of agents: `python -m benchmarks.containers [--rounds R] [--json] [N ...]`.

Each round starts the agents in containers, and then as processes. Containers need root and a Docker engine. They use
the files of this machine, so no image is built. Up is the time from the beginning until the last agent answers. It
includes the start of the network. Down is the time from the first SIGTERM until the last container or the lab is gone.
Each ratio compares containers and processes in the same round.
"""

from __future__ import annotations

import argparse
import asyncio
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.rounds import Spread, show
from harness.archive.directory import RunDirectory
from harness.errors import HarnessError
from harness.play._vehicle_keys import KeyDirectories
from harness.play.containers._container_backend import DockerBackend
from harness.play.containers._container_preflight import require_root
from harness.play.process._agent_process import AgentProcess, agent_command
from harness.play.process._process_backend import ProcessBackend
from harness.play.process._run_lab import OpenLab
from harness.scenario.load import parse
from netem.errors import NetemError
from ucp.clock import MissionClock

_Row = dict[str, Any]
_FORMS = {f"{key}_s": ".2f" for key in ("docker_up", "process_up", "docker_down", "process_down")} | {
    f"{key}_ratio": ".1f" for key in ("up", "down")
}


async def once(agents: int, open_lab: OpenLab, directory: Path) -> tuple[float, float]:
    """Return the seconds that `agents` agents take to start, and the seconds that they take to stop."""
    scenario = parse(
        {"name": "up and down", "agents": agents, "vehicles": {"kind": "none"}, "docker": {"image_from_host": True}}
    )
    rundir = RunDirectory(directory)
    clock = MissionClock(scenario.speedup)
    started = [AgentProcess(agent, rundir, agent_command(scenario, agent), clock.now) for agent in scenario.roster]
    begin = time.perf_counter()
    async with await open_lab(scenario, rundir, lambda _: None) as lab:
        starts = (
            agent.start(lab, scenario, 1, b"benchmark", False, False, None, KeyDirectories(None, Path()))
            for agent in started
        )
        await asyncio.gather(*starts)
        up = time.perf_counter()
        await asyncio.gather(*(agent.stop() for agent in started))
        await lab.close()
        down = time.perf_counter()
    return up - begin, down - up


def up_and_down(agents: int, rounds: int, folder: Path) -> _Row:
    found: dict[str, list[tuple[float, float]]] = {"docker": [], "process": []}
    for number in range(rounds):
        for name, open_lab in (("docker", DockerBackend().open_lab), ("process", ProcessBackend().open_lab)):
            found[name].append(asyncio.run(once(agents, open_lab, folder / f"{name}-{agents}-{number}")))
    row: _Row = {"agents": agents}
    for place, key in enumerate(("up", "down")):
        seconds = {name: [one[place] for one in times] for name, times in found.items()}
        row |= {f"{name}_{key}_s": Spread.of(times) for name, times in seconds.items()}
        row[f"{key}_ratio"] = Spread.of_ratios(seconds["docker"], seconds["process"])
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("agents", nargs="*", type=int, metavar="N", help="numbers of agents (default 5 20)")
    parser.add_argument("--rounds", type=int, default=3, help="number of rounds")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args()
    try:
        require_root()
        with tempfile.TemporaryDirectory() as folder:
            rows = [up_and_down(agents, options.rounds, Path(folder)) for agents in options.agents or [5, 20]]
    except (HarnessError, NetemError) as error:
        sys.stderr.write(f"{error}\n")
        sys.exit(3)
    show(rows, _FORMS, options.json)


if __name__ == "__main__":
    main()
