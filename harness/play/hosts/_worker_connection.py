"""The connection between the lab and one worker, which runs the vehicle programs of its agents.

`harness.play.hosts._vehicle_host` is the other end, and describes the messages. Each TCP connection of the ground
station or of a vehicle's pilot uses a socket pair. The pilot or ground station uses one socket of the pair. This module
copies data between the other socket and the worker.

A worker counts as lost if its connection ends, or if it is silent for `LOST_AFTER_S`. Its vehicles are then lost, too.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import signal
import socket
import sys
from collections.abc import Callable, Sequence
from itertools import count
from pathlib import Path
from typing import Any

from harness.play.hosts._vehicle_files import FILE_HEADER, file_names, file_path
from harness.play.remote._connection import Connection
from harness.play.remote._far_clock import ping
from harness.play.remote._far_ends import FarEnd
from harness.play.remote._wire import LOST_AFTER_S, NUMBER_BYTES, SILENT_S, Kind, Message, WireError
from netem.errors import SpawnError
from netem.lab import RunningProgram

PING_EVERY_S = 0.5
READ_BYTES = 1 << 16


class FarVehicle(RunningProgram):
    """A vehicle program that runs on a worker. When the program has ended, the worker also ends its child processes.

    The method `wait` returns after the files of the program have arrived. If the worker is lost, the return code is
    -SIGKILL.
    """

    def __init__(self, number: int, worker: WorkerConnection, output: Path) -> None:
        loop = asyncio.get_running_loop()
        super().__init__(loop.create_future())
        self.number, self.output = number, output
        self._worker = worker
        self.started: asyncio.Future[str | None] = loop.create_future()
        """A future. Its result is None when the program has started, or the reason why it could not be started."""
        self.killed = False

    async def send_signal(self, number: int) -> None:
        self.killed |= number == signal.SIGKILL
        if not self._ended.done():
            self._worker.send(Kind.SIGNAL, {"program": self.number, "number": int(number)})

    def finish(self, status: int) -> None:
        if not self._ended.done():
            self._ended.set_result(status)


class WorkerConnection:
    """The connection to a worker. The object must be created while an event loop runs."""

    def __init__(self, worker: str, record_lag: Callable[[bytes], None]) -> None:
        """Create the object without a connection. `worker` is the address of the worker. The function `record_lag` is
        called with each line that contains a measurement of the worker's delays.
        """
        self.worker = worker
        self._record_lag = record_lag
        self._loop = asyncio.get_running_loop()
        self._numbers = count(1)
        self._programs: dict[int, FarVehicle] = {}
        self._streams: dict[int, asyncio.StreamWriter] = {}
        self._answers: dict[int, asyncio.Future[str | None]] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._lag = b""
        self._heard_s = self._loop.time()
        self._is_lost = False
        self._connection: Connection

    async def open(self, far_end: FarEnd) -> None:
        """Take over the connection of the worker. Raises OSError."""
        self._connection = Connection(far_end.channel, self._receive, lambda connection: self.close())
        await self._loop.create_connection(lambda: self._connection, sock=far_end.connection)
        self._heard_s = self._loop.time()
        self._start_task(self._ping())

    @property
    def is_lost(self) -> bool:
        """True if the connection has ended, or if the worker does not answer now."""
        return self._is_lost or self._loop.time() - self._heard_s > SILENT_S

    def close(self) -> None:
        """End the connection. The worker then ends its vehicles."""
        self._is_lost = True
        self._connection.close()
        for task in self._tasks:
            task.cancel()
        for answer in self._answers.values():
            if not answer.done():
                answer.set_result("its worker is lost")
        for program in self._programs.values():
            if not program.started.done():
                program.started.set_result(f"its worker {self.worker} is lost")
            program.finish(-signal.SIGKILL)

    def send(self, kind: Kind, document: dict[str, Any]) -> None:
        self._connection.send(kind, json.dumps(document).encode())

    async def start(self, vehicle: int, argv: Sequence[str], directory: Path, output: Path) -> FarVehicle:
        """Start the program of a vehicle on the worker, with a copy of the files in `directory`. After the end of the
        program, the worker sends the files that the program wrote, and this object stores them in `directory`. Raises
        SpawnError.
        """
        program = FarVehicle(next(self._numbers), self, output)
        files = {
            name: base64.b64encode((directory / name).read_bytes()).decode("ascii") for name in file_names(directory)
        }
        words = [None if word == sys.executable else word for word in argv]
        output.touch()
        self._programs[program.number] = program
        self.send(Kind.BEGIN, {"program": program.number, "vehicle": vehicle, "argv": words, "files": files})
        if self._is_lost:
            self.close()
        if (error := await program.started) is not None:
            raise SpawnError(f"The vehicle cannot be started: {error}")
        return program

    async def connect(self, program: FarVehicle, port: int, timeout_s: float) -> socket.socket:
        """Return a socket that is connected to a port of a vehicle program. Raises ConnectionError or TimeoutError."""
        stream = next(self._numbers)
        self._answers[stream] = self._loop.create_future()
        ours, theirs = socket.socketpair()
        try:
            reader, writer = await asyncio.open_connection(sock=ours)
            self._streams[stream] = writer
            self.send(
                Kind.REQUEST,
                {"stream": stream, "program": program.number, "port": port, "timeout_s": timeout_s},
            )
            if (error := await asyncio.wait_for(self._answers[stream], timeout_s + SILENT_S)) is not None:
                raise ConnectionRefusedError(error)
        except BaseException:
            theirs.close()
            if (found := self._streams.pop(stream, None)) is not None:
                found.close()
            raise
        finally:
            del self._answers[stream]
        self._start_task(self._forward(stream, reader, writer))
        return theirs

    def measure_lag(self, epoch_us: int, speedup: float) -> None:
        """Let the worker measure its delays. `epoch_us` is the start of the mission on the clock of the worker."""
        self.send(Kind.LAG, {"epoch_us": epoch_us, "speedup": speedup})

    def _start_task(self, coroutine: Any) -> None:
        task = self._loop.create_task(coroutine)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _ping(self) -> None:
        while True:
            self._connection.send(Kind.PING, ping())
            await asyncio.sleep(PING_EVERY_S)
            silent_s = self._loop.time() - self._heard_s
            if silent_s > LOST_AFTER_S:
                self.close()
            elif silent_s > SILENT_S:
                for program in self._programs.values():
                    if program.killed:
                        program.finish(-signal.SIGKILL)

    async def _forward(self, stream: int, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Send the data of a pilot or ground station to the vehicle, until either end closes the connection."""
        number = stream.to_bytes(NUMBER_BYTES, "big")
        try:
            with contextlib.suppress(OSError):
                while data := await reader.read(READ_BYTES):
                    self._connection.send(Kind.STREAM, number + data)
        finally:
            self._streams.pop(stream, None)
            writer.close()
            self._connection.send(Kind.STREAM, number)

    def _receive(self, message: Message) -> None:
        self._heard_s = self._loop.time()
        number = int.from_bytes(message.payload[:NUMBER_BYTES], "big")
        match message.kind:
            case Kind.PONG:
                pass
            case Kind.READY:
                self._ready(self._program(message.document(program=int)["program"]))
            case Kind.LOG:
                with contextlib.suppress(OSError), self._program(number).output.open("ab") as file:
                    file.write(message.payload[NUMBER_BYTES:])
            case Kind.FILE:
                self._write_file(self._program(number).output.parent, message.payload[NUMBER_BYTES:])
            case Kind.EXIT:
                self._exit(message.document(program=int))
            case Kind.ANSWER:
                answer = message.document(stream=int)
                if (waiting := self._answers.get(answer["stream"])) is not None and not waiting.done():
                    waiting.set_result(answer.get("error"))
            case Kind.STREAM:
                if (writer := self._streams.get(number)) is not None:
                    data = message.payload[NUMBER_BYTES:]
                    writer.write(data) if data else writer.close()
            case Kind.LAG:
                *lines, self._lag = (self._lag + message.payload).split(b"\n")
                for line in lines:
                    self._record_lag(line)
            case _:
                raise WireError(f"a message {message.kind.name} arrived at the wrong time")

    def _ready(self, program: FarVehicle) -> None:
        if program.started.done():
            raise WireError("a vehicle program has started twice")
        program.started.set_result(None)

    def _program(self, number: object) -> FarVehicle:
        """Return the program with the number in a message of the worker. Raises WireError if no program has this
        number.
        """
        program = self._programs.get(number) if isinstance(number, int) else None
        if program is None:
            raise WireError("a message names an unknown vehicle program")
        return program

    def _write_file(self, directory: Path, payload: bytes) -> None:
        if len(payload) < FILE_HEADER.size:
            raise WireError("a message FILE is too short")
        (length,) = FILE_HEADER.unpack_from(payload)
        name, data = payload[FILE_HEADER.size : FILE_HEADER.size + length], payload[FILE_HEADER.size + length :]
        try:
            with file_path(directory, name.decode()).open("ab") as file:
                file.write(data)
        except ValueError as error:
            raise WireError(str(error)) from None
        except OSError as error:
            sys.stderr.write(f"ucp-harness: {name.decode()} of a vehicle cannot be written: {error.strerror}\n")

    def _exit(self, how: dict[str, Any]) -> None:
        program = self._program(how["program"])
        if not program.started.done():
            program.started.set_result(str(how.get("error")))
        status = how.get("status")
        program.finish(status if isinstance(status, int) else -signal.SIGKILL)
        del self._programs[program.number]
