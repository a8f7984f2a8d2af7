"""Test the web server of the live page: the control of access, and slow or closed browsers.

Test that a web server which fails, hangs or is slow does not affect the run.

Test the error messages of `ucp-harness watch` and `run --watch`.
"""

import asyncio
import json
import socket
import sys
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from urllib.parse import urlsplit

import aiohttp
import pytest

from harness.errors import MachineError
from harness.play.interventions import Interventions
from harness.report.live import server as servers
from harness.report.live import server_process as module
from harness.report.live.server import ChangeLog, LivePageServer
from harness.report.live.server_process import live_page, require_packages
from harness.scenario import Scenario
from tests.harness.command import harness, sentences

HOSTILE = "</script><img src=x onerror=alert(1)>"


@asynccontextmanager
async def served(directory: Path, log: ChangeLog | None = None) -> AsyncIterator[tuple[aiohttp.ClientSession, str]]:
    async with (
        LivePageServer(log or ChangeLog(), directory, live=True).open(0) as address,
        aiohttp.ClientSession() as client,
    ):
        yield client, address


def test_only_the_address_with_the_token_opens_the_page(tmp_path: Path) -> None:
    async def visit() -> None:
        async with served(tmp_path) as (client, address):
            port = urlsplit(address).port
            async with client.get(address) as page:
                assert page.status == 200
                policy = page.headers["Content-Security-Policy"]
                assert "unsafe" not in policy
                assert "default-src 'none'" in policy
                assert 'src="watch.js"' in await page.text()
            for path in ("/", "/live", "/watch.js", "/wrong/", "/wrong/live", "/%C3%A9/", address[:-2]):
                url = path if path.startswith("http") else f"http://127.0.0.1:{port}{path}"
                async with client.get(url) as refused:
                    assert refused.status == 403
                    assert await refused.text() == "This page needs the full address that ucp-harness printed.\n"
            for headers in (
                {"Host": f"evil.example:{port}"},
                {"Origin": "http://evil.example"},
                {"Origin": "null"},
                {"Host": "127.0.0.1:1"},
            ):
                for path in ("", "live", "watch.js", "report.html"):
                    async with client.get(address + path, headers=headers) as refused:
                        assert refused.status == 403, (headers, path)

    asyncio.run(visit())


def test_malformed_requests_are_answered_and_not_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    async def ask(port: int, request: bytes) -> int:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(request)
        status = int((await reader.readline()).split()[1])
        writer.close()
        return status

    async def visit() -> None:
        async with served(tmp_path) as (_, address):
            port = urlsplit(address).port or 0
            assert await ask(port, b"CONNECT 127.0.0.1:80 HTTP/1.1\r\nHost: x\r\n\r\n") == 403
            for request in (b"GET http://[::1 HTTP/1.1", b"GET / HTTP/9.9", b"\x16\x03\x01", b"GET / HTTP/1.1\r\nA"):
                assert await ask(port, request + b"\r\n\r\n") == 400

    asyncio.run(visit())
    assert caplog.text == ""


