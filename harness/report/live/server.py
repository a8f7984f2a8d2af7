"""The server of the page: on 127.0.0.1 alone, and for whoever has the address with its token, nobody else.

What it serves is a table made at its start, so no address leads to any other file. Browsers are told that they may load
from here and nowhere else. Other pages in the same browser are kept out thrice: they do not know the token, they cannot
hide where they come from (Origin), and a name of theirs that leads to 127.0.0.1 is not ours (Host).
"""

import asyncio
import contextlib
import hmac
import json
import os
import secrets
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aiohttp import WSCloseCode, WSMsgType, web

from harness.errors import MachineError
from harness.report.html import PALETTE
from harness.report.live._agent_course import Change
from harness.report.live.change_log import Story

_PAGE = Path(__file__).parent / "page"
_TYPES = {".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}
MAX_READERS = 16
MAX_MESSAGE_BYTES = 4096
"""Of what a page has to say."""
UPDATE_S = 0.1
GONE_S = 20.0
"""A browser that is silent for so long is gone."""

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]
Ask = Callable[[int, Any], None]
"""Is told which page asks for what; `Server.answer` brings the answer."""
MOST_ANSWERS = 32
"""Of one page that are on their way; it asks faster than it listens, and further ones are lost."""


@dataclass(frozen=True)
class _File:
    content: bytes
    content_type: str


def _files() -> Mapping[str, _File]:
    files = {
        str(path.relative_to(_PAGE)): _File(path.read_bytes(), _TYPES[path.suffix])
        for path in sorted(_PAGE.rglob("*"))
        if path.suffix in _TYPES
    }
    return {"palette.css": _File(PALETTE.encode(), _TYPES[".css"]), **files}


class _Page:
    """One that is open somewhere."""

    def __init__(self, socket: web.WebSocketResponse) -> None:
        self.socket = socket
        self.answers: deque[str] = deque(maxlen=MOST_ANSWERS)


class Server:
    """Serves one story. `live` is whether the run that it is of goes on."""

    def __init__(self, story: Story, directory: Path, *, live: bool, ask: Ask | None = None) -> None:
        self.live = live
        self._story, self._directory, self._ask = story, directory, ask
        self._token = secrets.token_urlsafe(24)
        self._files = _files()
        self._hosts: tuple[str, ...] = ()
        self._pages: dict[int, _Page] = {}
        self._opened = 0

    @contextlib.asynccontextmanager
    async def open(self, port: int) -> AsyncIterator[str]:
        """The address of the page; `port` 0 is a free one. Raises MachineError if the port cannot be had."""
        application = web.Application(middlewares=[self._guard], client_max_size=MAX_MESSAGE_BYTES)
        application.router.add_get("/{token}/live", self._tell)
        application.router.add_get("/{token}/report.html", self._report)
        application.router.add_get("/{token}/{name:.*}", self._file)
        runner = web.AppRunner(application, access_log=None, shutdown_timeout=1.0, handle_signals=False)
        await runner.setup()
        try:
            site = web.TCPSite(runner, "127.0.0.1", port)
            try:
                await site.start()
            except OSError as error:
                why = os.strerror(error.errno or 0)
                raise MachineError(
                    f"port {port} of 127.0.0.1 is not available: {why}; choose another port, or 0 for a free one"
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
        """Nobody without the token, and no other page, comes further."""
        token = request.path.split("/")[1]
        origin = request.headers.get("Origin")
        strange = request.host not in self._hosts or origin not in (None, *(f"http://{host}" for host in self._hosts))
        if strange or not hmac.compare_digest(token.encode(), self._token.encode()):
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
        here = " ".join(f"ws://{host}" for host in self._hosts)
        policy = (
            f"default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self' {here}; "
            "img-src 'self' data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        )
        return web.Response(
            body=file.content,
            content_type=file.content_type,
            charset="utf-8",
            headers={"Content-Security-Policy": policy, "Cross-Origin-Opener-Policy": "same-origin"},
        )

    async def _report(self, request: web.Request) -> web.StreamResponse:
        """The run's report. It may be of anybody's making: it is shown as if it came from nowhere."""
        path = self._directory / "report.html"
        if not path.is_file():
            raise web.HTTPNotFound
        policy = "sandbox allow-scripts allow-popups; frame-ancestors 'none'"
        return web.FileResponse(path, headers={"Content-Security-Policy": policy, "Content-Type": "text/html"})

    async def _tell(self, request: web.Request) -> web.WebSocketResponse:
        if self.readers >= MAX_READERS:
            raise web.HTTPServiceUnavailable(reason=f"{MAX_READERS} pages are open, which is the maximum: close one")
        socket = web.WebSocketResponse(heartbeat=GONE_S, max_msg_size=MAX_MESSAGE_BYTES, compress=False)
        await socket.prepare(request)
        self._opened += 1
        number, page = self._opened, _Page(socket)
        self._pages[number] = page
        listening = asyncio.create_task(self._listen(number, socket))
        try:
            await self._read_out(page)
        except ConnectionError:
            pass  # the browser went away
        finally:
            del self._pages[number]
            listening.cancel()
        return socket

    @property
    def readers(self) -> int:
        """How many pages are open."""
        return len(self._pages)

    def answer(self, page: int, answer: Change) -> None:
        """Tell one page alone, if it is still open."""
        if page in self._pages:
            self._pages[page].answers.append(json.dumps(answer) + "\n")

    async def _read_out(self, page: _Page) -> None:
        """Send answers and the story, as fast as the browser takes them and no faster."""
        start, caught_up = 0, False
        while not page.socket.closed:
            if page.answers:
                await page.socket.send_str(page.answers.popleft())
            start, lines = self._story.read(start, may_skip=self.live and caught_up)
            if lines:
                await page.socket.send_str(lines)
            elif start >= self._story.size:
                caught_up = True
                await asyncio.sleep(UPDATE_S)

    async def _listen(self, page: int, socket: web.WebSocketResponse) -> None:
        """Hear what the page asks for, and when it closes."""
        async for message in socket:
            if message.type is WSMsgType.TEXT and self._ask is not None and self.live:
                with contextlib.suppress(ValueError, RecursionError):
                    self._ask(page, json.loads(message.data))
        await socket.close()
