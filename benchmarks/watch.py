"""Measure the web server of the live page: `python -m benchmarks.watch [--agents 50] [--minutes 4] [--speedup 1]`.

A run in virtual time with flying vehicles writes the same files as real agents, with all received messages in the
traces. The benchmark then writes these files again, line by line at the same times. The server process reads the files
ten times per second for one browser. A client in another process takes the place of the browser. The benchmark prints
the processor seconds (user and system) of the server alone. 50 vehicles should take at most a fifth of a core.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import multiprocessing
import time
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory

import aiohttp

from harness.play.progress import SilentProgress
from harness.report.live.feed import ChangeFeed
from harness.report.live.server import UPDATE_S, ChangeLog, LivePageServer
from harness.run.run import run
from harness.scenario import Scenario

Written = list[tuple[float, Path, bytes]]


def played(directory: Path, agents: int, minutes: float) -> None:
    flight = {"radio": {"hard_range": {"range_m": 3000}}}
    keys = {"agents": agents, "duration_s": 60 * minutes, "network": {"loss": 0.1, **flight}}
    run(Scenario.model_validate({"name": "Watched", **keys}), 1, directory, SilentProgress(), "sim", delivers_all=True)


def written(directory: Path) -> Written:
    """Return each line of a run's files with the mission second at which the line was written."""
    lines: Written = []
    for path in directory.rglob("*.jsonl"):
        at_s = 0.0
        for line in path.read_bytes().splitlines(keepends=True):
            document = json.loads(line)
            at_s = document.get("t", document.get("at_s", at_s))
            lines.append((at_s, path.relative_to(directory), line))
    return sorted(lines, key=lambda line: line[0])


async def serve(directory: Path, lines: Written, speedup: float, ready: multiprocessing.Queue[object]) -> None:
    """Write the files of a run line by line, and serve its page. The time to write the files is not counted."""
    with closing(ChangeFeed(directory)) as feed, closing(ChangeLog()) as log:
        async with LivePageServer(log, directory, live=True).open(0) as address:
            ready.put(address)
            log.append([feed.run_change(live=True)])
            files = {path: (directory / path).open("ab", buffering=0) for _, path, _ in lines}
            spent = time.process_time()
            at, end_s, now_s, polls = 0, lines[-1][0], 0.0, 0
            while now_s < end_s:
                now_s += UPDATE_S * speedup
                growing = time.process_time()
                while at < len(lines) and lines[at][0] <= now_s:
                    files[lines[at][1]].write(lines[at][2])
                    at += 1
                spent += time.process_time() - growing
                more = True
                while more:
                    changes, more = feed.poll()
                    log.append(changes)
                polls += 1
                await asyncio.sleep(UPDATE_S if polls % 10 == 0 else 0.002)
            cost = time.process_time() - spent
            ready.put((cost, polls, log.size, at))


def read(address: str) -> None:
    """Read all messages of the server like a browser, without drawing them."""

    async def listen() -> None:
        async with aiohttp.ClientSession() as client, client.ws_connect(f"{address}live", max_msg_size=0) as socket:
            async for _ in socket:
                pass

    asyncio.run(listen())


def served(directory: Path, lines: Written, speedup: float, ready: multiprocessing.Queue[object]) -> None:
    asyncio.run(serve(directory, lines, speedup, ready))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--agents", type=int, default=50, help="number of agents")
    parser.add_argument("--minutes", type=float, default=4.0, help="minutes of mission")
    parser.add_argument("--speedup", type=float, default=1.0, help="mission seconds per second")
    asked = parser.parse_args()
    with TemporaryDirectory() as place:
        source, growing = Path(place) / "run", Path(place) / "growing"
        played(source, asked.agents, asked.minutes)
        lines = written(source)
        (growing / "agents").mkdir(parents=True)
        (growing / "run.json").write_bytes((source / "run.json").read_bytes())
        for _, path, _ in lines:
            (growing / path).touch()
        ready: multiprocessing.Queue[object] = multiprocessing.Queue()
        server = multiprocessing.Process(target=served, args=(growing, lines, asked.speedup, ready))
        server.start()
        browser = multiprocessing.Process(target=read, args=(ready.get(),), daemon=True)
        browser.start()
        cost, polls, told, count = ready.get()  # type: ignore[misc]
        server.join()
        browser.terminate()
    live_s = polls * UPDATE_S
    print(  # noqa: T201
        f"{asked.agents} vehicles at {asked.speedup:g}x, {count} lines in {live_s:.0f} s of wall time at 10 updates "
        f"a second: {cost:.1f} s of processor time, {cost / live_s:.1%} of a core; "
        f"{told / live_s / 1000:.0f} kB/s to the browser"
    )


if __name__ == "__main__":
    main()
