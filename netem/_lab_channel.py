"""Send requests to the process inside the virtual network, and receive its answers and its reports about programs that
have ended.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import signal
import socket
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from netem._lab_protocol import MessageReceiver, WireError, encode
from netem.errors import ConditionsError, EngineError, LabError, NetemError, SpawnError

Answer = tuple[dict[str, Any], socket.socket | None]


@dataclass
class _LabRequest:
    what: str
    answer: asyncio.Future[Answer]


class LabConnection:
    """The connection to the process `netem.init`. After the process `netem.init` has ended, each request fails with the
    same error.
    """

    def __init__(self, control: socket.socket, log: Path) -> None:
        control.setblocking(False)
        self._control = control
        self._log = log
        self._loop = asyncio.get_running_loop()
        self._receiver = MessageReceiver()
        self._numbers = itertools.count(1)
        self._requests: dict[int, _LabRequest] = {}
        self._children: dict[int, asyncio.Future[int]] = {}
        self._inside: asyncio.Future[bool] = self._loop.create_future()
        self._writing = asyncio.Lock()
        self._end: str | None = None
        self._loop.add_reader(control, self._receive)

    @property
    def open(self) -> bool:
        return self._end is None

    async def inside(self) -> bool:
        """Wait for the first report of the process `netem.init`. Return false if the process ends without a report."""
        return await asyncio.shield(self._inside)

    async def ask(self, what: str, **arguments: Any) -> Answer:
        """Send a request. Return the result from the answer. Also return the socket that came with the answer, or None
        if there was no socket.
        """
        if self._end is not None:
            raise LabError(self._end)
        number = next(self._numbers)
        answer: asyncio.Future[Answer] = self._loop.create_future()
        try:
            data = encode({"id": number, "request": what, **arguments})
        except WireError as error:
            raise LabError(f"The lab cannot get the request {what!r}: {error}") from error
        self._requests[number] = _LabRequest(what, answer)
        try:
            async with self._writing:
                # A partial message would corrupt the stream, so it is sent completely even if the caller is cancelled.
                await asyncio.shield(self._loop.create_task(self._write(data)))
            return await answer
        finally:
            self._requests.pop(number, None)

    async def _write(self, data: bytes) -> None:
        with contextlib.suppress(OSError):  # the reader also detects the end, and reports it
            await self._loop.sock_sendall(self._control, data)

    def close(self) -> None:
        """Close the connection, which ends the virtual network."""
        self._finish("The lab is closed")

    def _receive(self) -> None:
        try:
            alive = self._receiver.read(self._control)
            for message in self._receiver.messages():
                self._handle(message)
        except BlockingIOError:
            return
        except (ConnectionError, WireError):
            alive = False
        if not alive:
            self._finish(
                "The lab's first process ended unexpectedly, and every process in the lab with it; its output is in "
                f"{self._log}"
            )

    def _handle(self, message: dict[str, Any]) -> None:
        event = message.get("event")
        if event == "inside" and not self._inside.done():
            self._inside.set_result(True)
        elif event == "exited":
            end_future = self._children.pop(message["pid"], None)
            if end_future is not None and not end_future.done():
                end_future.set_result(message["returncode"])
        elif "id" in message:
            self._handle_answer(message)

    def _handle_answer(self, message: dict[str, Any]) -> None:
        connection = None
        if message.get("descriptors"):
            connection = socket.socket(fileno=self._receiver.descriptors.popleft())
        request = self._requests.get(message["id"])
        if request is None or request.answer.done():  # the caller was cancelled
            if connection is not None:
                connection.close()
            return
        if error := message.get("error"):
            request.answer.set_exception(_exception(request.what, error))
            return
        result = message["result"]
        if request.what == "spawn":
            # Here and not where the answer is awaited, because the report of its end may be the next message.
            result["ended"] = self._children[result["pid"]] = self._loop.create_future()
        request.answer.set_result((result, connection))

    def _finish(self, reason: str) -> None:
        if self._end is not None:
            return
        self._end = reason
        self._loop.remove_reader(self._control)
        self._loop.remove_writer(self._control)
        self._control.close()
        self._receiver.close()
        if not self._inside.done():
            self._inside.set_result(False)
        for end_future in self._children.values():
            if not end_future.done():
                end_future.set_result(-signal.SIGKILL)
        for request in self._requests.values():
            if not request.answer.done():
                request.answer.set_exception(LabError(reason))


def _exception(what: str, error: dict[str, Any]) -> Exception:
    message, kind, code = error["message"], error["kind"], error["errno"]
    if what == "spawn" and kind == "os":
        return SpawnError(message)
    if what == "connect" and kind == "os":
        # OSError with a number becomes the right subclass: ConnectionRefusedError, TimeoutError.
        exception = OSError(code, message.split("] ", 1)[-1])
        return exception if isinstance(exception, (ConnectionError, TimeoutError)) else ConnectionError(*exception.args)
    kinds: dict[str, type[NetemError]] = {"conditions": ConditionsError, "engine": EngineError}
    return kinds.get(kind, LabError)(message)
