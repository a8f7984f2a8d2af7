"""Talking to an agent under test over its control socket (see ucp/contract/CONTRACT.md)."""

import asyncio
import json
import os
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field
from pydantic_core import from_json

from harness.errors import VIOLATED, HarnessError
from harness.play.command_line import last_words

ANSWER_LIMIT_BYTES = 1024 * 1024


VERSION_CHARACTERS = 80


def _first_words(version: Any) -> str | None:
    """What an agent says of its version as a line for people; None if it is no text."""
    if not isinstance(version, str):
        return None
    return " ".join("".join(filter(str.isprintable, word)) for word in version.split())[:VERSION_CHARACTERS] or None


class Status(BaseModel):
    """What ucp/contract/CONTRACT.md promises of an agent's status, and what the default agent says besides."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    started: bool
    idle: bool
    reconcile_in_progress: bool
    chain: int
    deque: int
    stack: int
    completed: int
    reconciles: int
    top_chain_hash: str
    handled: int
    bytes_sent: int
    mission_s: Annotated[float, Field(allow_inf_nan=False)] | None = None
    dropped: dict[str, int] = {}
    send_failures: int | None = None
    trace_problem: str | None = None
    version: Annotated[str | None, BeforeValidator(_first_words)] = None


class AgentSilentError(Exception):
    """The agent does not answer, or its socket is gone."""


class AgentRefusedError(HarnessError):
    """The agent answered that it cannot: its own sentence."""

    exit_status = VIOLATED


class AgentUnsupportedError(AgentRefusedError):
    """The agent answered that it does not have this command, or what it asks for."""


class AgentControl:
    """One connection, made anew when it breaks; one command at a time."""

    def __init__(self, socket_path: Path) -> None:
        self._path = socket_path
        self._lock = asyncio.Lock()
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None

    async def ask(self, command: str, *, timeout_s: float, **arguments: Any) -> dict[str, Any]:
        """The agent's answer, within `timeout_s` of wall time.

        Raises AgentSilentError, AgentRefusedError, AgentUnsupportedError.
        """
        async with self._lock:
            try:
                async with asyncio.timeout(timeout_s):
                    answer = await self._exchange({"command": command, **arguments})
            except (TimeoutError, OSError, ValueError, RecursionError) as error:
                self.close()
                what = f"no answer to {command} for {timeout_s:g} s" if isinstance(error, TimeoutError) else str(error)
                raise AgentSilentError(what) from None
            except asyncio.CancelledError:
                self.close()  # an answer is still to come on this connection, and would be taken for the next one's
                raise
        if not answer.get("ok"):
            refused = AgentUnsupportedError if answer.get("unsupported") is True else AgentRefusedError
            raise refused(last_words(str(answer.get("error", ""))) or "no reason given")
        return answer

    def close(self) -> None:
        if self._streams is not None:
            self._streams[1].close()
            self._streams = None

    async def _exchange(self, request: dict[str, Any]) -> dict[str, Any]:
        reader, writer = self._streams or await self._connect()
        writer.write(json.dumps(request).encode() + b"\n")
        await writer.drain()
        line = await reader.readline()
        if not line.endswith(b"\n"):
            raise ConnectionResetError("it closed its control socket")
        answer = from_json(line, allow_inf_nan=False)
        if not isinstance(answer, dict):
            raise ValueError("its answer is not a JSON object")
        return answer

    async def _connect(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        self._streams = await connect(self._path)
        return self._streams


async def connect(socket_path: Path) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    """A connection to a socket that answers in lines. Raises OSError."""
    # A socket's address holds 107 bytes, and run directories lie deep: name it through its directory.
    directory = os.open(socket_path.parent, os.O_PATH)
    try:
        return await asyncio.open_unix_connection(
            f"/proc/self/fd/{directory}/{socket_path.name}", limit=ANSWER_LIMIT_BYTES
        )
    finally:
        os.close(directory)