def test_no_address_leads_to_another_file(tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text("secret")

    async def visit() -> None:
        async with served(tmp_path) as (client, address):
            port, token = urlsplit(address).port, urlsplit(address).path
            for path in (
                "../server.py",
                "%2e%2e/server.py",
                "vendor/../../server.py",
                "run.json",
                "/etc/passwd",
                "%00",
            ):
                reader, writer = await asyncio.open_connection("127.0.0.1", port)
                request = f"GET {token}{path} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nConnection: close\r\n\r\n"
                writer.write(request.encode())
                answer = await reader.read()
                writer.close()
                assert answer.split()[1] in (b"403", b"404", b"400"), path
                assert b"secret" not in answer
            async with client.get(f"{address}vendor/d3/d3.min.js") as library:
                assert library.status == 200
            async with client.get(f"{address}report.html") as report:
                assert report.status == 404

    asyncio.run(visit())


def test_report_is_served_in_a_sandbox(tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text(HOSTILE)

    async def visit() -> None:
        async with served(tmp_path) as (client, address), client.get(f"{address}report.html") as report:
            assert report.headers["Content-Security-Policy"].startswith("sandbox allow-scripts")
            assert "allow-same-origin" not in report.headers["Content-Security-Policy"]

    asyncio.run(visit())


def test_page_receives_all_changes_from_the_start(tmp_path: Path) -> None:
    log = ChangeLog()
    log.append([["run", {"name": HOSTILE}], ["t", 1.0]])

    async def visit() -> None:
        async with served(tmp_path, log) as (client, address), client.ws_connect(f"{address}live") as socket:
            first = (await socket.receive_str()).splitlines()
            assert [json.loads(line) for line in first] == [["run", {"name": HOSTILE}], ["t", 1.0]]
            log.append([["t", 2.0]])
            assert json.loads(await socket.receive_str()) == ["t", 2.0]
            await socket.send_str("x" * (servers.MAX_MESSAGE_BYTES + 1))
            assert (await socket.receive()).type is aiohttp.WSMsgType.CLOSE, "who says too much is not listened to"

    asyncio.run(visit())


def test_browser_that_does_not_read_delays_no_other_page(tmp_path: Path) -> None:
    log = ChangeLog()

    async def visit() -> None:
        server = LivePageServer(log, tmp_path, live=True)
        async with server.open(0) as address, aiohttp.ClientSession() as client:
            port, path = urlsplit(address).port, urlsplit(address).path
            key = "dGhlIHNhbXBsZSBub25jZQ=="
            slow, writer = await asyncio.open_connection("127.0.0.1", port, limit=1024)
            writer.write(
                f"GET {path}live HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
                f"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: {key}\r\n\r\n".encode()
            )
            assert b"101" in await slow.readline()
            began = time.process_time()
            for _ in range(40):  # 40 MB, of which it reads nothing
                log.append([["note", "x" * 1_000_000]])
            async with client.ws_connect(f"{address}live", max_msg_size=0) as socket:
                received = 0
                while received < log.size:
                    received += len(await socket.receive_str())
            assert server.readers >= 1
            assert time.process_time() - began < 30
            writer.transport.abort()
            for _ in range(100):
                if server.readers == 0:
                    break
                await asyncio.sleep(0.05)
            assert server.readers == 0, "who is gone is forgotten"

    asyncio.run(visit())


def test_number_of_open_pages_is_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(servers, "MAX_READERS", 1)

    async def visit() -> None:
        async with (
            served(tmp_path) as (client, address),
            client.ws_connect(f"{address}live"),
            client.get(f"{address}live") as refused,
        ):
            assert refused.status == 503
            assert "1 pages are open" in await refused.text()

    asyncio.run(visit())


def test_used_port_is_reported_in_one_sentence(tmp_path: Path) -> None:
    async def visit() -> None:
        async with served(tmp_path) as (_, address):
            port = urlsplit(address).port
            assert port is not None
            with pytest.raises(MachineError, match=f"port {port} of 127.0.0.1 is not available: .*use"):
                async with LivePageServer(ChangeLog(), tmp_path, live=False).open(port):
                    pass

    asyncio.run(visit())


def test_server_listens_on_the_loopback_address_only(tmp_path: Path) -> None:
    async def visit() -> None:
        async with served(tmp_path) as (_, address):
            assert urlsplit(address).hostname == "127.0.0.1"
            port = f"{urlsplit(address).port:04X}"
            listening = [line.split()[1] for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
            assert {local for local in listening if local.endswith(f":{port}")} == {f"0100007F:{port}"}
            assert not any(f":{port} " in line for line in Path("/proc/net/tcp6").read_text().splitlines()[1:])

    asyncio.run(visit())


HAND = Interventions(Scenario(name="watched"), virtual_time=True)
MUCH = "head -c 300000 /dev/zero | tr '\\0' 'x' >&2; echo >&2"
"""Code that writes more bytes to standard error than a pipe holds."""


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the path of a program that runs in place of the server. A test writes this program."""
    program = tmp_path / "server"
    program.touch(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    return program


def test_dead_server_with_much_output_is_reported_after_the_run(server: Path, tmp_path: Path) -> None:
    server.write_text(f"#!/bin/sh\n{MUCH}\necho http://here/\n{MUCH}\necho 'no more memory' >&2\nkill -9 $$\n")
    with live_page(tmp_path, 0, HAND) as page:
        assert page.address == "http://here/"
        assert not page.run_is_over()
        assert page.problem == "the server of the page ended by itself with SIGKILL (no more memory); the run continued"


def test_hung_server_ends_with_the_run(server: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "LAST_LOOK_S", 0.1)
    monkeypatch.setattr(module, "ENDING_S", 0.1)
    server.write_text("#!/bin/sh\ntrap '' TERM\necho http://here/\nexec sleep 1000\n")
    with live_page(tmp_path, 0, HAND) as page:
        for _ in range(module.MAX_OUTGOING):  # more than a pipe holds
            page._send(["t", 100.0])
        assert not page.run_is_over()
        assert page.problem == "the page hung: its server did not answer within 0.1 s after the run"


def test_server_that_cannot_start_gives_the_reason(server: Path, tmp_path: Path) -> None:
    server.write_text(f"#!/bin/sh\n{MUCH}\necho 'port 80 of 127.0.0.1 cannot be had' >&2\nexit 3\n")
    with pytest.raises(MachineError, match=r"port 80 of 127\.0\.0\.1 cannot be had"), live_page(tmp_path, 0, HAND):
        pass


def test_directory_without_a_run_is_refused(tmp_path: Path) -> None:
    done = harness("watch", tmp_path)
    assert done.returncode == 2
    assert len(sentences(done.stderr)) == 1
    assert "neither a run directory" in done.stderr


def test_used_port_is_reported_before_the_run_begins(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        done = harness("run", "perfect", "--backend", "sim", "--watch", "--watch-port", port, "--out", tmp_path / "run")
    assert done.returncode == 3
    assert sentences(done.stderr) == [
        f"port {port} of 127.0.0.1 is not available: Address already in use; choose another port, or 0 for a free one"
    ]
    assert not (tmp_path / "run").exists()


def test_missing_package_is_reported_with_the_install_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "aiohttp", None)
    with pytest.raises(MachineError, match=r"pip install 'ucp-harness\[watch\]'"):
        require_packages()


def test_run_without_open_pages_ends_normally(tmp_path: Path) -> None:
    done = harness("run", "perfect", "--backend", "sim", "--speedup", 1000, "--watch", "--out", tmp_path / "run")
    assert done.returncode == 0, done.stderr
    assert "watch it at http://127.0.0.1:" in done.stdout
    assert (tmp_path / "run" / "report.html").is_file()
