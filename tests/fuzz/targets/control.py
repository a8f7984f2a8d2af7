"""Fuzz target: the control socket of a running agent. Each line gets an answer, and the agent continues to run."""

import json
import os
import signal
import socket
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from harness.archive.exports import read_export
from harness.archive.traces import read_trace
from tests.fuzz.finding import FailedError, require
from ucp.control import MAX_LINE_BYTES
from ucp.mission import Mission, parse_mission
from ucp.node import Node

MOST_LINES = 30
_ANSWER_S = 10.0


def run(data: bytes) -> None:
    lines = [line for line in data.split(b"\n")[:MOST_LINES] if len(line) < MAX_LINE_BYTES - 1]
    with TemporaryDirectory() as folder:
        directory = Path(folder)
        node = Node(_mission(), directory)
        with ThreadPoolExecutor(1) as client:
            conversation = client.submit(_converse, directory, lines)
            with _own_signal_handlers():
                status = node.run()
        logged = (directory / "1.log").read_text()
        require("Traceback" not in logged, f"it logs {logged[-300:]}")
        conversation.result()
        require(status == 0, "it fails in the end")
        require(not (directory / "1.control").exists(), "the socket is left behind")
        read_export(directory / "1.chain.json")
        trace_file = directory / "1.trace.jsonl"
        if trace_file.stat().st_size:
            trace = read_trace(trace_file)
            require(trace is not None and not trace.problem and not trace.cut_off, "its trace cannot be read")


@contextmanager
def _own_signal_handlers() -> Iterator[None]:
    """Restore the signal handlers of this process, which the agent replaces."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


def _converse(directory: Path, lines: list[bytes]) -> None:
    """Send the lines from a second thread, and then end the agent."""
    try:
        path = directory / "1.control"
        deadline = time.monotonic() + _ANSWER_S
        while not path.exists():
            require(time.monotonic() < deadline, "it does not begin")
            time.sleep(0.001)
        with socket.socket(socket.AF_UNIX) as connection:
            connection.settimeout(_ANSWER_S)
            connection.connect(str(path))
            answers = connection.makefile("rb")
            for line in (*lines, b'{"command":"status"}'):
                connection.sendall(line + b"\n")
                answer = answers.readline()
                require(answer.endswith(b"\n"), f"no answer to {line[:200]!r}")
                _judge(line, answer)
    except OSError as error:
        raise FailedError(f"no answer: {error}") from None
    finally:
        os.kill(os.getpid(), signal.SIGTERM)


def _judge(line: bytes, answer: bytes) -> None:
    document = json.loads(answer, parse_constant=_no_number)
    require(isinstance(document, dict) and isinstance(document.get("ok"), bool), "the answer is none")
    require(document["ok"] or isinstance(document.get("error"), str), "it refuses, and does not say why")
    if not document["ok"]:
        require(len(document["error"]) < 500 and "\n" not in document["error"], "an error that is no sentence")
    if line == b'{"command":"status"}':
        require(document["ok"], "it does not say how it is")


def _no_number(constant: str) -> Any:
    raise FailedError(f"{constant} is no JSON")


def _mission() -> Mission:
    return parse_mission(
        {
            "schema": "ucp-mission/1",
            "agent_id": 1,
            "roster": [1, 2],
            "initial_data": "",
            "network": {"address": "127.0.0.1", "broadcast": "127.255.255.255", "port": _free_port()},
            "events": {"source": "none"},
            "settings": {"max_block_bytes": 64, "max_event_bytes": 64},
            "seed": 1,
            "speedup": 1000,
        }
    )


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


def seeds(flown: Path) -> Iterator[bytes]:
    requests: list[dict[str, Any]] = [
        {"command": "status"},
        {"command": "start", "epoch_us": 1_790_000_000_000_000},
        {"command": "log", "event_id": 7, "data": "AAECAwQFBgcICQoLDA0ODw=="},
        {"command": "log", "event_id": 7, "data": "AAECAwQFBgcICQoLDA0ODw=="},
        {"command": "quirk", "name": "ignore_commit", "value": 0.5},
        {"command": "reconcile"},
        {"command": "stop_events"},
        {"command": "export"},
    ]
    yield b"\n".join(json.dumps(request).encode() for request in requests)
    yield b'{"command":"status"}\n{"command":"log"}\nnone\n[]\n{"command":["x"]}'
