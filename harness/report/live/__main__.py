"""Serve the live page of a run in a separate process: `python -m harness.report.live DIRECTORY PORT`.

The server is a separate process, so that it does not delay the run and its failure does not affect the run.
`harness.report.live.server_process` describes the messages between the two processes. After the run the server
continues while a page is open. If the process of the run ends, the server ends immediately.
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
from harness.report.live.feed import ChangeFeed, RunClock
from harness.report.live.server import UPDATE_S, ChangeLog, LivePageServer, copy_live_run

MAX_UNWATCHED_S = 3.0
"""If no page is open for this number of seconds, the server ends. A page that is reloaded connects again within this
time.
"""


async def main(directory: Path, port: int) -> None:
    reader = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), sys.stdin)
    log, ended, clock = ChangeLog(), asyncio.Event(), RunClock()
    server = LivePageServer(log, directory, live=True, on_request=_send_request)
    async with server.open(port) as address:
        _print(address)
        following = asyncio.create_task(_follow_run(directory, log, ended, clock))
        if not await _read_until_over(reader, server, log, clock):
            return
        ended.set()
        await following
        server.live = False
        _print(str(server.readers))
        page_open = asyncio.create_task(_wait_until_unwatched(server))
        run_process_ended = asyncio.create_task(reader.read(1))
        await asyncio.wait({page_open, run_process_ended}, return_when=asyncio.FIRST_COMPLETED)


def _print(line: str) -> None:
    print(line, flush=True)  # noqa: T201


def _send_request(page: int, request: Any) -> None:
    """Send the request of a browser page to the process that carries out the run."""
    if isinstance(request, dict):
        _print(json.dumps([page, request.get("number"), request]))


async def _read_until_over(
    reader: asyncio.StreamReader, server: LivePageServer, log: ChangeLog, clock: RunClock
) -> bool:
    """Read messages from the process that carries out the run, until the run has ended. Return false if this process
    ended before the run.
    """
    while line := await reader.readline():
        kind, *rest = json.loads(line)
        if kind == "over":
            return True
        if kind == "answer":
            page, number, answer = rest
            server.answer(page, ["answer", number, answer])
        elif kind == "t":
            clock.report(rest[0])
        else:
            log.append([[kind, *rest]])
    return False


async def _follow_run(directory: Path, log: ChangeLog, ended: asyncio.Event, clock: RunClock) -> None:
    while not (directory / RUN_FILE).exists():
        if ended.is_set():
            return
        await asyncio.sleep(UPDATE_S)
    try:
        with contextlib.closing(ChangeFeed(directory)) as feed:
            await copy_live_run(feed, log, ended, clock)
    except HarnessError as error:
        log.append([["note", str(error)]])  # the run goes on without the page


async def _wait_until_unwatched(server: LivePageServer) -> None:
    unwatched_s = MAX_UNWATCHED_S if server.readers == 0 else 0.0
    while unwatched_s < MAX_UNWATCHED_S:
        await asyncio.sleep(UPDATE_S)
        unwatched_s = 0.0 if server.readers else unwatched_s + UPDATE_S


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C stops the run, and the run then sends "over"
    try:
        asyncio.run(main(Path(sys.argv[1]), int(sys.argv[2])))
    except HarnessError as error:
        sys.stderr.write(f"{error}\n")
        sys.exit(error.exit_status)
