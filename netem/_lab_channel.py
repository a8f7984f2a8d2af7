"""The orchestrator's end of the control socket: questions and answers, and news of children that ended."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import signal
import socket
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from netem._lab_protocol import Receiver, WireError, encode
from netem.errors import ConditionsError, EngineError, LabError, NetemError, SpawnError

Answer = tuple[dict[str, Any], socket.socket | None]


@dataclass
class _Question:
    what: str
    answer: asyncio.Future[Answer]


class Channel:
    """Speaks to one `netem.init`; when that is gone, every question ends with the same clear error."""

    def __init__(self, control: socket.socket, log: Path) -> None:
        control.setblocking(False)
        self._control = control
        self._log = log
        self._loop = asyncio.get_running_loop()
        self._receiver = Receiver()
        self._numbers = itertools.count(1)
        self._questions: dict[int, _Question] = {}
        self._children: dict[int, asyncio.Future[int]] = {}
        self._inside: asyncio.Future[bool] = self._loop.create_future()
        self._writing = asyncio.Lock()
        self._end: str | None = None
        self._loop.add_reader(control, self._receive)

    @property
    def open(self) -> bool:
        return self._end is None

    async def inside(self) -> bool:
        """Wait for the first process to say that it lives; False if it is gone instead."""
        return await asyncio.shield(self._inside)

    async def ask(self, what: str, **arguments: Any) -> Answer:
        """Send a request, and return its result and the socket that came with it."""
        if self._end is not None:
            raise LabError(self._end)
        number = next(self._numbers)
        answer: asyncio.Future[Answer] = self._loop.create_future()
        try:
            data = encode({"id": number, "request": what, **arguments})
        except WireError as error:
            raise LabError(f"The lab cannot be asked to {what}: {error}") from error
        self._questions[number] = _Question(what, answer)
        try:
            async with self._writing:
                # A torn message would spoil the stream: once begun, it is sent, whoever is cancelled.
                await asyncio.shield(self._loop.create_task(self._write(data)))
            return await answer
        finally:
            self._questions.pop(number, None)

    async def _write(self, data: bytes) -> None:
        with contextlib.suppress(OSError):  # the reader sees the end too, and says so to everybody
            await self._loop.sock_sendall(self._control, data)

    def close(self) -> None:
        """Hang up, on which the lab ends."""
        self._finish("The lab is closed")

    def _receive(self) -> None:
        try:
            alive = self._receiver.read(self._control)
            for message in self._receiver.messages():
                self._take(message)
        except BlockingIOError:
            return
        except (ConnectionError, WireError):
            alive = False
        if not alive:
            self._finish(
                "The lab's first process ended unexpectedly, and every process in the lab with it; its output is in "
                f"{self._log}"
            )

    def _take(self, message: dict[str, Any]) -> None:
        event = message.get("event")
        if event == "inside" and not self._inside.done():
            self._inside.set_result(True)
        elif event == "exited":
            ended = self._children.pop(message["pid"], None)
            if ended is not None and not ended.done():
                ended.set_result(message["returncode"])
        elif "id" in message:
            self._take_answer(message)

    def _take_answer(self, message: dict[str, Any]) -> None:
        connection = None
        if message.get("descriptors"):
            connection = socket.socket(fileno=self._receiver.descriptors.popleft())
        question = self._questions.get(message["id"])
        if question is None or question.answer.done():  # whoever asked was cancelled
            if connection is not None:
                connection.close()
            return
        if error := message.get("error"):
            question.answer.set_exception(_exception(question.what, error))
            return
        result = message["result"]
        if question.what == "spawn":
            # Here and not where the answer is awaited: the news of its end may be the next message.
            result["ended"] = self._children[result["pid"]] = self._loop.create_future()
        question.answer.set_result((result, connection))

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
        for ended in self._children.values():
            if not ended.done():
                ended.set_result(-signal.SIGKILL)
        for question in self._questions.values():
            if not question.answer.done():
                question.answer.set_exception(LabError(reason))


def _exception(what: str, error: dict[str, Any]) -> Exception:
    message, kind, code = error["message"], error["kind"], error["errno"]
    if what == "spawn" and kind == "os":
        return SpawnError(message)
    if what == "connect" and kind == "os":
        # OSError with a number is of the right class: ConnectionRefusedError, TimeoutError.
        exception = OSError(code, message.split("] ", 1)[-1])
        return exception if isinstance(exception, (ConnectionError, TimeoutError)) else ConnectionError(*exception.args)
    kinds: dict[str, type[NetemError]] = {"conditions": ConditionsError, "engine": EngineError}
    return kinds.get(kind, LabError)(message)
