"""The web server of the live page. The server reads the changes of a run from a log. This module also contains the
functions that write the changes to the log.

The server listens on 127.0.0.1 only, and requires the secret token in the page's address.

At its start, the server makes a list of the files that it serves, so no address can reach another file. The
Content-Security-Policy lets browsers load from this server only. Three checks reject requests from other pages in the
same browser:

- A request without the secret token is rejected. Other pages do not know the token.
- A request with a foreign origin in the header Origin is rejected.
- A request with a foreign host name in the header Host is rejected. Such a request occurs if the foreign host name
  resolves to 127.0.0.1.

The log stores all changes for the live page. The changes of an active run are written as they occur, and the changes of
a finished run all at once. Any number of browsers can read the log, each at its own speed. The log is an unnamed
temporary file. Memory use is therefore bounded, and a slow reader does not delay the others.
"""

import asyncio
import contextlib
import hmac
import json
import logging
import os
import secrets
import tempfile
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from aiohttp import WSCloseCode, WSMsgType, web
from aiohttp.http_exceptions import HttpProcessingError

from harness.errors import MachineError
from harness.report.html import PALETTE
from harness.report.live._agent_course import Change
from harness.report.live.feed import ChangeFeed, RunClock

MAX_BYTES = 512 * 1024 * 1024
CHUNK_BYTES = 256 * 1024
FAR_BEHIND_BYTES = 4 * 1024 * 1024
"""Number of bytes. If a page is behind an active run by more than this number, it skips frequent changes, such as
messages and positions, to catch up.
"""
_LEFT_OUT = (b'["m"', b'["p"', b'["t"', b'["d"')

_encode = partial(json.dumps, separators=(",", ":"), check_circular=False)


class ChangeLog:
    """A log with one change per line. `size` is its size in bytes."""

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile()  # noqa: SIM115
        self.size = 0
        self._full = False

    def append(self, changes: Iterable[Change]) -> None:
        """Append changes to the log. Raises OSError if the disk is full."""
        lines = "".join([_encode(change) + "\n" for change in changes]).encode()
        if self._full or not lines:
            return
        if self.size + len(lines) > MAX_BYTES:
            self._full = True
            note = f"the page shows only the first {MAX_BYTES >> 20} MiB of changes"
            lines = (_encode(["note", note]) + "\n").encode()
        self._file.write(lines)
        self._file.flush()
        self.size += len(lines)

    def read(self, start: int, *, may_skip: bool = False) -> tuple[int, str]:
        """Return a pair: the position after the returned lines, and the complete lines that follow the position
        `start`.

        If `may_skip` is true and the reader is far behind, frequent changes such as messages and positions are omitted.
        """
        skips = may_skip and self.size - start > FAR_BEHIND_BYTES
        data = self._pread(start, FAR_BEHIND_BYTES if skips else CHUNK_BYTES)
        while b"\n" not in data and start + len(data) < self.size:
            data += self._pread(start + len(data), CHUNK_BYTES)
        whole = data[: data.rfind(b"\n") + 1]
        end = start + len(whole)
        if skips:
            whole = b"".join(line for line in whole.splitlines(keepends=True) if not line.startswith(_LEFT_OUT))
        return end, whole.decode()

    def close(self) -> None:
        self._file.close()

    def _pread(self, start: int, most: int) -> bytes:
        return os.pread(self._file.fileno(), min(most, self.size - start), start)


_PAGE = Path(__file__).parent / "page"
_TYPES = {".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}
MAX_READERS = 16
MAX_MESSAGE_BYTES = 4096
"""Maximum size in bytes of a message from a page."""
UPDATE_S = 0.1
GONE_S = 20.0
"""Seconds after which a browser that does not answer counts as disconnected."""

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]
RequestHandler = Callable[[int, Any], None]
"""A function that receives the number of a page and a request from this page. `LivePageServer.answer` sends the answer
to the page.
"""
MOST_ANSWERS = 32
"""Maximum number of answers that wait for one page. A further answer replaces the oldest one."""


