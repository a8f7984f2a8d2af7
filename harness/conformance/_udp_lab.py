"""The virtual network of a test over UDP. It has two vehicles: one for all agents under test, and one for all simulated
agents.

Each agent has its own port, so agents that are tested in parallel do not receive each other's messages.
"""

import asyncio
import json
import os
import socket
import struct
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from harness.conformance import _ports
from harness.conformance._agent_under_test import NO_KEYS, mission
from harness.conformance._state_space import SettingsVariant
from harness.errors import HarnessError, MachineError, UnsupportedError
from harness.play.agent_control import AgentRefusedError, AgentSilentError, is_shell_error, last_line_in
from harness.play.process.controlled_program import ControlledProgram, ProgramEndedError
from harness.play.process.lab_program import LabProgram
from harness.play.remote.agent_pool import AgentPool, RemoteIncarnation
from harness.play.unix_sockets import bind_path
from netem.errors import LabUnavailable, NetemError, SpawnError
from netem.lab import Lab
from ucp.features import UNSUPPORTED

AGENTS_VEHICLE, PEERS_VEHICLE = 1, 2
"""The vehicles of the lab: one for all agents under test, and one for their peers."""
FIRST_PORT = 14600
MAX_READ_BYTES = 65536
MAX_REPEATED_REQUESTS, REPEATED_REQUEST_LIMIT_S = 10, 1.0
"""Maximum number of additional requests to an agent that did not answer a request within ANSWER_LIMIT_S, and the time
limit of each additional request in seconds. An agent that answers none of the additional requests counts as hung. If
the harness itself pauses, only one of these requests is wasted.
"""
_SO_TIMESTAMPNS = 35
"""A socket option of Linux that has no name in Python."""
_TIMESPEC = struct.Struct("@qq")
ANCILLARY_BYTES = socket.CMSG_SPACE(_TIMESPEC.size)


SILENT = "it printed nothing"


class NoAgentError(HarnessError):
    """An error: the agent cannot be started, so it cannot be tested."""


class AgentEndedError(Exception):
    """An error: the agent ended without a request, or does not answer. The message describes the end."""


class AgentExitedError(AgentEndedError):
    """An error: the process of the agent ended without a request."""


class AgentHangsError(AgentEndedError):
    """An error: the agent still runs, but answered none of several requests."""


class UdpLab:
    """A virtual network in which `count` agents can be tested at the same time. Open it with `async with`. `take_port`
    reserves a UDP port for an agent.
    """

    def __init__(
        self, place: Path, command: Sequence[str], count: int, remote: AgentPool | None = None, *, small: bool = False
    ) -> None:
        self.place = place
        self.command = tuple(command)
        self.remote = remote
        """The agents on another computer. None if the agents under test run here."""
        self.small = small
        """True if the profile for small machines applies."""
        self._ports = [FIRST_PORT + number for number in range(count)]
        self._lab: Lab | None = None
        self._sockets: dict[int, socket.socket] = {}
        self._incarnations = 0

    async def __aenter__(self) -> Self:
        try:
            self._lab = await Lab.open((AGENTS_VEHICLE, PEERS_VEHICLE), log=self.place / "lab.log")
            try:
                self._sockets = dict(zip(self._ports, await self._open_sockets(), strict=True))
            except BaseException:
                await self._lab.close()
                raise
        except LabUnavailable as error:
            raise MachineError(str(error)) from None
        except NetemError as error:
            raise MachineError(f"the lab failed: {error}") from None
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for air in self._sockets.values():
            air.close()
        await self.lab.close()

    @property
    def lab(self) -> Lab:
        assert self._lab is not None, "the lab is not open"
        return self._lab

    async def _open_sockets(self) -> list[socket.socket]:
        name = "sockets"
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
            bind_path(listener, self.place / name)
            listener.listen(1)
            listener.setblocking(False)
            helper = await self.lab.spawn(
                PEERS_VEHICLE,
                [sys.executable, "-P", "-m", _ports.__name__, name, *map(str, self._ports)],
                cwd=self.place,
                env=dict(os.environ),
                stdout=self.place / "ports.log",
                stderr=self.place / "ports.log",
            )
            loop = asyncio.get_running_loop()
            accepting = asyncio.create_task(loop.sock_accept(listener))
            ending = asyncio.create_task(helper.wait())
            await asyncio.wait({accepting, ending}, return_when=asyncio.FIRST_COMPLETED)
            ending.cancel()
            if not accepting.done():
                accepting.cancel()
                raise self._no_sockets()
            connection, _ = accepting.result()
        with connection:
            connection.setblocking(True)
            descriptors: list[int] = []
            while len(descriptors) < len(self._ports):
                _, some, _, _ = socket.recv_fds(connection, 1, _ports.MAX_DESCRIPTORS)
                if not some:
                    raise self._no_sockets()
                descriptors += some
        sockets = [socket.socket(fileno=descriptor) for descriptor in descriptors]
        for air in sockets:
            air.setblocking(False)
        return sockets

    def _no_sockets(self) -> MachineError:
        return MachineError(f"no sockets in the lab: {last_line_in(self.place / 'ports.log') or SILENT}")

    def mission(
        self, variant: SettingsVariant, port: int, speedup: float, keys: Mapping[str, Any] = NO_KEYS
    ) -> dict[str, Any]:
        """Return the mission file of an agent on this port. `keys` contains additional keys of the file, and keys with
        other values.
        """
        address = self.lab.addresses[AGENTS_VEHICLE]
        return mission(variant, address=address, broadcast=self.lab.broadcast, port=port, speedup=speedup, keys=keys)

    def take_port(self) -> int:
        return self._ports.pop()

    def return_port(self, port: int) -> None:
        self._ports.append(port)

    def new_directory(self) -> Path:
        self._incarnations += 1
        directory = self.place / f"life-{self._incarnations}"
        directory.mkdir()
        return directory

    def socket_of(self, port: int) -> socket.socket:
        return self._sockets[port]


