"""Run the vehicle programs of one run on a worker, on behalf of the lab.

The worker has one connection to the lab for all its vehicles (`harness.play.hosts._worker_connection` is the other
end). The connection carries the following, as messages of `harness.play.remote`:

- `begin` starts a program, with the files of its directory. The answer is `ready` or `exit`.
- `signal` sends a signal to a program. `log` has new output of a program.
- `request` opens a TCP connection to a program, and `stream` carries data of this connection in both directions. An
  empty `stream` ends it. The pilot and a ground station use these connections.
- After the end of a program, `file` sends the files that it wrote, such as flight logs. Then `exit` sends its status.
- `ping` and `pong` show that both ends live. `lag` starts the measurement of this computer, and has its results.

If the connection is lost, the vehicles end.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import os
import shutil
import signal
import socket
import sys
from collections import deque
from collections.abc import Coroutine
from pathlib import Path
from typing import Any

from harness.play.hosts._nursery import Nursery
from harness.play.hosts._vehicle_files import FILE_HEADER, file_names, file_path
from harness.play.process.lag_meter import LagMeter
from harness.play.remote._connection import Connection
from harness.play.remote._far_clock import pong
from harness.play.remote._forked_process import ForkedProcess
from harness.play.remote._wire import NUMBER_BYTES, Kind, Message
from harness.play.remote.far_worker import FileTail
from harness.play.remote.join import JoinedRun

POLL_S = 0.1
"""Seconds of wall time between two reads of the programs' output."""
MAX_ANSWER_BYTES = 1024
READ_BYTES = 1 << 16
FILE_BYTES = 1 << 18
MAX_UNSENT_BYTES = 1 << 20
"""Limit for the data that wait to be sent to the lab, in bytes. Above this limit, the worker reads no further output
and no further files of vehicles.
"""
MAX_WAITING_BYTES = 1 << 16
"""Limit for the data that wait to be sent to a slow vehicle, in bytes. Above this limit, further data for this vehicle
are dropped.
"""
DRAIN_S = 0.02
OUTPUT = "output.log"


class _Program:
    """The program of one vehicle, and its keeper: the first process in the vehicle's network, which starts the
    program.
    """

    def __init__(self, number: int, directory: Path, keeper: socket.socket, process: ForkedProcess) -> None:
        self.number, self.directory, self.keeper, self.process = number, directory, keeper, process
        self.given: frozenset[str] = frozenset()
        """The names of the files that the lab sent. The worker does not send these files back at the end."""
        self.output = FileTail(directory / OUTPUT)
        self._answers: deque[asyncio.Future[tuple[int | None, int | None]]] = deque()

    async def ask(self, request: dict[str, Any]) -> tuple[int | None, int | None]:
        """Send a request to the keeper. Return an error number or None, and the file descriptor in the answer."""
        answer: asyncio.Future[tuple[int | None, int | None]] = asyncio.get_running_loop().create_future()
        self._answers.append(answer)
        self.tell(request)
        return await answer

    def tell(self, request: dict[str, Any]) -> None:
        with contextlib.suppress(OSError):  # it has ended
            self.keeper.send(json.dumps(request).encode())

    def hear(self) -> int | None:
        """Read a message of the keeper. Return the exit status of the program, or None while the program runs."""
        try:
            data, descriptors, _, _ = socket.recv_fds(self.keeper, MAX_ANSWER_BYTES, 1)
        except ConnectionResetError:  # the keeper ended without reading a request, and its messages follow
            return None
        except OSError:
            data = b""
        message = json.loads(data) if data else {"status": -signal.SIGKILL}
        if "status" in message:
            return int(message["status"])
        self._answers.popleft().set_result((message["error"], descriptors[0] if descriptors else None))
        return None

    async def end(self) -> None:
        """End the keeper, the program, and all processes that the program started."""
        if self.keeper.fileno() >= 0:
            asyncio.get_running_loop().remove_reader(self.keeper)
            self.keeper.close()
        for answer in self._answers:
            answer.cancel()
        await self.process.wait()


