"""Test that a breakpoint in a handler stops a replay with the agent's real state, in pdb and in an IDE.

The tests control a debugger with the Debug Adapter Protocol, and read the state of the debugged program, like an IDE.
"""

import json
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from harness.field.replay import RecordPlayer, open_record
from tests.harness.command import DEADLINE_S
from tests.harness.field.flights import flown, trace_of
from ucp import reconcile

DAP_DEADLINE_S = 60.0


class Ide:
    """A client that connects to the debugger at `port`. Raises OSError if no debugger answers in time."""

    def __init__(self, port: int) -> None:
        self._connection = _connect(port)
        self._file = self._connection.makefile("rwb")
        self._sequence = 0
        self._events: list[dict[str, Any]] = []

    def close(self) -> None:
        self._file.close()
        self._connection.close()

    def attach(self, breakpoints: dict[Path, int]) -> None:
        """Connect to the program. In each file, set one breakpoint at the given line."""
        self.ask("initialize", adapterID="test", pathFormat="path", linesStartAt1=True)
        attaching = self._send("attach", {"justMyCode": False})
        self.event("initialized")
        for path, line in breakpoints.items():
            (set_there,) = self.ask("setBreakpoints", source={"path": str(path)}, breakpoints=[{"line": line}])[
                "breakpoints"
            ]
            assert set_there["verified"], set_there
        self.ask("configurationDone")
        self._answer(attaching)

    def stopped_in(self) -> dict[str, Any]:
        """Return the stack frame in which the program has stopped."""
        thread = self.event("stopped")["threadId"]
        frame: dict[str, Any] = self.ask("stackTrace", threadId=thread)["stackFrames"][0]
        return {**frame, "thread": thread}

    def value(self, expression: str, frame: dict[str, Any]) -> str:
        return str(self.ask("evaluate", expression=expression, frameId=frame["id"], context="watch")["result"])

    def ask(self, command: str, **arguments: Any) -> dict[str, Any]:
        return self._answer(self._send(command, arguments))

    def event(self, name: str) -> dict[str, Any]:
        """Return the body of the next event of this name."""
        while True:
            for number, event in enumerate(self._events):
                if event["event"] == name:
                    del self._events[number]
                    body: dict[str, Any] = event.get("body") or {}
                    return body
            self._receive()

    def _send(self, command: str, arguments: dict[str, Any]) -> int:
        self._sequence += 1
        request = {"type": "request", "seq": self._sequence, "command": command, "arguments": arguments}
        content = json.dumps(request).encode()
        self._file.write(b"Content-Length: %d\r\n\r\n%b" % (len(content), content))
        self._file.flush()
        return self._sequence

    def _answer(self, sequence: int) -> dict[str, Any]:
        while True:
            message = self._receive()
            if message["type"] == "response" and message["request_seq"] == sequence:
                assert message["success"], message
                body: dict[str, Any] = message.get("body") or {}
                return body

    def _receive(self) -> dict[str, Any]:
        length = 0
        while (line := self._file.readline()) not in (b"\r\n", b""):
            if line.lower().startswith(b"content-length:"):
                length = int(line.split(b":")[1])
        content = self._file.read(length)
        assert content, "the debugger is gone"
        message: dict[str, Any] = json.loads(content)
        if message["type"] == "event":
            self._events.append(message)
        return message


def _connect(port: int) -> socket.socket:
    deadline = time.monotonic() + DAP_DEADLINE_S
    while True:
        try:
            connection = socket.create_connection(("127.0.0.1", port), timeout=DAP_DEADLINE_S)
        except OSError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.05)
        else:
            return connection


SOURCE = Path(reconcile.__file__).resolve()
LINE = next(
    number
    for number, text in enumerate(SOURCE.read_text().splitlines(), 1)
    if "core.majority_response_block_hash = majority_response" in text
)
"""A line of Algorithm 15. When it runs, phase 2 has chosen a block."""


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return trace_of(flown(tmp_path_factory.mktemp("flight") / "run", duration_s=900), 2)


@pytest.fixture(scope="module")
def expected(record: Path) -> tuple[float, int]:
    """Return the mission second at which the agent first reaches the line, and the length of its chain at this time."""
    player = RecordPlayer(open_record(record))
    while not player.at_end:
        entry = player.forward()
        if getattr(entry.content, "branch", "") in ("block", "tie: block"):
            return player.state.now, len(player.state.chain)
    raise AssertionError("no mission of this loss is without a reconcile")


def pdb(commands: list[str], *arguments: object) -> str:
    ended = subprocess.run(
        [sys.executable, *map(str, arguments)],
        input="\n".join(commands) + "\n",
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
    )
    return ended.stdout + ended.stderr


def test_pdb_stops_in_a_handler_with_the_agent_state(record: Path, expected: tuple[float, int]) -> None:
    said = pdb(
        [f"break {SOURCE}:{LINE}", "continue", "p (core.now, len(core.chain), core.agent_id)", "quit"],
        *("-m", "pdb", "-m", "harness.cli", "replay", record),
    )
    assert f"{SOURCE}({LINE})reconcile_phase_2_timer_expiration()" in said
    assert str((*expected, 2)) in said


def test_replay_calls_the_debugger_directly_before_the_handler(record: Path, expected: tuple[float, int]) -> None:
    line = next(entry.line for entry in open_record(record).entries if getattr(entry.content, "algorithm", 0) == 15)
    said = pdb(
        ["step", "where", "p (core.now, len(core.chain))", "quit"],
        *("-m", "harness.cli", "replay", record, "--break", line, "--debug"),
    )
    assert "reconcile_phase_2_timer_expiration()" in said
    assert str(expected) in said


@pytest.mark.parametrize("calls_it", [False, True], ids=["a breakpoint", "--debug"])
def test_ide_stops_in_a_handler_with_the_agent_state(calls_it: bool, record: Path, expected: tuple[float, int]) -> None:
    pytest.importorskip("debugpy")
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    under = ["-Xfrozen_modules=off", "-m", "debugpy", "--listen", f"127.0.0.1:{port}", "--wait-for-client"]
    line = next(entry.line for entry in open_record(record).entries if getattr(entry.content, "algorithm", 0) == 15)
    options = ["--break", str(line), "--debug"] if calls_it else []
    with subprocess.Popen(
        [sys.executable, *under, "-m", "harness.cli", "replay", str(record), *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    ) as replaying:
        try:
            ide = Ide(port)
            ide.attach({} if calls_it else {SOURCE: LINE})
            frame = ide.stopped_in()
            if calls_it:
                assert frame["name"] == "stop_and_run"
                ide.ask("stepIn", threadId=frame["thread"])
                frame = ide.stopped_in()
            assert frame["name"] == "reconcile_phase_2_timer_expiration"
            assert calls_it or frame["line"] == LINE
            assert Path(frame["source"]["path"]) == SOURCE
            assert ide.value("(core.now, len(core.chain), core.agent_id)", frame) == str((*expected, 2))
            ide.ask("setBreakpoints", source={"path": str(SOURCE)}, breakpoints=[])
            ide.ask("continue", threadId=frame["thread"])
            ide.event("terminated")
            ide.close()
            out, _ = replaying.communicate(timeout=DEADLINE_S)
            assert replaying.returncode == 0
            assert "no difference" in out.decode()
        finally:
            replaying.kill()
