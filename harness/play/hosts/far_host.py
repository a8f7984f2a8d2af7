"""Run the agents and vehicles of one run on a worker: `python -m harness.play.hosts.far_host`.

The first line of standard input is an order in JSON (`harness.play.hosts._worker_task.HostOrder`). The end of standard
input ends the program and its agents, so they end with the worker. Each agent joins the run as with `ucp-harness join`.
For the vehicle programs, the worker itself opens one more connection (`harness.play.hosts._vehicle_host`).
"""

import asyncio
import json
import os
import signal
import sys
from functools import partial
from io import FileIO
from pathlib import Path
from typing import Any

from harness.errors import HarnessError
from harness.play.hosts._nursery import OWN_AGENT, Nursery
from harness.play.hosts._vehicle_host import VehicleHost
from harness.play.remote._far_ends import WORKER
from harness.play.remote._wire import KEYS
from harness.play.remote.join import (
    JoinRequest,
    RunOverError,
    connect_patiently,
    directory_of_agents,
    play_incarnations,
)
from netem import far_network
from netem.errors import LabUnavailable

READ_BYTES = 4096


async def _play(order: dict[str, Any], nursery: Nursery, directory: Path) -> None:
    """Run all agents until the end of the run. If an agent fails, wait for the other agents, and then raise the first
    error.
    """
    address = order["host"], order["port"]
    secret = bytes.fromhex(order["secret"])
    playing = [
        _play_vehicles(JoinRequest(*address, WORKER, secret, [], service=False), order["worker"], nursery, directory)
    ]
    for agent, words in order["commands"].items():
        request = JoinRequest(*address, int(agent), secret, words or OWN_AGENT, service=False)
        folder = directory / agent
        folder.mkdir()
        (folder / KEYS).symlink_to((directory / KEYS).absolute())
        start = partial(nursery.start_agent, int(agent))
        playing.append(play_incarnations(request, start, lambda sentence: None, folder))
    for problem in await asyncio.gather(*playing, return_exceptions=True):
        if problem is not None:
            raise problem


async def _play_vehicles(request: JoinRequest, worker: str, nursery: Nursery, directory: Path) -> None:
    folder = directory / "vehicles"
    folder.mkdir()
    try:
        joined = await connect_patiently(request, worker)
    except RunOverError:
        return
    await VehicleHost(nursery, folder).run(joined)


async def _until_input_ends(work: Any) -> None:
    """Run a coroutine until it ends. Stop it earlier if standard input ends or a signal arrives."""
    loop, ended = asyncio.get_running_loop(), asyncio.Event()

    def read() -> None:
        if not os.read(sys.stdin.fileno(), READ_BYTES):
            loop.remove_reader(sys.stdin.fileno())
            ended.set()

    loop.add_reader(sys.stdin.fileno(), read)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        loop.add_signal_handler(number, ended.set)
    working, waiting = asyncio.create_task(work), asyncio.create_task(ended.wait())
    await asyncio.wait({working, waiting}, return_when=asyncio.FIRST_COMPLETED)
    waiting.cancel()
    if working.done():
        working.result()
        return
    working.cancel()
    await asyncio.gather(working, return_exceptions=True)


def main() -> None:
    order = json.loads(FileIO(sys.stdin.fileno(), closefd=False).readline())
    try:
        nursery = Nursery(user_namespace=far_network.needs_user_namespace())
        with directory_of_agents() as directory:
            asyncio.run(_until_input_ends(_play(order, nursery, directory)))
    except (HarnessError, LabUnavailable) as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main()
