"""Run the agents of one run on a worker: `python -m harness.play.hosts.far_host`.

The first line of standard input is an order in JSON (`harness.play.hosts._worker_task.HostOrder`). The end of standard
input ends the program and its agents, so they end with the worker. Each agent joins the run as with `ucp-harness join`.
"""

import asyncio
import json
import os
import signal
import sys
from io import FileIO
from pathlib import Path
from typing import Any

from harness.errors import HarnessError
from harness.play.remote.join import JoinRequest, directory_of_agents, first_process, play_incarnations

READ_BYTES = 4096


async def _play(order: dict[str, Any], command: list[str], directory: Path) -> None:
    """Run all agents until the end of the run. If an agent fails, end the other agents, and then raise the
    first error.
    """
    own = [sys.executable, "-P", "-m", "ucp.node"]
    playing = []
    for agent, words in order["commands"].items():
        request = JoinRequest(
            order["host"], order["port"], int(agent), bytes.fromhex(order["secret"]), words or own, service=False
        )
        folder = directory / agent
        folder.mkdir()
        playing.append(play_incarnations(request, command, lambda sentence: None, folder))
    for problem in await asyncio.gather(*playing, return_exceptions=True):
        if problem is not None:
            raise problem


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
        with directory_of_agents() as directory:
            asyncio.run(_until_input_ends(_play(order, first_process(), directory)))
    except HarnessError as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main()