class PeerSocket:
    """The UDP socket for all simulated agents of one test. The socket receives the datagrams of the tested agent, and
    sends those of the simulated agents.

    `received` contains pairs (arrival time, datagram). The arrival time is the time at which the kernel received the
    datagram, in seconds since the Unix epoch. It does not depend on the time at which the harness reads the socket.
    """

    def __init__(self, air: UdpLab, port: int) -> None:
        self._socket = air.socket_of(port)
        self._broadcast = (air.lab.broadcast, port)
        self._own_address = air.lab.addresses[PEERS_VEHICLE]
        self._arrived = asyncio.Event()
        self.received: list[tuple[float, bytes]] = []
        self.record: list[tuple[float, bool, bytes]] = []
        """All datagrams that were sent or received. Each entry contains the wall time in seconds, true if the agent
        under test sent the datagram, and the content.
        """
        self._socket.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        with suppress(BlockingIOError):
            while True:
                self._socket.recv(MAX_READ_BYTES)  # discard datagrams of the previous agent on this port
        asyncio.get_running_loop().add_reader(self._socket, self.drain)

    def close(self) -> None:
        asyncio.get_running_loop().remove_reader(self._socket)

    def drain(self) -> None:
        """Move all datagrams from the buffer of the socket to `received` and `record`."""
        with suppress(BlockingIOError):
            while True:
                data, ancillary, _, (address, _) = self._socket.recvmsg(MAX_READ_BYTES, ANCILLARY_BYTES)
                if address != self._own_address:
                    at_s = _timestamp(ancillary)
                    self.received.append((at_s, data))
                    self.record.append((at_s, True, data))
                    self._arrived.set()

    async def arrival(self, until: float) -> None:
        """Wait until a datagram arrives, but at most until this wall time in seconds since the Unix epoch."""
        self._arrived.clear()
        with suppress(TimeoutError):
            await asyncio.wait_for(self._arrived.wait(), max(0.0, until - time.time()))

    def take(self) -> list[tuple[float, bytes]]:
        self.drain()
        received, self.received = self.received, []
        return received

    def send(self, data: bytes) -> None:
        self.record.append((time.time(), False, data))
        with suppress(BlockingIOError):
            self._socket.sendto(data, self._broadcast)


