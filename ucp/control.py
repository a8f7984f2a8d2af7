"""The control socket of an agent, through which other programs request its status and send commands.

The socket is a Unix stream socket. Each request and each answer is a line with a JSON object (see
contract/CONTRACT.md).
"""

import contextlib
import json
import os
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ucp._request import check_request
from ucp.loop import Loop

MAX_LINE_BYTES = 64 * 1024
MAX_NAME = 40
"""Maximum number of characters of an unknown command in an error message."""

Command = Callable[[dict[str, Any]], dict[str, Any]]


class CommandError(Exception):
    """An error: a command cannot be executed. The message is one sentence."""


class UnsupportedCommandError(CommandError):
    """An error: a command needs a feature that this agent does not have."""


class ControlServer:
    """A server for the control socket. A request names a command, and the server calls the function of this name in
    `commands`. When the server ends, it removes its socket file.
    """

    def __init__(self, path: Path, commands: dict[str, Command], loop: Loop) -> None:
        self._path = path
        self._commands = commands
        self._loop = loop
        self._listener: socket.socket | None = None

    def start(self) -> None:
        """Start to accept connections. An old socket file of an agent that has ended is replaced. Raises OSError."""
        self._listener = listener = socket.socket(socket.AF_UNIX)
        listener.setblocking(False)
        # The socket gets its name only after it listens, so a client that sees the name can connect.
        temporary = self._path.with_name(f".{self._path.name}")
        temporary.unlink(missing_ok=True)
        # The address of a socket has at most 107 bytes, and paths of run directories are long: use a relative path.
        directory = os.open(self._path.parent, os.O_PATH)
        try:
            listener.bind(f"/proc/self/fd/{directory}/{temporary.name}")
        finally:
            os.close(directory)
        listener.listen()
        self._loop.watch(listener, readable=self._accept)
        temporary.replace(self._path)

    def close(self) -> None:
        if self._listener is not None:
            self._loop.watch(self._listener)
            self._listener.close()
        self._path.unlink(missing_ok=True)

    def _accept(self) -> None:
        assert self._listener is not None, "it listens"
        with contextlib.suppress(OSError):  # the client may have disconnected already
            _ControlClient(self._listener.accept()[0], self.answer, self._loop)

    def answer(self, line: bytes) -> dict[str, object]:
        """Return the answer to one line with a request."""
        try:
            request = json.loads(line.decode())  # given bytes, json would also accept UTF-16
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
        except UnsupportedCommandError as error:
            return {"ok": False, "unsupported": True, "error": str(error)}
        except CommandError as error:
            return {"ok": False, "error": str(error)}


class _ControlClient:
    """A connection of a client to the control socket. It answers one request at a time, and waits until the client has
    read the answer.

    The connection ends if the client disconnects or sends a line above the limit. Other connections continue.
    """

    def __init__(self, connection: socket.socket, answer: Callable[[bytes], dict[str, Any]], loop: Loop) -> None:
        connection.setblocking(False)
        self._connection = connection
        self._answer = answer
        self._loop = loop
        self._received = b""
        self._unsent = b""
        loop.watch(connection, readable=self._read)

    def _read(self) -> None:
        try:
            data = self._connection.recv(MAX_LINE_BYTES)
        except OSError:
            data = b""
        self._received += data
        if data:
            self._answer_next_line()
        else:
            self._close()

    def _write(self) -> None:
        try:
            self._unsent = self._unsent[self._connection.send(self._unsent) :]
        except BlockingIOError:
            pass
        except OSError:
            self._close()
            return
        if not self._unsent:
            self._loop.watch(self._connection, readable=self._read)
            self._answer_next_line()

    def _answer_next_line(self) -> None:
        """Answer the next complete line, if one has arrived."""
        line, newline, rest = self._received.partition(b"\n")
        if newline:
            self._received = rest
            try:
                self._unsent = json.dumps(self._answer(line)).encode("ascii") + b"\n"
            except Exception:
                self._close()  # there will be no answer
                raise
            self._loop.watch(self._connection, writable=self._write)
        elif len(line) > MAX_LINE_BYTES:
            self._close()

    def _close(self) -> None:
        self._loop.watch(self._connection)
        self._connection.close()