@dataclass(frozen=True)
class _PageFile:
    content: bytes
    content_type: str


def _files() -> Mapping[str, _PageFile]:
    files = {
        str(path.relative_to(_PAGE)): _PageFile(path.read_bytes(), _TYPES[path.suffix])
        for path in sorted(_PAGE.rglob("*"))
        if path.suffix in _TYPES
    }
    return {"palette.css": _PageFile(PALETTE.encode(), _TYPES[".css"]), **files}


class _OpenPage:
    """A browser page that is connected to the server."""

    def __init__(self, socket: web.WebSocketResponse) -> None:
        self.socket = socket
        self.answers: deque[str] = deque(maxlen=MOST_ANSWERS)


class LivePageServer:
    """A web server that sends the log of one run to browsers. `live` is true if the run is still active."""

    def __init__(
        self, log: ChangeLog, directory: Path, *, live: bool, on_request: RequestHandler | None = None
    ) -> None:
        self.live = live
        self._log, self._directory, self._on_request = log, directory, on_request
        self._token = secrets.token_urlsafe(24)
        self._files = _files()
        self._hosts: tuple[str, ...] = ()
        self._pages: dict[int, _OpenPage] = {}
        self._opened = 0

    @contextlib.asynccontextmanager
    async def open(self, port: int) -> AsyncIterator[str]:
        """Run the server inside the context, and yield the address of the page.

        Port 0 means any free port. Raises MachineError if the port is not available.
        """
        application = web.Application(middlewares=[self._guard], client_max_size=MAX_MESSAGE_BYTES)
        application.router.add_get("/{token}/live", self._stream)
        application.router.add_get("/{token}/report.html", self._report)
        application.router.add_get("/{token}/{name:.*}", self._file)
        runner = web.AppRunner(application, access_log=None, shutdown_timeout=1.0, handle_signals=False, logger=_log())
        await runner.setup()
        try:
            site = web.TCPSite(runner, "127.0.0.1", port)
            try:
                await site.start()
            except OSError as error:
                reason = os.strerror(error.errno or 0)
                raise MachineError(
                    f"port {port} of 127.0.0.1 is not available: {reason}; choose another port, or 0 for a free one"
                ) from None
            bound = runner.addresses[0][1]
            self._hosts = f"127.0.0.1:{bound}", f"localhost:{bound}"
            yield f"http://127.0.0.1:{bound}/{self._token}/"
        finally:
            for page in list(self._pages.values()):
                with contextlib.suppress(ConnectionError, TimeoutError):
                    await asyncio.wait_for(page.socket.close(code=WSCloseCode.GOING_AWAY), 1.0)
            await runner.cleanup()

    @web.middleware
    async def _guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Refuse requests without the secret token, and requests from other web pages."""
        token = request.path.partition("/")[2].partition("/")[0]  # the path of CONNECT is empty
        origin = request.headers.get("Origin")
        foreign = request.host not in self._hosts or origin not in (None, *(f"http://{host}" for host in self._hosts))
        if foreign or not hmac.compare_digest(token.encode(), self._token.encode()):
            return web.Response(status=403, text="This page needs the full address that ucp-harness printed.\n")
        try:
            response = await handler(request)
        except web.HTTPException as error:
            return web.Response(status=error.status, text=f"{error.reason}.\n")
        if not response.prepared:
            response.headers.update(
                {"Referrer-Policy": "no-referrer", "X-Content-Type-Options": "nosniff", "Cache-Control": "no-store"}
            )
        return response

    async def _file(self, request: web.Request) -> web.Response:
        file = self._files.get(request.match_info["name"] or "index.html")
        if file is None:
            raise web.HTTPNotFound
        web_sockets = " ".join(f"ws://{host}" for host in self._hosts)
        policy = (
            f"default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self' {web_sockets}; "
            "img-src 'self' data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        )
        return web.Response(
            body=file.content,
            content_type=file.content_type,
            charset="utf-8",
            headers={"Content-Security-Policy": policy, "Cross-Origin-Opener-Policy": "same-origin"},
        )

    async def _report(self, request: web.Request) -> web.StreamResponse:
        """Return the report of the run. The report may come from an unknown author, so the browser shows it in a
        sandbox: its scripts run, but they have no access to this server.
        """
        path = self._directory / "report.html"
        if not path.is_file():
            raise web.HTTPNotFound
        policy = "sandbox allow-scripts allow-popups; frame-ancestors 'none'"
        return web.FileResponse(path, headers={"Content-Security-Policy": policy, "Content-Type": "text/html"})

    async def _stream(self, request: web.Request) -> web.WebSocketResponse:
        if self.readers >= MAX_READERS:
            raise web.HTTPServiceUnavailable(reason=f"{MAX_READERS} pages are open, which is the maximum: close one")
        socket = web.WebSocketResponse(heartbeat=GONE_S, max_msg_size=MAX_MESSAGE_BYTES, compress=False)
        await socket.prepare(request)
        self._opened += 1
        number, page = self._opened, _OpenPage(socket)
        self._pages[number] = page
        listening = asyncio.create_task(self._listen(number, socket))
        try:
            await self._send_changes(page)
        except ConnectionError:
            pass  # the browser closed the connection
        finally:
            del self._pages[number]
            listening.cancel()
        return socket

    @property
    def readers(self) -> int:
        """The number of open pages."""
        return len(self._pages)

    def answer(self, page: int, answer: Change) -> None:
        """Send the answer to the page that made the request, if this page is still open."""
        if page in self._pages:
            self._pages[page].answers.append(json.dumps(answer) + "\n")

    async def _send_changes(self, page: _OpenPage) -> None:
        """Send answers and changes to a page, no faster than its browser reads them."""
        start, caught_up = 0, False
        while not page.socket.closed:
            if page.answers:
                await page.socket.send_str(page.answers.popleft())
            start, lines = self._log.read(start, may_skip=self.live and caught_up)
            if lines:
                await page.socket.send_str(lines)
            elif start >= self._log.size:
                caught_up = True
                await asyncio.sleep(UPDATE_S)

    async def _listen(self, page: int, socket: web.WebSocketResponse) -> None:
        """Receive requests from the page until it is closed."""
        async for message in socket:
            if message.type is WSMsgType.TEXT and self._on_request is not None and self.live:
                with contextlib.suppress(ValueError, RecursionError):
                    self._on_request(page, json.loads(message.data))
        await socket.close()


def _log() -> logging.Logger:
    """Return a logger for errors of the server. The logger omits errors about malformed requests, because any program
    on this machine can send such requests.
    """
    log = logging.getLogger(__name__)
    log.addFilter(_is_own_error)
    return log


def _is_own_error(record: logging.LogRecord) -> bool:
    return record.exc_info is None or not isinstance(record.exc_info[1], HttpProcessingError)


STRIDE_S = 20.0
"""Mission seconds of a finished run that are read from all files in one step."""


async def copy_finished_run(feed: ChangeFeed, log: ChangeLog) -> None:
    """Write all changes of a finished run to a log, in order of time."""
    until_s = 0.0
    log.append([feed.run_change(live=False)])
    while True:
        changes, more = feed.poll(until_s)
        log.append(changes)
        await asyncio.sleep(0)
        if more:
            continue
        if (next_s := feed.next_s) is None:
            break
        until_s = max(until_s, next_s) + STRIDE_S
    log.append(feed.final_changes())


async def copy_live_run(feed: ChangeFeed, log: ChangeLog, ended: asyncio.Event, clock: RunClock) -> None:
    """Write the changes of an active run to a log until the run has a result. Also stop when the event `ended` is set,
    which means that the process of the run has ended. `clock` contains the mission seconds that the run reported.
    """
    log.append([feed.run_change(live=True)])
    while True:
        over = feed.over or ended.is_set()
        changes, more = feed.poll_live(clock)
        log.append(changes)
        if over and not more:
            break
        await asyncio.sleep(0 if more else UPDATE_S)
    log.append(feed.final_changes())
