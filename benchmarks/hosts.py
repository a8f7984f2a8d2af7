"""Measure how fast a swarm on several workers starts: `python -m benchmarks.hosts [--workers W] [--json] [N ...]`.

The workers of the Dask cluster are processes of this machine, so they share its processors. A real cluster has more
processors. Each round plays the start and the end of a mission of N agents. The rows `workers` are measured on the
workers, and the rows `here` in one lab without Dask. Up is the time from the beginning until the mission begins,
without the import of Dask. Down is the time from the end of the mission until all agents have ended. Needs root, or a
/dev/net/tun that this user may open.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.rounds import Spread, show
from harness.archive.directory import RunDirectory
from harness.errors import HarnessError
from harness.play.hosts.hosts_backend import HostsBackend
from harness.play.process._process_backend import ProcessBackend
from harness.play.progress import SilentProgress
from harness.scenario.changes import timeline_of
from harness.scenario.load import parse

LIMIT_S = 60.0
FORMS = {"up_s": ".1f", "down_s": ".1f"}


def cluster(workers: int, folder: Path, stack: contextlib.ExitStack) -> str:
    """Start a scheduler and workers. Return the address of the scheduler."""

    def start(what: str, *options: object) -> None:
        command = [sys.executable, "-m", f"distributed.cli.dask_{what}", "--host", "127.0.0.1", "--no-dashboard"]
        log = stack.enter_context((folder / f"{what}.log").open("a"))
        process = subprocess.Popen([*command, *map(str, options)], stdout=log, stderr=log, cwd=folder)
        stack.callback(process.wait)
        stack.callback(process.terminate)

    start("scheduler", "--port", 0)
    address = wait_for(folder / "scheduler.log", "Scheduler at:", 1)[0].split()[-1]
    for number in range(workers):
        start("worker", address, "--nthreads", 1, "--no-nanny", "--local-directory", folder / f"worker-{number}")
    wait_for(folder / "worker.log", "Registered to:", workers)
    return address


def wait_for(log: Path, words: str, count: int) -> list[str]:
    """Wait until the log has `count` lines that contain these words, and return the lines."""
    deadline = time.monotonic() + LIMIT_S
    while time.monotonic() < deadline:
        if log.exists():
            found = [line for line in log.read_text().splitlines() if words in line]
            if len(found) >= count:
                return found
        time.sleep(0.1)
    sys.exit(f"{log} does not contain {words!r} {count} times")


async def play(backend: ProcessBackend, agents: int, vehicles: str, folder: Path, begin: float) -> dict[str, float]:
    scenario = _scenario(agents, vehicles)
    directory = RunDirectory(folder)
    async with backend.open(scenario, 1, directory, SilentProgress(), asyncio.Event()) as swarm:
        await swarm.begin(timeline_of(scenario)[0])
        up = time.perf_counter()
    if swarm.played.outcome != "completed":
        sys.exit(f"the run failed: {swarm.played.outcome_detail}")
    return {"up_s": up - begin, "down_s": time.perf_counter() - up}


def once(backend: ProcessBackend, agents: int, vehicles: str, folder: Path) -> dict[str, float]:
    begin = time.perf_counter()
    backend.refuse(_scenario(agents, vehicles))
    return asyncio.run(play(backend, agents, vehicles, folder, begin))


def _scenario(agents: int, vehicles: str) -> Any:
    events = {"source": "random", "mean_s": 10_000}
    return parse({"name": "up and down", "agents": agents, "vehicles": {"kind": vehicles}, "events": events})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("agents", nargs="*", type=int, metavar="N", help="numbers of agents (default 50 100)")
    parser.add_argument("--workers", type=int, default=4, help="number of workers")
    parser.add_argument("--vehicles", choices=("none", "embedded"), default="none", help="kind of vehicles")
    parser.add_argument("--rounds", type=int, default=3, help="number of rounds")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args()
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as name, contextlib.ExitStack() as stack:
        folder = Path(name)
        backends = {"workers": HostsBackend(cluster(options.workers, folder, stack)), "here": ProcessBackend()}
        try:
            once(backends["workers"], 1, "none", folder / "first")  # imports Dask
            for agents in options.agents or [50, 100]:
                for where, backend in backends.items():
                    found = [
                        once(backend, agents, options.vehicles, folder / f"{where}-{agents}-{number}")
                        for number in range(options.rounds)
                    ]
                    spreads = {key: Spread.of(each[key] for each in found) for key in FORMS}
                    rows.append({"agents": agents, "where": where, **spreads})
        except HarnessError as error:
            sys.exit(str(error))
    show(rows, FORMS, options.json)


if __name__ == "__main__":
    main()