class VehicleHost:
    """The vehicle programs of a run on this worker, and the connection to the lab."""

    def __init__(self, nursery: Nursery, directory: Path) -> None:
        """Create the object. `directory` must exist. The object creates a subdirectory in it for each program."""
        self._nursery, self._directory = nursery, directory
        self._loop = asyncio.get_running_loop()
        self._programs: dict[int, _Program] = {}
        self._streams: dict[int, asyncio.StreamWriter] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._lost = asyncio.Event()
        self._connection: Connection
        self._lag: LagMeter | None = None
        self._lag_lines = FileTail(directory / "lag.jsonl")

    async def run(self, joined: JoinedRun) -> None:
        """Serve the lab until the connection ends. Then end all programs, and remove their directories."""
        self._connection = Connection(joined.channel, self._receive, lambda connection: self._lost.set())
        try:
            await self._loop.create_connection(lambda: self._connection, sock=joined.connection)
            self._start(self._follow_files())
            await self._lost.wait()
        finally:
            self._connection.close()  # before the vehicles end, so that the lab blames the worker
            for task in [*self._tasks]:
                task.cancel()
            await asyncio.gather(*self._tasks, return_exceptions=True)
            await asyncio.gather(*(program.end() for program in self._programs.values()))
            if self._lag is not None:
                await self._lag.stop()

    def _start(self, coroutine: Coroutine[Any, Any, None]) -> None:
        task = self._loop.create_task(coroutine)
        self._tasks.add(task)
        task.add_done_callback(self._finished)

    def _finished(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            sys.stderr.write(f"the vehicles cannot be played: {error!r}\n")
            self._lost.set()

    def _receive(self, message: Message) -> None:
        match message.kind:
            case Kind.PING:
                self._connection.send(Kind.PONG, pong(message.payload, 0))
            case Kind.BEGIN:
                self._start(self._begin(message.document()))
            case Kind.SIGNAL:
                order = message.document()
                if (program := self._programs.get(order["program"])) is not None:
                    program.tell({"signal": order["number"]})
            case Kind.REQUEST:
                self._start(self._connect(message.document()))
            case Kind.STREAM:
                self._write(int.from_bytes(message.payload[:NUMBER_BYTES], "big"), message.payload[NUMBER_BYTES:])
            case Kind.LAG:
                self._start(self._measure_lag(message.document()))
            case _:
                pass

    def _send(self, kind: Kind, document: dict[str, Any]) -> None:
        self._connection.send(kind, json.dumps(document).encode())

    async def _drain(self) -> None:
        while self._connection.unsent > MAX_UNSENT_BYTES:
            await asyncio.sleep(DRAIN_S)

    # Programs

    async def _begin(self, order: dict[str, Any]) -> None:
        number, directory = int(order["program"]), self._directory / str(order["program"])
        directory.mkdir()
        for name, data in order["files"].items():
            file_path(directory, name).write_bytes(base64.b64decode(data))
        keeper, inside = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with inside:
            process = self._nursery.start_vehicle(int(order["vehicle"]), inside)
        keeper.setblocking(False)
        program = self._programs[number] = _Program(number, directory, keeper, process)
        program.given = frozenset(order["files"])
        self._loop.add_reader(keeper, self._hear, program)
        argv = [sys.executable if word is None else word for word in order["argv"]]
        error, _ = await program.ask({"argv": argv, "cwd": str(directory), "output": str(directory / OUTPUT)})
        if error is None:
            self._send(Kind.READY, {"program": number})
            return
        await program.end()
        self._remove(program)
        self._send(Kind.EXIT, {"program": number, "error": f"{argv[0]}: {os.strerror(error)}"})

    def _hear(self, program: _Program) -> None:
        if (status := program.hear()) is not None:
            self._loop.remove_reader(program.keeper)
            self._start(self._end(program, status))

    async def _end(self, program: _Program, status: int) -> None:
        """Send the files of an ended program to the lab, remove these files, and report the end of the program."""
        await program.end()
        while self._send_output(program):
            await self._drain()
        for name in file_names(program.directory):
            if name != OUTPUT and name not in program.given:
                await self._send_file(program, name)
        self._remove(program)
        self._send(Kind.EXIT, {"program": program.number, "status": status})

    def _remove(self, program: _Program) -> None:
        self._programs.pop(program.number, None)
        shutil.rmtree(program.directory, ignore_errors=True)

    async def _send_file(self, program: _Program, name: str) -> None:
        tail = FileTail(program.directory / name)
        header = program.number.to_bytes(NUMBER_BYTES, "big") + FILE_HEADER.pack(len(name.encode())) + name.encode()
        while True:
            data = tail.read()
            self._connection.send_together(
                (Kind.FILE, header + data[at : at + FILE_BYTES]) for at in range(0, max(1, len(data)), FILE_BYTES)
            )
            await self._drain()
            if not data:
                return

    async def _follow_files(self) -> None:
        while True:
            for program in [*self._programs.values()]:
                if self._connection.unsent <= MAX_UNSENT_BYTES:
                    self._send_output(program)
            if data := self._lag_lines.read():
                self._connection.send(Kind.LAG, data)
            await asyncio.sleep(POLL_S)

    def _send_output(self, program: _Program) -> bool:
        """Send new output of a program. Return false if it has printed nothing since the last call."""
        data = program.output.read()
        if data:
            self._connection.send(Kind.LOG, program.number.to_bytes(NUMBER_BYTES, "big") + data)
        return bool(data)

    # Connections

    async def _connect(self, request: dict[str, Any]) -> None:
        """Open a TCP connection to a program, and forward its data until it ends."""
        stream, program = int(request["stream"]), self._programs.get(request["program"])
        if program is None:
            self._send(Kind.ANSWER, {"stream": stream, "error": "it has ended"})
            return
        error, descriptor = await program.ask({"port": request["port"], "timeout_s": request["timeout_s"]})
        if error is not None or descriptor is None:
            self._send(Kind.ANSWER, {"stream": stream, "error": os.strerror(error or 0)})
            return
        reader, writer = await asyncio.open_connection(sock=socket.socket(fileno=descriptor))
        self._streams[stream] = writer
        self._send(Kind.ANSWER, {"stream": stream, "error": None})
        number = stream.to_bytes(NUMBER_BYTES, "big")
        try:
            with contextlib.suppress(OSError):
                while data := await reader.read(READ_BYTES):
                    self._connection.send(Kind.STREAM, number + data)
                    await self._drain()
        finally:
            self._streams.pop(stream, None)
            writer.close()
            self._connection.send(Kind.STREAM, number)

    def _write(self, stream: int, data: bytes) -> None:
        if (writer := self._streams.get(stream)) is None:
            return
        if not data:
            writer.close()
        elif writer.transport.get_write_buffer_size() <= MAX_WAITING_BYTES:
            writer.write(data)

    # Lag

    async def _measure_lag(self, order: dict[str, Any]) -> None:
        """Measure the delays of this computer in the same way as the harness measures its own machine."""
        path = self._directory / "lag.jsonl"
        self._lag = await LagMeter.start(path, int(order["epoch_us"]), float(order["speedup"]), self._nursery.networks)
