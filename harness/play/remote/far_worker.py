"""Run one agent on a far computer: `python -m harness.play.remote.far_worker FD DIRECTORY COMMAND...`.

The program is the first process of a private network (see `netem.far_network`), so its end also ends each process that
the agent started. The process outside (`harness.play.remote.join`) sends it connected sockets through the socket FD.
The link `keys` in DIRECTORY leads to a directory in memory, for the keys of a secured mission.

The program waits for the message `begin`, runs one incarnation of the agent, and ends. If the connection is lost before
the end, the agent continues. The program then sends `lost` to the process outside, receives another connection, and
resumes the communication where it stopped.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import os
import resource
import shutil
import signal
import socket
import sys
from collections import deque
from collections.abc import Callable, Coroutine
from functools import partial
from pathlib import Path
from typing import Any

from harness.play.process.lag_meter import LagMeter
from harness.play.remote._connection import Connection
from harness.play.remote._far_clock import pong
from harness.play.remote._forked_process import ForkedProcess
from harness.play.remote._wire import (
    ADDRESS_BYTES,
    KEYS,
    MAX_MESSAGE_BYTES,
    NUMBER_BYTES,
    SILENT_S,
    Channel,
    Kind,
    Message,
    WireError,
    take_over,
)
from harness.play.unix_sockets import short_name
from netem.far_network import FarNetwork, vehicle_at
from netem.forked_program import fork_program, limit_files
from ucp.agent_files import write_json_atomically
from ucp.plain_file import open_plain_file, read_plain_file

POLL_S = 0.05
"""Seconds of wall time between two reads of the agent's files. The program also reads the files before each datagram
and answer.
"""
READY_POLL_S = 0.02
FRAMES_PER_TURN = 64
MAX_READ_BYTES = 1 << 20
MAX_ANSWER_BYTES = 2 << 20
MAX_UNSENT_BYTES = 4 << 20
"""Maximum number of bytes that wait for a slow connection. Beyond this number, datagrams of the agent are lost, and new
lines of its trace wait in the file.
"""


class FileTail:
    """A growing file of the agent, and the number of bytes that were read from it."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.position = 0
        self._file: Any = None

    def read(self) -> bytes:
        """Return the next bytes of the file, at most `MAX_READ_BYTES`, and advance `position`. The result is empty if
        the file has no further bytes, or does not exist yet.
        """
        if self._file is None:
            try:
                self._file = open_plain_file(self._path)
            except OSError:
                return b""
        self._file.seek(self.position)
        data: bytes = self._file.read(MAX_READ_BYTES)
        self.position += len(data)
        return data


AgentProgram = asyncio.subprocess.Process | ForkedProcess
OwnAgent = Callable[[list[str]], int]


