"""Accept requests to an active run from programs outside the run, through a socket in the run directory.

Requests and answers are lines of JSON, as on an agent's control socket. `ask_run` is the client:

    {"command": "happen", "entry": {"partition": [[1, 2], [3, 4, 5]]}}      apply an entry of a timeline now
    {"command": "pause"} {"command": "go_on"} {"command": "step", "seconds": 10} {"command": "step"}
    {"command": "pace", "factor": 20}, or null: unlimited                   this and the row above need virtual time
    {"command": "state"}

    -> {"ok": true, "at_s": 312.472}        the mission second of the entry, or the current one
    -> {"ok": false, "error": "kill: agent 2 is killed then, not running or paused"}

A step to the next handler run has no `seconds`. The answer to `state` has `at_s`, `virtual_time`, `paused`, `factor`,
`closed` (reason why no request is possible, or null), and `by_hand`, the requested entries of the timeline.
"""

import asyncio
import json
from collections.abc import AsyncIterator, Callable, Mapping
from concurrent.futures import Future
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from pydantic_core import from_json

from harness.errors import HarnessError, ScenarioError
from harness.play.agent_control import connect
from harness.play.interventions import Interventions
from harness.play.unix_sockets import short_name

SOCKET = "by-hand"
MAX_REQUEST_BYTES = 64 * 1024
MAX_CONNECTIONS = 32
FINAL_ANSWERS_S = 0.1
"""Maximum seconds of wall time for which the run waits at its end to send the last answers."""


@asynccontextmanager
async def serve_requests(interventions: Interventions, directory: Path) -> AsyncIterator[None]:
    """Accept requests inside the context. Only the user who started the run may send requests. Raises OSError if the
    socket cannot be created.
    """
    connections: set[asyncio.Task[Any]] = set()

    async def serve_connection(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        connections.add(task)
        try:
            if len(connections) <= MAX_CONNECTIONS:
                await _serve(interventions, reader, writer)
        except OSError:
            pass  # the client closed its connection
        finally:
            connections.discard(task)
            writer.close()

    with short_name(directory) as name:
        server = await asyncio.start_unix_server(serve_connection, f"{name}/{SOCKET}", limit=MAX_REQUEST_BYTES)
        (directory / SOCKET).chmod(0o600)
    try:
        yield
    finally:
        server.close()
        (directory / SOCKET).unlink(missing_ok=True)
        if connections:
            _, silent = await asyncio.wait(connections, timeout=FINAL_ANSWERS_S)
            for task in silent:
                task.cancel()


async def ask_run(directory: Path, **request: Any) -> dict[str, Any]:
    """Send a request to the active run, and return the answer. Raises ScenarioError if the run refuses the request, and
    OSError if the run does not answer.
    """
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


async def _serve(interventions: Interventions, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    while True:
        try:
            line = await reader.readline()
        except ValueError:
            line, answer = b"", {"ok": False, "error": f"the request has more than {MAX_REQUEST_BYTES} bytes"}
        else:
            if not line:
                return
            answer = await _answer(interventions, line)
        writer.write(json.dumps(answer).encode() + b"\n")
        await writer.drain()
        if not line:
            return  # the start of the next request is unknown


async def _answer(interventions: Interventions, line: bytes) -> dict[str, Any]:
    try:
        return {"ok": True, **await _execute(interventions, line)}
    except HarnessError as error:
        return {"ok": False, "error": str(error)}


async def _execute(interventions: Interventions, line: bytes) -> dict[str, Any]:
    """Execute a request, and return the answer. Raises ScenarioError if the request is invalid or impossible."""
    try:
        request = from_json(line, allow_inf_nan=False)
    except ValueError:
        raise ScenarioError("the request is not a line of JSON") from None
    command = request.get("command") if isinstance(request, dict) else None
    if command == "state":
        return _state(interventions)
    ask = _COMMANDS.get(command) if isinstance(command, str) else None
    if ask is None:
        raise ScenarioError(f"the request has no known command: `command` must be one of {', '.join(_COMMANDS)}, state")
    return {"at_s": await asyncio.wrap_future(ask(interventions, request))}


def _request_event(interventions: Interventions, request: Mapping[str, Any]) -> Future[float]:
    entry = request.get("entry")
    if not isinstance(entry, dict):
        raise ScenarioError('`entry` must have keys of an entry of a timeline, such as {"heal": true}')
    return interventions.ask(entry)


def _step(interventions: Interventions, request: Mapping[str, Any]) -> Future[float]:
    return (
        interventions.step_to_next_run()
        if request.get("seconds") is None
        else interventions.step(_number(request, "seconds"))
    )


def _pace(interventions: Interventions, request: Mapping[str, Any]) -> Future[float]:
    return interventions.set_factor(None if request.get("factor") is None else _number(request, "factor"))


def _number(request: Mapping[str, Any], key: str) -> float:
    number = request[key]
    if isinstance(number, bool) or not isinstance(number, int | float):
        raise ScenarioError(f"`{key}` must be a number")
    return float(min(number, 1e18))


_COMMANDS: dict[str, Callable[[Interventions, Mapping[str, Any]], Future[float]]] = {
    "happen": _request_event,
    "pause": lambda interventions, _: interventions.pause(),
    "go_on": lambda interventions, _: interventions.resume(),
    "step": _step,
    "pace": _pace,
}


def _state(interventions: Interventions) -> dict[str, Any]:
    return {
        "at_s": interventions.now_s,
        "virtual_time": interventions.pace is not None,
        "paused": interventions.paused,
        "factor": interventions.factor,
        "closed": interventions.closed,
        "by_hand": [
            {"at_s": entry.at_s, **entry.model_dump(mode="json", exclude_defaults=True)}
            for entry in interventions.by_hand
        ],
    }
