"""A local server for firmware, with the same paths as ArduPilot's server. It works correctly, or fails as a test
requests.
"""

from __future__ import annotations

import contextlib
import hashlib
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

COMMIT = "3fc7011a7d3dc047cbb17d8bd98ee94577d144c6"
ELF = b"\x7fELF\x02\x01\x01" + bytes(9) + b"\x02\x00\x3e\x00" + bytes(44)
BINARY = ELF + bytes(range(256)) * 2000
PARAMETERS = b"# defaults\nFRAME_CLASS 1\nSIM_BARO_RND\t0\n"
RELEASE = "/Copter/stable/SITL_x86_64_linux_gnu/"
LISTING = b"""<html><title>ArduPilot firmware : /Copter</title><a href="/"><b>Parent Directory</B></a>
<td><a href="/Copter/2026-09">2026-09</A></td><td><a href="/Copter/latest">latest</A></td>
<td><a href="/Copter/stable">stable</A></td><td><a href="/Copter/stable-4.6.3">stable-4.6.3</A></td>
<td><a href="/Copter/stable-4.10.0">stable-4.10.0</A></td></html>
"""


def git_version(version: str = "4.6.3", commit: str = COMMIT) -> bytes:
    return (
        f"commit {commit}\nAuthor: A. Pilot <a@example.org>\nDate:   Mon Nov 3 12:38:46 2025 +0900\n\n"
        f"    Copter: version to {version}\n\nAPMVERSION: ArduCopter V{version}\n"
    ).encode()


@dataclass(frozen=True)
class Resource:
    """The content at one path, and the way in which the server sends it."""

    content: bytes
    status: int = 200
    headers: dict[str, str] = field(default_factory=dict)
    ranges: bool = True  # the server supports Range and If-Range
    heeds_if_range: bool = True
    range_from: int | None = None  # first byte of a partial answer, if it is not the requested one
    cut_after: int | None = None  # number of bytes after which the server closes the connection
    silent_after: int | None = None  # number of bytes after which the server sends nothing more
    announced: int | None = None  # the value of Content-Length, if it is wrong
    sized: bool = True  # whether the answer has a Content-Length
    chunked: bool = False
    etag: bool = True

    @property
    def tag(self) -> str:
        return f'"{hashlib.sha1(self.content).hexdigest()}"'  # noqa: S324 - names a content, guards nothing


@dataclass
class FirmwareServer:
    """A server with the contents `files` by path.

    A test may change `files`. The server records each request (path, Range header) and each answer (path, status).
    """

    files: dict[str, Resource]
    url: str = ""
    asked: list[tuple[str, str | None]] = field(default_factory=list)
    answered: list[tuple[str, int]] = field(default_factory=list)
    over: threading.Event = field(default_factory=threading.Event)

    def change(self, path: str, **how: object) -> None:
        self.files[path] = replace(self.files[path], **how)  # type: ignore[arg-type]

    def ranges_of(self, name: str) -> list[str | None]:
        return [range_ for path, range_ in self.asked if path.endswith(name)]

    def statuses_of(self, name: str) -> list[int]:
        return [status for path, status in self.answered if path.endswith(name)]


def copter_files() -> dict[str, Resource]:
    tree = f"/ArduPilot/ardupilot/{COMMIT}/Tools/autotest/default_params/copter.parm"
    return {
        "/Copter/": Resource(LISTING),
        f"{RELEASE}git-version.txt": Resource(git_version()),
        f"{RELEASE}arducopter": Resource(BINARY),
        tree: Resource(PARAMETERS),
    }


@contextlib.contextmanager
def serving() -> Iterator[FirmwareServer]:
    """Start a server that offers one stable copter firmware."""
    state = FirmwareServer(copter_files())

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            state.asked.append((self.path, self.headers["Range"]))
            self.close_connection = True
            resource = state.files.get(self.path)
            if resource is None:
                self.send_error(404)
                return
            body, status, headers = resource.content, resource.status, dict(resource.headers)
            if resource.etag:
                headers["ETag"] = resource.tag
            if self.headers["Range"] and resource.ranges:
                asked = int(self.headers["Range"].removeprefix("bytes=").removesuffix("-"))
                begin = asked if resource.range_from is None else resource.range_from
                if begin >= len(body):
                    self.send_response(416)
                    self.send_header("Content-Length", "0")
                    self.end_headers()
                    return
                if self.headers["If-Range"] == resource.tag or not resource.heeds_if_range:
                    status = 206
                    headers["Content-Range"] = f"bytes {begin}-{len(body) - 1}/{len(body)}"
                    body = body[begin:]
            if resource.chunked:
                headers["Transfer-Encoding"] = "chunked"
                body = b"%x\r\n%b\r\n0\r\n\r\n" % (len(body), body)
            elif resource.sized:
                headers["Content-Length"] = str(resource.announced or len(body))
            state.answered.append((self.path, status))
            self.send_response(status)
            for name, value in headers.items():
                self.send_header(name, value)
            self.end_headers()
            end = min(
                len(body), *(at for at in (resource.cut_after, resource.silent_after, len(body)) if at is not None)
            )
            with contextlib.suppress(OSError):  # the client has gone
                self.wfile.write(body[:end])
                if resource.silent_after is not None:
                    state.over.wait(10)

        def log_message(self, format: str, *arguments: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    state.url = f"http://127.0.0.1:{server.server_port}"
    try:
        yield state
    finally:
        state.over.set()
        server.shutdown()
        server.server_close()
        thread.join()