class FarWorker:
    """The agent on this computer, its network, and the connection to its stand-in."""

    def __init__(
        self, outside: socket.socket, directory: Path, command: list[str], own_agent: OwnAgent | None = None
    ) -> None:
        """Create the object. If `own_agent` is given, a fork of this process calls it with the mission file as
        argument, and `command` is not used. This is faster than starting a program.
        """
        self._own_agent = own_agent
        self._outside, self._directory, self._command = outside, directory, command
        self._loop = asyncio.get_running_loop()
        self._over = asyncio.Event()
        self._tasks: set[asyncio.Task[None]] = set()
        self._connection: Connection | None = None
        self._in_step = False
        """True if the stand-in has stated how many bytes of the agent's files it has. This program may then send the
        next bytes.
        """
        self._pinged_s = self._loop.time()
        self._frames = 0
        """Number of datagrams that the agent has sent, including datagrams that did not leave this computer."""
        self._incarnation: str | None = None
        self._agent_id = 0
        self._home = directory
        self._network: FarNetwork | None = None
        self._process: AgentProgram | None = None
        self._control: asyncio.StreamWriter | None = None
        self._asked: deque[bytes] = deque()
        """The numbers of the requests that the agent has not answered yet. The oldest number is first."""
        self._lag: LagMeter | None = None
        self._speedup = 1.0
        self._measures_lag = False
        self._store: Path | None = None
        self._bundle: Path | None = None
        """The file with the agent's keys, in a secured mission."""
        self._tails: dict[Kind, FileTail] = {}
        self._ended: dict[str, Any] | None = None
        """The message that reports the exit status of the agent, or None while the agent runs."""

    async def run(self) -> None:
        """Run until the incarnation has ended. When this process ends, the kernel ends the agent."""
        self._loop.add_reader(self._outside, self._take_over)
        await self._over.wait()
        if self._bundle is not None:
            shutil.rmtree(self._bundle.parent, ignore_errors=True)

    def _start(self, coroutine: Coroutine[Any, Any, None]) -> None:
        task = self._loop.create_task(coroutine)
        self._tasks.add(task)
        task.add_done_callback(self._finished)

    def _finished(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            sys.stderr.write(f"the agent cannot be played: {error}\n")
            self._over.set()

    # The connection

    def _take_over(self) -> None:
        taken = take_over(self._outside)
        if taken is None:
            self._over.set()
            return
        connection, state = taken
        self._start(self._connect(connection, Channel.from_json(state)))

    async def _connect(self, connection: socket.socket, channel: Channel) -> None:
        protocol = Connection(channel, self._receive, self._lost)
        before, self._connection = self._connection, protocol
        self._in_step = False
        if before is not None:
            before.close()
        await self._loop.create_connection(lambda: protocol, sock=connection)

    def _lost(self, connection: Connection) -> None:
        if connection is not self._connection or self._over.is_set():
            return
        self._connection = None
        if self._incarnation is None:
            self._over.set()  # no agent has begun, so another worker can take its place
            return
        with contextlib.suppress(OSError):
            self._outside.send(b"lost")

    def _send(self, kind: Kind, payload: bytes = b"") -> None:
        if self._connection is not None and (self._in_step or kind is Kind.PONG):
            self._connection.send(kind, payload)

    def _receive(self, message: Message) -> None:
        match message.kind:
            case Kind.PING:
                self._pinged_s = self._loop.time()
                self._send(Kind.PONG, pong(message.payload, self._frames))
            case Kind.DATAGRAM:
                self._arrive(message.payload)
            case Kind.REQUEST:
                self._request(message.payload)
            case Kind.SIGNAL:
                self._signal(int(message.document()["number"]))
            case Kind.BEGIN if self._incarnation is None:
                self._start(self._begin(message.document()))
            case Kind.BEGIN | Kind.RESUME:
                self._resume(message.document())
            case Kind.IDLE if self._incarnation is not None:
                self._over.set()  # its stand-in is dead, or knows how the agent ended
            case Kind.IDLE:
                pass
            case _:
                raise WireError(f"a message {message.kind.name} arrived at the wrong time")

    def _resume(self, state: dict[str, Any]) -> None:
        self._in_step = True
        if self._incarnation is None:
            self._send(Kind.EXIT, json.dumps({"gone": True}).encode())
            return
        if state["incarnation"] != self._incarnation:
            self._over.set()  # the lab killed this incarnation while its vehicle was cut off
            return
        for kind, tail in self._tails.items():
            tail.position = int(state["positions"][kind.name])
        self._asked = deque(b"" for _ in self._asked)  # the stand-in expects none of these answers
        self._pinged_s = self._loop.time()
        if self._control is not None:
            self._send(Kind.READY)
        if self._ended is not None:
            self._report_end(self._ended)

    # The agent

    async def _begin(self, order: dict[str, Any]) -> None:
        self._in_step = True
        self._incarnation, self._agent_id = _name(order["incarnation"]), int(order["agent_id"])
        self._speedup, self._measures_lag = float(order["speedup"]), bool(order["measures_lag"])
        self._home = self._directory / self._incarnation
        self._home.mkdir()
        mission = order.get("mission")
        if mission is not None and "store" in order:
            disks = self._directory / "disks"
            disks.mkdir(exist_ok=True)
            self._store = disks / _name(order["store"])
            mission["store"] = os.path.relpath(self._store, self._home)
        if mission is not None and "bundle" in order:
            mission["security"]["bundle"] = str(self._write_bundle(base64.b64decode(order["bundle"])))
        path = self._home / f"{self._agent_id}.mission.json"
        if mission is None:
            path.write_bytes(base64.b64decode(order["text"]))
        else:
            write_json_atomically(path, mission)
        log = self._home / f"{self._agent_id}.log"
        self._tails = {
            Kind.TRACE: FileTail(self._home / f"{self._agent_id}.trace.jsonl"),
            Kind.LOG: FileTail(log),
            Kind.LAG: FileTail(self._home / "lag.jsonl"),
        }
        self._network = FarNetwork(int(order["vehicle"]), int(order["port"]))
        most = order["max_file_bytes"]
        with log.open("ab") as output:
            try:
                limit = None if most is None else partial(limit_files, int(most))
                self._process = await self._started(path.name, output.fileno(), limit)
            except OSError as error:
                output.write(f"{self._command[0]} cannot be started: {error.strerror}\n".encode())
                self._end({"status": 1, "left_behind": []})
                return
        self._loop.add_reader(self._network.descriptor, self._leave)
        self._start(self._follow_files())
        self._start(self._wait_for_end(self._process))
        await self._connect_control(self._process)
        if self._control is not None:
            self._send(Kind.READY)
            if mission is not None and type(mission.get("epoch_us")) is int:
                await self._measure_lag(mission["epoch_us"])

    def _write_bundle(self, bundle: bytes) -> Path:
        """Write the agent's keys to a file, and return its path. Also disable core files, because they would contain
        the keys.
        """
        from ucp.secure.keyfile import write_key_file  # only an encrypted connection carries keys

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        self._bundle = self._directory / KEYS / str(self._incarnation) / f"{self._agent_id}.bundle.json"
        self._bundle.parent.mkdir()
        write_key_file(self._bundle, json.loads(bundle), secret=True)
        return self._bundle

    async def _started(self, mission: str, output: int, limit: Callable[[], None] | None) -> AgentProgram:
        """Start the agent, and return its process. Raises OSError."""
        if self._own_agent is None:
            return await asyncio.create_subprocess_exec(
                *self._command,
                mission,
                cwd=self._home,
                stdin=asyncio.subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                start_new_session=True,
                preexec_fn=limit,
            )
        own_agent = partial(self._own_agent, [mission])
        pid = fork_program(own_agent, cwd=str(self._home), env={**os.environ}, files=(output, output), prepare=limit)
        return ForkedProcess(pid, os.pidfd_open(pid))

    async def _connect_control(self, process: AgentProgram) -> None:
        """Connect to the control socket of the agent as soon as it exists."""
        while process.returncode is None:
            try:
                with short_name(self._home) as home:
                    path = f"{home}/{self._agent_id}.control"
                    reader, self._control = await asyncio.open_unix_connection(path, limit=MAX_ANSWER_BYTES)
            except OSError:
                await asyncio.sleep(READY_POLL_S)
                continue
            self._start(self._forward_answers(reader))
            return

    def _request(self, payload: bytes) -> None:
        """Forward a request to the agent. The request consists of a number of 4 bytes and a line."""
        number, line = payload[:NUMBER_BYTES], payload[NUMBER_BYTES:]
        if self._control is None:
            self._send(Kind.ANSWER, number)
            return
        self._asked.append(number)
        self._control.write(line)
        with contextlib.suppress(ValueError, RecursionError, AttributeError):
            request = json.loads(line)
            if request.get("command") == "start" and isinstance(request.get("epoch_us"), int):
                self._start(self._measure_lag(request["epoch_us"]))

    async def _forward_answers(self, reader: asyncio.StreamReader) -> None:
        """Send each answer of the agent to the harness. Before the answer, send new trace lines, and the export if the
        answer names one.
        """
        with contextlib.suppress(OSError, ValueError):  # the agent closed the socket, or sent an endless line
            while (line := await reader.readline()).endswith(b"\n") and self._asked:
                self._send_new_lines()
                if b'"path"' in line:
                    self._send_file(Kind.EXPORT, self._home / f"{self._agent_id}.chain.json")
                self._send(Kind.ANSWER, self._asked.popleft() + line)
        self._control = None
        while self._asked:
            self._send(Kind.ANSWER, self._asked.popleft())

    def _signal(self, number: int) -> None:
        if self._process is None or self._process.returncode is not None:
            return
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, number)
            if number == signal.SIGTERM:  # a stopped process cannot react to SIGTERM
                os.killpg(self._process.pid, signal.SIGCONT)

    async def _wait_for_end(self, process: AgentProgram) -> None:
        status = await process.wait()
        if self._lag is not None:
            await self._lag.stop()
        assert self._network is not None
        self._loop.remove_reader(self._network.descriptor)
        while self._leave():
            pass
        own = {os.getpid(), *([self._lag.pid] if self._lag else [])}
        left = [] if status == -signal.SIGKILL else _other_processes(own)
        self._end({"status": status, "left_behind": left})

    def _end(self, how: dict[str, Any]) -> None:
        self._ended = how
        self._report_end(how)

    def _report_end(self, how: dict[str, Any]) -> None:
        if self._connection is None or not self._in_step:
            return  # the next connection gets the report
        for kind, tail in self._tails.items():
            for data in iter(tail.read, b""):  # all of it, although the connection may be slow
                self._send(kind, data)
        self._send_file(Kind.EXPORT, self._home / f"{self._agent_id}.chain.json")
        if self._store is not None:
            self._send_file(Kind.STORE, self._store)
        if self._bundle is not None:
            self._send_file(Kind.BUNDLE, self._bundle)
        self._send(Kind.EXIT, json.dumps({**how, "datagrams": self._frames}).encode())

    # Datagrams and files

    def _leave(self) -> bool:
        """Send the datagrams that the agent has broadcast, after the trace lines that describe them. Return true if
        more datagrams may wait.
        """
        assert self._network is not None
        datagrams: list[bytes] = []
        more = True
        try:
            for _ in range(FRAMES_PER_TURN):
                if (data := self._network.read()) is not None:
                    datagrams.append(data)
        except OSError:  # no frame is left
            more = False
        self._frames += len(datagrams)
        silent = self._loop.time() - self._pinged_s > SILENT_S
        if datagrams and self._connection is not None and self._can_send() and not silent:  # else it is cut off
            lines = iter(self._tails[Kind.TRACE].read, b"")
            messages = [(Kind.TRACE, data) for data in lines] + [(Kind.DATAGRAM, data) for data in datagrams]
            self._connection.send_together(messages)
        return more

    def _arrive(self, payload: bytes) -> None:
        """Deliver a datagram from the lab to the agent. The message starts with the address of the sender (4 bytes),
        followed by the data of the datagram.
        """
        sender = vehicle_at(socket.inet_ntoa(payload[:ADDRESS_BYTES]))
        if self._network is not None and sender is not None:
            with contextlib.suppress(OSError):
                self._network.write(sender, payload[ADDRESS_BYTES:])

    async def _follow_files(self) -> None:
        while self._ended is None:
            self._send_new_lines()
            await asyncio.sleep(POLL_S)

    def _send_new_lines(self) -> None:
        for kind in self._tails:
            self._send_new(kind)

    def _send_new(self, kind: Kind) -> None:
        while self._can_send() and (data := self._tails[kind].read()):
            self._send(kind, data)

    def _can_send(self) -> bool:
        return self._connection is not None and self._in_step and self._connection.unsent <= MAX_UNSENT_BYTES

    def _send_file(self, kind: Kind, path: Path) -> None:
        with contextlib.suppress(OSError):  # the agent wrote no such file
            self._send(kind, read_plain_file(path, MAX_MESSAGE_BYTES - 1))

    async def _measure_lag(self, epoch_us: int) -> None:
        """Measure the delays of this computer in the same way as the harness measures its own machine."""
        if not self._measures_lag or self._lag is not None:
            return
        network = Path("/proc/self/ns/net").stat().st_ino
        networks = {self._agent_id: network}
        self._lag = await LagMeter.start(self._home / "lag.jsonl", epoch_us, self._speedup, networks)


def _name(text: object) -> str:
    """Return the name of a file or directory that the harness chose. Raises WireError if the name is a path."""
    if not isinstance(text, str) or not text.isalnum():
        raise WireError("a name has other characters than letters and digits")
    return text


def _other_processes(own: set[int]) -> list[str]:
    """Return the names of the processes in this network, except the processes in `own`."""
    names = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and int(entry.name) not in own:
            with contextlib.suppress(OSError):
                if (entry / "cmdline").read_bytes():  # not a process that has ended
                    names.append((entry / "comm").read_text(encoding="utf-8", errors="replace").strip())
    return sorted(names)


def play(descriptor: int, directory: Path, command: list[str], own_agent: OwnAgent | None = None) -> None:
    """Run one incarnation of an agent. `descriptor` is the file descriptor of the socket to the process outside the
    private network.
    """
    outside = socket.socket(fileno=descriptor)
    outside.setblocking(False)
    outside.set_inheritable(False)

    async def run() -> None:
        await FarWorker(outside, directory, command, own_agent).run()

    asyncio.run(run())


def main() -> None:
    play(int(sys.argv[1]), Path(sys.argv[2]), sys.argv[3:])


if __name__ == "__main__":
    main()
