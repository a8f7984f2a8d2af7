"""What other processes ask of a run that goes on: a socket in its directory, and on it `Interventions`.

One line of JSON each way, as with an agent's control socket; `ask_run` is one who asks:

    {"command": "happen", "entry": {"partition": [[1, 2], [3, 4, 5]]}}      an entry of a timeline, now
    {"command": "pause"} {"command": "go_on"} {"command": "step", "seconds": 10} {"command": "step"}
    {"command": "pace", "factor": 20}, or null: as fast as it can           the last three rows in virtual time only
    {"command": "state"}

    -> {"ok": true, "at_s": 312.472}        the mission second at which it happened, or time stands now
    -> {"ok": false, "error": "kill: agent 2 is killed then, not running or paused"}

A step to the next handler run has no `seconds`. The answer to `state` has `at_s`, `virtual_time`, `paused`, `factor`,
`closed` (why nothing can happen to the swarm, or null), and `by_hand`, the timeline's entries that were asked for.
"""

import asyncio
import json
import os
from collections.abc import AsyncIterator, Callable, Mapping
from concurrent.futures import Future
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from pydantic_core import from_json

from harness.errors import HarnessError, ScenarioError
from harness.play.agent_control import connect
from harness.play.interventions import Interventions

SOCKET = "by-hand"
MAX_REQUEST_BYTES = 64 * 1024
MAX_CONNECTIONS = 32
LAST_WORDS_S = 0.1
"""For answers that come with the end of the run."""


@asynccontextmanager
async def listening(hand: Interventions, directory: Path) -> AsyncIterator[None]:
    """Inside, whoever may write in the run's directory may ask. Raises OSError if there can be no socket."""
    connections: set[asyncio.Task[Any]] = set()

    async def connected(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        connections.add(task)
        try:
            if len(connections) <= MAX_CONNECTIONS:
                await _serve(hand, reader, writer)
        except OSError:
            pass  # it went away
        finally:
            connections.discard(task)
            writer.close()

    inside = os.open(directory, os.O_PATH)  # a socket's address holds 107 bytes, and run directories lie deep
    try:
        path = f"/proc/self/fd/{inside}/{SOCKET}"
        server = await asyncio.start_unix_server(connected, path, limit=MAX_REQUEST_BYTES)
        (directory / SOCKET).chmod(0o600)
    finally:
        os.close(inside)
    try:
        yield
    finally:
        server.close()
        (directory / SOCKET).unlink(missing_ok=True)
        if connections:
            _, silent = await asyncio.wait(connections, timeout=LAST_WORDS_S)
            for task in silent:
                task.cancel()


async def ask_run(directory: Path, **request: Any) -> dict[str, Any]:
    """What the run that goes on there answers. Raises ScenarioError if it refuses, OSError if nobody answers."""
    reader, writer = await connect(directory / SOCKET)
    try:
        writer.write(json.dumps(request).encode() + b"\n")
        line = await reader.readline()
    finally:
        writer.close()
    if not line.endswith(b"\n"):
        raise ConnectionResetError("it has ended")
    answer: dict[str, Any] = json.loads(line)
    if not answer.pop("ok"):
        raise ScenarioError(answer["error"])
    return answer


async def _serve(hand: Interventions, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    while True:
        try:
            line = await reader.readline()
        except ValueError:
            line, answer = b"", {"ok": False, "error": f"the request has more than {MAX_REQUEST_BYTES} bytes"}
        else:
            if not line:
                return
            answer = await _answer(hand, line)
        writer.write(json.dumps(answer).encode() + b"\n")
        await writer.drain()
        if not line:
            return  # where the next one begins, nobody knows


async def _answer(hand: Interventions, line: bytes) -> dict[str, Any]:
    try:
        return {"ok": True, **await _done(hand, line)}
    except HarnessError as error:
        return {"ok": False, "error": str(error)}


async def _done(hand: Interventions, line: bytes) -> dict[str, Any]:
    """Raises ScenarioError if it cannot be, or is nothing that can be asked."""
    try:
        request = from_json(line, allow_inf_nan=False)
    except ValueError:
        raise ScenarioError("the request is not a line of JSON") from None
    command = request.get("command") if isinstance(request, dict) else None
    if command == "state":
        return _state(hand)
    ask = _COMMANDS.get(command) if isinstance(command, str) else None
    if ask is None:
        raise ScenarioError(f"the request has no known command: `command` must be one of {', '.join(_COMMANDS)}, state")
    return {"at_s": await asyncio.wrap_future(ask(hand, request))}


def _happen(hand: Interventions, request: Mapping[str, Any]) -> Future[float]:
    entry = request.get("entry")
    if not isinstance(entry, dict):
        raise ScenarioError('`entry` must have keys of an entry of a timeline, such as {"heal": true}')
    return hand.ask(entry)


def _step(hand: Interventions, request: Mapping[str, Any]) -> Future[float]:
    return hand.step_to_next_run() if request.get("seconds") is None else hand.step(_number(request, "seconds"))


def _pace(hand: Interventions, request: Mapping[str, Any]) -> Future[float]:
    return hand.set_factor(None if request.get("factor") is None else _number(request, "factor"))


def _number(request: Mapping[str, Any], key: str) -> float:
    number = request[key]
    if isinstance(number, bool) or not isinstance(number, int | float):
        raise ScenarioError(f"`{key}` must be a number")
    return float(min(number, 1e18))


_COMMANDS: dict[str, Callable[[Interventions, Mapping[str, Any]], Future[float]]] = {
    "happen": _happen,
    "pause": lambda hand, _: hand.pause(),
    "go_on": lambda hand, _: hand.go_on(),
    "step": _step,
    "pace": _pace,
}


def _state(hand: Interventions) -> dict[str, Any]:
    return {
        "at_s": hand.now_s,
        "virtual_time": hand.pace is not None,
        "paused": hand.paused,
        "factor": hand.factor,
        "closed": hand.closed,
        "by_hand": [
            {"at_s": entry.at_s, **entry.model_dump(mode="json", exclude_defaults=True)} for entry in hand.by_hand
        ],
    }
