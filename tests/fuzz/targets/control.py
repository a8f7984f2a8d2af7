"""The control socket of an agent that runs: whatever a client sends, each line gets one, and it lives."""

import asyncio
import json
import logging
import os
import signal
import socket
from collections.abc import Iterator
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
    with TemporaryDirectory() as directory:
        logged = _Logged()
        log = logging.getLogger("ucp.node")
        log.addHandler(logged)
        log.propagate = False
        try:
            asyncio.run(_converse(Path(directory), lines, logged.problems))
        finally:
            log.removeHandler(logged)
        require(not logged.problems, f"it logs {logged.problems[:1]}")
        require(not (Path(directory) / "1.control").exists(), "the socket is left behind")
        read_export(Path(directory) / "1.chain.json")
        trace_file = Path(directory) / "1.trace.jsonl"
        if trace_file.stat().st_size:
            trace = read_trace(trace_file)
            require(trace is not None and not trace.problem and not trace.cut_off, "its trace cannot be read")


class _Logged(logging.Handler):
    """Takes down what an agent logs of its own mistakes."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.problems: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.problems.append(f"{record.getMessage()}: {record.exc_info}")


async def _converse(directory: Path, lines: list[bytes], problems: list[str]) -> None:
    loop = asyncio.get_running_loop()
    loop.set_exception_handler(lambda _, context: problems.append(f"{context['message']}: {context.get('exception')}"))
    running = asyncio.create_task(Node(_mission(), directory).run())
    path = directory / "1.control"
    while not path.exists():
        require(not running.done(), "it ended before it began")
        await asyncio.sleep(0)
    reader, writer = await asyncio.open_unix_connection(str(path), limit=16 * 1024 * 1024)
    for line in (*lines, b'{"command":"status"}'):
        writer.write(line + b"\n")
        answer = await asyncio.wait_for(reader.readline(), _ANSWER_S)
        require(answer.endswith(b"\n"), f"no answer to {line[:200]!r}; {problems[:1]}")
        _judge(line, answer)
    writer.close()
    os.kill(os.getpid(), signal.SIGTERM)
    require(await asyncio.wait_for(running, _ANSWER_S) == 0, "it fails in the end")


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
