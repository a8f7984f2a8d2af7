"""`python -m harness.report.live DIRECTORY PORT`: the server of the live page, as a process beside the run.

A separate process takes no time from the run and cannot break it. `harness.report.live.server_process` describes the
messages between the two processes. After the run the server stays while a page is open. It ends at once if the process
of the run ends.
"""

import asyncio
import contextlib
import json
import signal
import sys
from pathlib import Path
from typing import Any

from harness.archive.exports import RUN_FILE
from harness.errors import HarnessError
from harness.report.live.change_log import Story
from harness.report.live.feed import Feed
from harness.report.live.projector import tell_live
from harness.report.live.server import UPDATE_S, Server

LEFT_S = 3.0
"""Seconds without a page after which the server ends. A page that is reloaded reconnects within this time."""


async def main(directory: Path, port: int) -> None:
    reader = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), sys.stdin)
    story, ended = Story(), asyncio.Event()
    server = Server(story, directory, live=True, ask=_say)
    async with server.open(port) as address:
        _print(address)
        telling = asyncio.create_task(_tell(directory, story, ended))
        if not await _hear_until_over(reader, server, story):
            return
        ended.set()
        await telling
        server.live = False
        _print(str(server.readers))
        staying = asyncio.create_task(_while_looked_at(server))
        left = asyncio.create_task(reader.read(1))
        await asyncio.wait({staying, left}, return_when=asyncio.FIRST_COMPLETED)


def _print(line: str) -> None:
    print(line, flush=True)  # noqa: T201


def _say(page: int, asked: Any) -> None:
    """Send a page's request to the process of the run."""
    if isinstance(asked, dict):
        _print(json.dumps([page, asked.get("number"), asked]))


async def _hear_until_over(reader: asyncio.StreamReader, server: Server, story: Story) -> bool:
    """Read messages until the run is over. Return False if the process of the run ended instead."""
    while line := await reader.readline():
        kind, *rest = json.loads(line)
        if kind == "over":
            return True
        if kind == "answer":
            page, number, answer = rest
            server.answer(page, ["answer", number, answer])
        else:
            story.tell([[kind, *rest]])
    return False


async def _tell(directory: Path, story: Story, ended: asyncio.Event) -> None:
    while not (directory / RUN_FILE).exists():
        if ended.is_set():
            return
        await asyncio.sleep(UPDATE_S)
    try:
        with contextlib.closing(Feed(directory)) as feed:
            await tell_live(feed, story, ended)
    except HarnessError as error:
        story.tell([["note", str(error)]])  # the run goes on without the page


async def _while_looked_at(server: Server) -> None:
    alone_s = LEFT_S if server.readers == 0 else 0.0
    while alone_s < LEFT_S:
        await asyncio.sleep(UPDATE_S)
        alone_s = 0.0 if server.readers else alone_s + UPDATE_S


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C stops the run, and the run then sends "over"
    try:
        asyncio.run(main(Path(sys.argv[1]), int(sys.argv[2])))
    except HarnessError as error:
        sys.stderr.write(f"{error}\n")
        sys.exit(error.exit_status)
