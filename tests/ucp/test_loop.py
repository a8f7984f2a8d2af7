"""Test the event loop of an agent's process, and the control socket that uses it."""

import json
import os
import signal
import socket
from pathlib import Path
from typing import Any

import pytest

from tests.ucp.loops import run_until
from ucp.control import MAX_LINE_BYTES, ControlServer
from ucp.loop import Loop


def test_loop_calls_due_timers_in_order_and_skips_cancelled_ones() -> None:
    loop, came = Loop(), []
    loop.call_later(0.02, lambda: came.append("third"))
    loop.call_later(0.01, lambda: came.append("second"))
    loop.call_later(0.015, lambda: came.append("cancelled")).cancel()
    loop.call_later(-1.0, lambda: came.append("first"))
    run_until(loop, lambda: len(came) == 3)
    assert came == ["first", "second", "third"]


def test_exception_of_a_callback_is_reported_or_ends_the_loop() -> None:
    failures: list[Exception] = []
    loop, after = Loop(failures.append), []
    loop.call_later(0, lambda: 1 / 0)
    loop.call_later(0, lambda: after.append(1))
    run_until(loop, lambda: bool(after))
    assert [type(failure) for failure in failures] == [ZeroDivisionError]
    loop = Loop()
    loop.call_later(0, lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        loop.run()


def test_loop_does_not_call_back_a_closed_socket() -> None:
    loop, read = Loop(), []
    pairs = [socket.socketpair() for _ in range(2)]

    def close_both() -> None:
        read.append(1)
        for ours, _ in pairs:
            loop.watch(ours)
            ours.close()

    for ours, theirs in pairs:
        loop.watch(ours, readable=close_both)
        theirs.send(b"x")
    run_until(loop, lambda: bool(read), after_s=0.02)
    assert read == [1]


def test_signal_ends_a_loop_without_sockets_and_timers() -> None:
    before = signal.getsignal(signal.SIGUSR1)
    loop = Loop()
    loop.stop_on(signal.SIGUSR1)
    try:
        os.kill(os.getpid(), signal.SIGUSR1)
        loop.run()
    finally:
        loop.close()
        signal.signal(signal.SIGUSR1, before)


class Client:
    def __init__(self, path: Path, loop: Loop) -> None:
        self.loop = loop
        self.socket = socket.socket(socket.AF_UNIX)
        self.socket.connect(os.path.relpath(path))
        self.socket.setblocking(False)
        self.heard = b""

    def hear(self) -> bool:
        """Return whether the server has closed the connection."""
        try:
            data = self.socket.recv(1 << 20)
        except BlockingIOError:
            return False
        except ConnectionError:
            return True
        self.heard += data
        return not data

    def answers(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.heard.splitlines()]


@pytest.fixture
def client(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Client:
    monkeypatch.chdir(tmp_path)
    loop = Loop()
    ControlServer(tmp_path / "7.control", {"echo": lambda request: {"text": request.get("text")}}, loop).start()
    return Client(tmp_path / "7.control", loop)


def test_slow_client_gets_all_answers_in_order(client: Client) -> None:
    lines = [
        json.dumps({"command": "echo", "text": f"{number}" + "x" * 1000}).encode() + b"\n" for number in range(900)
    ]
    unsent = b"".join(lines)

    def send() -> bool:
        nonlocal unsent
        try:
            unsent = unsent[client.socket.send(unsent) :]
        except BlockingIOError:
            client.hear()
        return not unsent

    run_until(client.loop, send)
    run_until(client.loop, lambda: bool(client.hear() or client.heard.count(b"\n") == len(lines)))
    assert [int(answer["text"].rstrip("x")) for answer in client.answers()] == list(range(900))


def test_split_line_is_answered_and_an_endless_line_disconnects(client: Client) -> None:
    client.socket.send(b'{"command": ')
    run_until(client.loop, lambda: True, after_s=0.02)
    assert not client.hear()
    client.socket.send(b'"echo"}\nnonsense\n')
    run_until(client.loop, lambda: bool(client.hear() or client.heard.count(b"\n") == 2))
    assert [answer["ok"] for answer in client.answers()] == [True, False]
    unsent = b"x" * (2 * MAX_LINE_BYTES)

    def ended() -> bool:
        nonlocal unsent
        try:
            unsent = unsent[client.socket.send(unsent) :]
        except BlockingIOError:
            pass
        except ConnectionError:
            return True
        return client.hear()

    run_until(client.loop, ended)