class ProcessUnderTest:
    """The process of an agent under test, with its control socket and its files."""

    def __init__(
        self, directory: Path, agent_id: int, program: ControlledProgram, incarnation: RemoteIncarnation | None
    ) -> None:
        self.directory = directory
        self.agent_id = agent_id
        self.program = program
        self._incarnation = incarnation
        self.signalled = False
        """True if the harness has sent a signal to the agent. The agent may no longer answer after a signal."""

    @classmethod
    async def start(
        cls, air: UdpLab, directory: Path, mission: dict[str, Any] | bytes, agent_id: int, port: int, speedup: float
    ) -> "ProcessUnderTest":
        """Start the process without waiting until it is ready. Raises NoAgentError if the program does not exist."""
        name = f"{agent_id}.mission.json"
        text = mission if isinstance(mission, bytes) else json.dumps(mission).encode()
        (directory / name).write_bytes(text)
        incarnation = None
        if air.remote is not None:
            incarnation = RemoteIncarnation(air.remote, agent_id, AGENTS_VEHICLE, port, speedup)
        try:
            program = await ControlledProgram.start(
                partial(_spawn, air.lab, incarnation),
                [*(incarnation.stand_in_command if incarnation else air.command), name],
                directory=directory,
                control=directory / f"{agent_id}.control",
                log=directory / f"{agent_id}.out",
            )
        except SpawnError as error:
            raise NoAgentError(str(error)) from None
        return cls(directory, agent_id, program, incarnation)

    @property
    def last_line(self) -> str:
        """The last line of the agent's output, or a sentence that the agent wrote no output."""
        return self.program.last_line or SILENT

    async def ready(self) -> None:
        """Wait until the agent answers. Raises UnsupportedError, AgentEndedError."""
        try:
            await self.program.ready()
        except AgentRefusedError as error:
            raise AgentEndedError(f"it refuses the command status: {error}") from None
        except ProgramEndedError as error:
            if self.program.process.returncode == UNSUPPORTED and not is_shell_error(self.last_line):
                raise UnsupportedError(self.last_line) from None
            raise AgentExitedError(f"it {error}: {self.last_line}") from None
        except AgentSilentError as error:
            raise AgentEndedError(f"it {error}: {self.last_line}") from None

    async def ask(self, command: str, **arguments: Any) -> dict[str, Any]:
        """Send a command to the agent, and return its answer. Raises AgentEndedError if the agent does not answer, and
        AgentRefusedError if the agent refuses the command.
        """
        try:
            return await self.program.ask(command, **arguments)
        except ProgramEndedError as error:
            raise AgentExitedError(f"it {error}: {self.last_line}") from None
        except AgentSilentError as error:
            await self.check_answers()
            raise AgentEndedError(str(error)) from None

    async def check_answers(self) -> None:
        """Raise AgentHangsError if the agent still runs but answers none of several requests."""
        for _ in range(MAX_REPEATED_REQUESTS):
            next_chance = time.monotonic() + REPEATED_REQUEST_LIMIT_S
            try:
                await self.program.ask("status", limit_s=REPEATED_REQUEST_LIMIT_S)
                return
            except AgentRefusedError:
                return
            except AgentSilentError:
                await asyncio.sleep(next_chance - time.monotonic())
        if self.program.process.returncode is None:
            raise AgentHangsError(f"it hangs: it did not answer {MAX_REPEATED_REQUESTS} requests in a row")

    async def export(self) -> dict[str, Any]:
        """Request a chain export from the agent, and return it. Raises AgentEndedError, AgentRefusedError."""
        answer = await self.ask("export")
        path = self.directory / f"{self.agent_id}.chain.json"
        try:
            document = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise AgentEndedError(f"its export {answer.get('path')!r} cannot be read: {error}") from None
        if not isinstance(document, dict):
            raise AgentEndedError("its export is not a JSON object")
        return document

    async def send_signal(self, number: int) -> None:
        self.signalled = True
        await self.program.process.send_signal(number)

    async def start_mission(self, epoch_us: int) -> int:
        """Start the mission. Return its start time by the clock of the agent's computer. Raises the errors of `ask`."""
        await self.ask("start", epoch_us=epoch_us)
        return epoch_us if self._incarnation is None else self._incarnation.epoch_us

    async def left_behind(self) -> list[str]:
        """End the processes that the ended agent left behind, and return their names."""
        return [*self.program.process.left_behind, *await self.program.end_children()]

    async def pause(self) -> None:
        self.signalled = True
        await self.program.process.pause()

    async def resume(self) -> None:
        await self.program.process.resume()
        self.signalled = False


async def _spawn(lab: Lab, incarnation: RemoteIncarnation | None, argv: Sequence[str], /, **options: Any) -> LabProgram:
    program = await lab.spawn(AGENTS_VEHICLE, argv, role="agent", **options)
    return program if incarnation is None else incarnation.controlled(program)


def _timestamp(ancillary: Sequence[tuple[int, int, bytes]]) -> float:
    for level, kind, data in ancillary:
        if (level, kind) == (socket.SOL_SOCKET, _SO_TIMESTAMPNS):
            seconds, nanoseconds = _TIMESPEC.unpack_from(data)
            return float(seconds + nanoseconds / 1e9)
    return time.time()
