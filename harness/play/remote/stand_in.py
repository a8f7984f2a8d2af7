"""Stand in for an agent on another computer: `python -m harness.play.remote.stand_in SOCKET TASK MISSION_FILE`.

The program runs in the network of a vehicle and follows the agent contract. It carries datagrams, requests and files
between the lab and the far end, which runs the agent. SOCKET belongs to the harness, which sends connected sockets
through it (see `harness.play.remote._far_ends`), and receives measurements. TASK is a `StandInTask`.

- The trace, the log and the export arrive before the datagrams and answers that depend on them.
- If the connection is lost, the vehicle is cut off. The agent goes on, and so does this program: it answers the command
  `status` with the last status of the agent, and waits for another connection.
- SIGUSR1 and SIGUSR2 suspend and resume the agent, and SIGQUIT kills it, as SIGSTOP, SIGCONT and SIGKILL would.
- The program ends as the agent ended, by the same signal or with the same exit status.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import hashlib
import json
import os
import resource
import secrets
import signal
import socket
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from harness.play.remote._connection import Connection
from harness.play.remote._far_clock import FarClock, ping
from harness.play.remote._stand_in_task import StandInTask
from harness.play.remote._wire import (
    NUMBER_BYTES,
    SILENT_S,
    Channel,
    Kind,
    Message,
    WireError,
    take_over,
)
from harness.play.unix_sockets import connect_path
from netem import addresses
from ucp.agent_files import write_atomically
from ucp.clock import MICROSECONDS
from ucp.mission import MAX_MISSION_BYTES
from ucp.plain_file import parse_json, read_json, read_plain_file

PINGS_BEFORE_START = 8
PING_EVERY_S = 0.5
KILL_LIMIT_S = 2.0
ANSWER_LIMIT_S = 9.0
"""Maximum seconds of wall time for an answer of the agent. The harness itself waits for 10 s."""
STEP_LIMIT_S = 0.05
"""Maximum change of the far clock's offset between two incarnations, in seconds. After a greater change, mission second
0 would not be the same for all incarnations.
"""
MAX_REQUEST_BYTES = 65_536
MAX_DATAGRAM_BYTES = 65_536
DATAGRAMS_PER_TURN = 64
MAX_UNSENT_BYTES = 4 << 20
MAX_BUNDLE_BYTES = 1 << 20
FAILED = 1


class StandIn:
    """One incarnation of an agent on another computer, represented in the lab."""

    def __init__(self, outside: socket.socket, task: StandInTask, mission: bytes, directory: Path) -> None:
        """Create the object. `mission` is the content of the mission file, which may be invalid."""
        self._loop = asyncio.get_running_loop()
        self._outside, self._task, self._directory = outside, task, directory
        self._mission = mission
        self._store: Path | None = None
        self._bundle: Path | None = None
        """The file with the agent's keys, in a secured mission."""
        self._address = addresses.address(task.vehicle)
        self._agent_id = task.agent_id
        self._incarnation = secrets.token_hex(8)
        self._over: asyncio.Future[int] = self._loop.create_future()
        self._connection: Connection | None = None
        self._clock = FarClock()
        self._pongs = 0
        """Number of pongs on the current connection."""
        self._ponged_s = self._loop.time()
        self._begun = False
        self._order: bytes | None = None
        """The message to the far end that begins the incarnation. None if the far end has never joined."""
        self._heard = False
        """True if the far end has begun the incarnation."""
        self._offset_s: float | None = None
        """Seconds by which the clock of the other computer is ahead of the clock of this machine. The first incarnation
        of the agent determines the value. Later incarnations use the same value.
        """
        self._cut_off = False
        self._server: asyncio.Server | None = None
        self._udp: socket.socket | None = None
        self._opening: asyncio.Task[None] | None = None
        self._paused = False
        self._released = 0
        """Number of datagrams of the agent that this program broadcast in the lab."""
        self._lost = 0
        self._trace = (directory / f"{self._agent_id}.trace.jsonl").open("ab", buffering=0)
        self._trace_problem: str | None = None
        self._positions = {"TRACE": 0, "LOG": 0, "LAG": 0}
        self._lag = b""
        self._waiting: dict[int, asyncio.Future[bytes]] = {}
        self._requests = 0
        self._status: dict[str, Any] | None = None
        self._stop_events = False

    async def run(self) -> int:
        """Run until the agent has ended, and return its exit status or the negative number of a signal."""
        self._tell({"number": self._task.number})
        self._loop.add_reader(self._outside, self._take_over)
        for number in (signal.SIGTERM, signal.SIGINT):
            self._loop.add_signal_handler(number, self._terminate, number)
        for number, handler in {
            signal.SIGUSR1: self._pause,
            signal.SIGUSR2: self._resume,
            signal.SIGQUIT: self._kill,
        }.items():
            self._loop.add_signal_handler(number, handler)
        pinging = self._loop.create_task(self._ping())
        status = await self._over
        pinging.cancel()
        self._report()
        (self._directory / f"{self._agent_id}.control").unlink(missing_ok=True)
        return status

    def _end(self, status: int, why: str = "") -> None:
        if not self._over.done():
            if why:
                sys.stderr.write(f"{why}\n")
            self._over.set_result(status)

    def _tell(self, what: dict[str, Any]) -> None:
        """Send a message to the harness. Ignore the failure if the harness has ended, because the lab then ends too."""
        with contextlib.suppress(OSError):
            self._outside.send(json.dumps(what).encode())

    # The connection

    def _take_over(self) -> None:
        try:
            taken = take_over(self._outside)
        except BlockingIOError:
            return
        if taken is None:
            self._end(FAILED, "the harness has ended")
            return
        connection, state = taken
        self._offset_s = state["offset_s"] if self._offset_s is None else self._offset_s
        self._pongs = 0
        self._begun = self._heard  # a far end that had to end an earlier incarnation first has not begun this one
        before, self._connection = self._connection, Connection(Channel.from_json(state), self._receive, self._ended)
        if before is not None:
            before.close()
        task = self._loop.create_task(self._connect(self._connection, connection))
        self._connecting = task

    async def _connect(self, protocol: Connection, connection: socket.socket) -> None:
        await self._loop.create_connection(lambda: protocol, sock=connection)
        protocol.send(Kind.PING, ping())

    def _ended(self, connection: Connection) -> None:
        if connection is self._connection:
            self._connection = None
            self._begun = self._heard
            if self._begun:
                self._cut()
            else:
                self._tell({"waits": True})

    async def _ping(self) -> None:
        while True:
            await asyncio.sleep(PING_EVERY_S)
            if self._connection is not None and self._begun:
                self._connection.send(Kind.PING, ping())
                if self._loop.time() - self._ponged_s > SILENT_S:
                    self._cut()
            self._report()

    def _report(self) -> None:
        if self._clock.samples:
            self._tell({"clock": self._clock.to_json(), "lost": self._lost})

    def _receive(self, message: Message) -> None:
        self._heard = self._heard or message.kind not in (Kind.PONG, Kind.EXIT)
        match message.kind:
            case Kind.PONG:
                self._pong(message.payload)
            case Kind.DATAGRAM:
                self._release(message.payload)
            case Kind.TRACE:
                self._write_trace(message.payload)
            case Kind.LOG:
                self._positions["LOG"] += len(message.payload)
                os.write(sys.stdout.fileno(), message.payload)
            case Kind.LAG:
                self._forward_lag(message.payload)
            case Kind.READY:
                self._open()
            case Kind.ANSWER:
                self._answer(message.payload)
            case Kind.EXPORT:
                self._write_file(f"{self._agent_id}.chain.json", message.payload)
            case Kind.STORE:
                if self._store is not None:
                    with contextlib.suppress(OSError):
                        self._store.write_bytes(message.payload)
            case Kind.BUNDLE if self._bundle is not None:
                _write_bundle(self._bundle, message.document())
            case Kind.EXIT:
                self._exit(message)
            case _:
                raise WireError(f"a message {message.kind.name} arrived at the wrong time")

    def _pong(self, payload: bytes) -> None:
        sent = self._clock.receive(payload)
        self._ponged_s = self._loop.time()
        if self._heard:
            self._lost = sent - self._released
        self._pongs += 1
        assert self._connection is not None
        if self._pongs < PINGS_BEFORE_START:
            self._connection.send(Kind.PING, ping())
        elif not self._begun:
            self._begin(self._connection)
        elif self._pongs == PINGS_BEFORE_START:
            state = {"incarnation": self._incarnation, "positions": self._positions}
            self._connection.send(Kind.RESUME, json.dumps(state).encode())
        if self._begun and self._cut_off:
            self._return()

    def _begin(self, connection: Connection) -> None:
        self._begun = True
        if self._order is None:
            self._order = self._write_order()
        if self._bundle is not None:
            if not connection.is_encrypted:
                self._end(FAILED, "the connection is not encrypted, so the keys of the mission stay in the lab")
                return
            # Later incarnations must know that an agent has used the keys, also if its own note never arrives.
            _write_bundle(self._bundle, {"started_us": 0, **read_json(self._bundle, MAX_BUNDLE_BYTES)})
        connection.send(Kind.BEGIN, self._order)

    def _write_order(self) -> bytes:
        """Return the message with the mission. The start of the mission is converted to the time of the far clock."""
        order: dict[str, Any] = {"incarnation": self._incarnation, "positions": self._positions, **asdict(self._task)}
        try:
            mission = parse_json(self._mission)
        except ValueError:
            mission = None
        if isinstance(mission, dict):
            if type(mission.get("epoch_us")) is int:
                mission["epoch_us"] = self._far_us(mission["epoch_us"])
            if isinstance(mission.get("store"), str):
                self._store = (self._directory / mission["store"]).resolve()
                # The far end names the disk after its path here, because a reboot names the same path.
                order["store"] = hashlib.sha256(str(self._store).encode()).hexdigest()[:16]
            if (bundle := self._bundle_path(mission)) is not None:
                order["bundle"] = base64.b64encode(read_plain_file(bundle, MAX_BUNDLE_BYTES)).decode("ascii")
                self._bundle = bundle
            order["mission"] = mission
        else:
            order["text"] = base64.b64encode(self._mission).decode("ascii")
        most_bytes = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
        order["max_file_bytes"] = None if most_bytes < 0 else most_bytes
        return json.dumps(order).encode()

    def _bundle_path(self, mission: dict[str, Any]) -> Path | None:
        """Return the file with the agent's keys. Return None if there is no such file."""
        security = mission.get("security")
        name = security.get("bundle") if isinstance(security, dict) else None
        path = self._directory / name if isinstance(name, str) else None
        return path if path is not None and path.is_file() else None

    def _far_us(self, epoch_us: int) -> int:
        """Return the time on the far clock that corresponds to this time on the harness's clock."""
        now_s = self._clock.offset_s
        if self._offset_s is None:
            self._offset_s = now_s
            self._tell({"offset_s": now_s})
        elif abs(now_s - self._offset_s) > STEP_LIMIT_S:
            self._end(
                FAILED,
                f"the clock of the far computer was set by {now_s - self._offset_s:.3g} s during the run: "
                "switch off its time synchronisation, or wait until it has synchronised",
            )
        far_us = epoch_us + round(self._offset_s * MICROSECONDS)
        self._tell({"epoch_us": far_us})
        return far_us

    # Cut off

    def _cut(self) -> None:
        """Record that the far computer does not respond. From now on, this program itself answers the requests to the
        agent.
        """
        if self._cut_off or not self._begun or self._over.done():  # after its last message, the far end disconnects
            return
        self._cut_off = True
        self._tell({"cut_off": True})
        for future in self._waiting.values():
            if not future.done():
                future.set_exception(ConnectionError())
        self._waiting.clear()

    def _return(self) -> None:
        self._cut_off = False
        self._tell({"cut_off": False})
        if self._stop_events:
            self._loop.create_task(self._ask(b'{"command": "stop_events"}\n'))
            self._stop_events = False
        if self._paused:
            self._send_signal(signal.SIGSTOP)

    # Datagrams

    def _open(self) -> None:
        """Open the mission's UDP port and the control socket. Afterwards, the agent counts as ready."""
        self._open_port()
        if self._opening is None:
            self._opening = self._loop.create_task(self._serve())

    def _open_port(self) -> socket.socket:
        """Return the socket at the mission's UDP port. Open the socket if necessary."""
        if self._udp is None:
            self._udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._udp.setblocking(False)
            self._udp.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
            self._udp.bind(("", self._task.port))
            if not self._paused:
                self._loop.add_reader(self._udp, self._arrive)
        return self._udp

    def _arrive(self) -> None:
        """Send the datagrams that arrived at the vehicle to the remote agent."""
        assert self._udp is not None
        for _ in range(DATAGRAMS_PER_TURN):
            try:
                data, (address, _) = self._udp.recvfrom(MAX_DATAGRAM_BYTES)
            except OSError:
                return
            if address == self._address:
                continue  # the echo of the agent's own broadcast
            if self._connection is not None and not self._cut_off and self._connection.unsent < MAX_UNSENT_BYTES:
                self._connection.send(Kind.DATAGRAM, socket.inet_aton(address) + data)

    def _release(self, data: bytes) -> None:
        """Broadcast a datagram of the remote agent in the lab.

        The socket may not be open yet: a restarted agent can send before it is ready, because it continues with the
        blocks on its disk.
        """
        with contextlib.suppress(OSError):  # the datagram counts as lost
            self._open_port().sendto(data, (addresses.BROADCAST, self._task.port))
            self._released += 1

    # Files

    def _write_trace(self, data: bytes) -> None:
        self._positions["TRACE"] += len(data)
        if self._trace_problem is None:
            try:
                self._trace.write(data)
            except OSError as error:
                self._trace_problem = error.strerror

    def _write_file(self, name: str, data: bytes) -> None:
        try:
            write_atomically(self._directory / name, data.decode(errors="replace"))
        except OSError as error:
            sys.stderr.write(f"{name} cannot be written: {error.strerror}\n")

    def _forward_lag(self, data: bytes) -> None:
        self._positions["LAG"] += len(data)
        *lines, self._lag = (self._lag + data).split(b"\n")
        for line in lines:
            self._tell({"lag": line.decode("ascii", "replace")})

    # Requests

    async def _serve(self) -> None:
        """Create the control socket."""
        name = f"{self._agent_id}.control"
        temporary = f".{name}.{os.getpid()}"
        self._server = await asyncio.start_unix_server(self._serve_client, temporary, limit=MAX_REQUEST_BYTES)
        Path(temporary).rename(name)

    async def _serve_client(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError, ValueError):
            while (line := await reader.readline()).endswith(b"\n"):
                if not (answer := await self._handle(line)):
                    break
                writer.write(answer)
                await writer.drain()
        writer.close()

    async def _handle(self, line: bytes) -> bytes:
        """Return the answer to a request. The answer is empty if the agent closed its control socket."""
        try:
            request = parse_json(line)
        except ValueError:
            request = None
        request = request if isinstance(request, dict) else {}
        command = request.get("command")
        if command == "start" and type(request.get("epoch_us")) is int:
            line = json.dumps({**request, "epoch_us": self._far_us(request["epoch_us"])}).encode() + b"\n"
        if self._cut_off:
            return self._handle_alone(command)
        try:
            answer = await self._ask(line)
        except (ConnectionError, TimeoutError):
            return self._handle_alone(command)
        if not answer or command not in ("status", "export"):
            return answer
        return self._edited(command, answer)

    async def _ask(self, line: bytes) -> bytes:
        """Send a request to the agent and return its answer. Raises ConnectionError or TimeoutError."""
        if self._connection is None:
            raise ConnectionError
        self._requests += 1
        number = self._requests
        future = self._waiting[number] = self._loop.create_future()
        self._connection.send(Kind.REQUEST, number.to_bytes(NUMBER_BYTES, "big") + line)
        try:
            return await asyncio.wait_for(future, ANSWER_LIMIT_S)
        finally:
            self._waiting.pop(number, None)

    def _answer(self, payload: bytes) -> None:
        future = self._waiting.get(int.from_bytes(payload[:NUMBER_BYTES], "big"))
        if future is not None and not future.done():
            future.set_result(payload[NUMBER_BYTES:])

    def _edited(self, command: str, answer: bytes) -> bytes:
        """Return the answer of the agent with the values that are valid in the lab, such as the path of the export in
        the lab.
        """
        try:
            document = parse_json(answer)
        except ValueError:
            return answer
        if not isinstance(document, dict) or document.get("ok") is not True:
            return answer
        if command == "export":
            document["path"] = str(self._directory / f"{self._agent_id}.chain.json")
        else:
            self._status = document
            document["trace_problem"] = document.get("trace_problem") or self._trace_problem
        return json.dumps(document).encode() + b"\n"

    def _handle_alone(self, command: object) -> bytes:
        """Return an answer to a request while the vehicle is cut off."""
        if command == "status" and self._status is not None:
            answer = self._status
        elif command == "status":
            return b""  # the harness asks again
        elif command == "stop_events":
            self._stop_events = True  # sent when the vehicle is back
            answer = {"ok": True}
        else:
            why = "the connection to its computer is lost"
            answer = {"ok": False, "error": why}
        return json.dumps(answer).encode() + b"\n"

    # The end

    def _send_signal(self, number: int) -> None:
        if self._connection is not None:
            self._connection.send(Kind.SIGNAL, json.dumps({"number": int(number)}).encode())

    def _terminate(self, number: int) -> None:
        if self._connection is None or self._cut_off or not self._begun:
            self._end(FAILED, "the connection to the far computer is lost, so the agent could not export its chain")
        else:
            self._send_signal(number)

    def _pause(self) -> None:
        """Suspend the agent. During the pause, datagrams wait in the socket of this program, as they would wait in the
        agent's socket.
        """
        self._paused = True
        if self._udp is not None:
            self._loop.remove_reader(self._udp)
        self._send_signal(signal.SIGSTOP)

    def _resume(self) -> None:
        self._paused = False
        self._send_signal(signal.SIGCONT)
        if self._udp is not None:
            self._loop.add_reader(self._udp, self._arrive)

    def _kill(self) -> None:
        """Kill the agent, and wait until the remaining lines of its trace have arrived."""
        if self._connection is None or self._cut_off:
            self._end(-signal.SIGKILL)
            return
        self._send_signal(signal.SIGKILL)
        self._loop.call_later(KILL_LIMIT_S, self._end, -signal.SIGKILL)

    def _exit(self, message: Message) -> None:
        if message.document().get("gone"):
            self._tell({"gone": True})
            self._end(FAILED, "the far computer has started anew, and the agent of this incarnation is gone")
            return
        how = message.document(datagrams=int, left_behind=list, status=int)
        if self._connection is not None:
            self._connection.send(Kind.IDLE)  # the far end may end
        self._lost = how["datagrams"] - self._released
        self._tell({"left_behind": how["left_behind"]})
        self._end(how["status"])


def _write_bundle(path: Path, document: dict[str, Any]) -> None:
    """Replace the file with the agent's keys."""
    from ucp.secure.keyfile import write_key_file  # most missions have no keys

    write_key_file(path, document, secret=True)


def main() -> None:
    task = StandInTask.parse(sys.argv[2])
    mission = read_plain_file(Path(sys.argv[3]), MAX_MISSION_BYTES)
    outside = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        connect_path(outside, Path(sys.argv[1]))
    except OSError as error:
        sys.exit(f"the harness cannot be reached: {error.strerror}")
    outside.setblocking(False)

    async def run() -> int:
        status = await StandIn(outside, task, mission, Path.cwd()).run()
        # The loop removes its handlers before this process ends. A second SIGTERM must not replace the agent's status.
        signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGTERM, signal.SIGINT))
        return status

    status = asyncio.run(run())
    if status >= 0:
        sys.exit(status)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.pthread_sigmask(signal.SIG_UNBLOCK, (-status,))
    if -status != signal.SIGKILL:
        signal.signal(-status, signal.SIG_DFL)
    os.kill(os.getpid(), -status)


if __name__ == "__main__":
    main()
