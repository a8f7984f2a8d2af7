"""The control socket: whoever runs the agent asks for its status, and for what no vehicle would ask.

A Unix stream socket; one JSON object per line in, one per line out (see CONTRACT.md).
"""

import asyncio
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ucp.request import check_request

MAX_LINE_BYTES = 64 * 1024
MAX_NAME = 40
"""More of a wrong command is not shown."""

Command = Callable[[dict[str, Any]], dict[str, Any]]


class CommandError(Exception):
    """A command that cannot be carried out: one sentence."""


class ControlServer:
    """Serves `commands` by name. The socket lies beside the agent's other files and goes when the agent does."""

    def __init__(self, path: Path, commands: dict[str, Command]) -> None:
        self._path = path
        self._commands = commands
        self._server: asyncio.Server | None = None

    async def start(self) -> None:
        """Raises OSError. A socket that a dead agent left is replaced."""
        # Under its name it is there only once it listens: whoever sees it can connect.
        unready = self._path.with_name(f".{self._path.name}")
        unready.unlink(missing_ok=True)
        # A socket's address holds 107 bytes, and run directories lie deep: name it from its own directory.
        directory = os.open(self._path.parent, os.O_PATH)
        try:
            self._server = await asyncio.start_unix_server(
                self._serve, f"/proc/self/fd/{directory}/{unready.name}", limit=MAX_LINE_BYTES
            )
        finally:
            os.close(directory)
        unready.replace(self._path)

    def close(self) -> None:
        if self._server is not None:
            self._server.close()
        self._path.unlink(missing_ok=True)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while line := await reader.readline():
                writer.write(json.dumps(self._answer(line)).encode("ascii") + b"\n")
                await writer.drain()
        except (ValueError, ConnectionError):
            pass  # a line over the limit, or a client that went away: its connection ends, nothing else
        finally:
            writer.close()

    def _answer(self, line: bytes) -> dict[str, Any]:
        try:
            request = json.loads(line)
            if not isinstance(request, dict):
                return {"ok": False, "error": "not a JSON object"}
            check_request(request)
        except (ValueError, RecursionError):
            return {"ok": False, "error": "not JSON"}
        name = request.get("command")
        command = self._commands.get(name) if isinstance(name, str) else None
        if command is None:
            error = f"unknown command {str(name)[:MAX_NAME]!r}: there are {', '.join(self._commands)}"
            return {"ok": False, "unsupported": True, "error": error}
        try:
            return {"ok": True, **command(request)}
        except CommandError as error:
            return {"ok": False, "error": str(error)}
