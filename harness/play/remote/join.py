"""Let an agent on this computer join the labs of a harness on another computer.

A run needs one incarnation of the agent at a time, and a conformance test needs several at the same time. For each
incarnation, this process connects to the harness, proves that it knows the secret, and starts a process in a private
network (`harness.play.remote.far_worker`). The started process, the worker, receives the connection and runs the agent.
If the worker asks for another connection, this process opens one and passes it to the worker.
"""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import os
import secrets
import shutil
import signal
import socket
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, Protocol

from harness.errors import HarnessError, MachineError
from harness.play.memory_directory import KEYS_PREFIX, memory_directory
from harness.play.remote._handshake import PROTOCOL, HandshakeError, RefusedError, introduce
from harness.play.remote._wire import KEYS, Channel, hand_over, prepare
from netem import far_network
from netem.errors import LabUnavailable
from sitl.address import ListenAddress
from ucp.features import CONTRACT

if TYPE_CHECKING:
    from harness.scenario import Scenario  # a far end starts without it

CONNECT_LIMIT_S = 5.0
RETRY_S = 1.0
REJOIN_LIMIT_S = 60.0
"""The incarnation of an agent ends if the agent has no connection for this number of seconds of wall time."""
MAX_PLACES = 32
DIRECTORY = "ucp-join-"
NEW_S = 60.0
"""Minimum age in seconds of a directory that may be removed. An older directory without a lock belongs to a killed
process. A younger directory may be new and not yet locked.
"""


class JoinError(HarnessError):
    """An error: the agent cannot join a lab."""


class JoinRefusedError(JoinError):
    """An error: the harness refused the agent. The reason is in the message."""


@dataclass(frozen=True)
class JoinRequest:
    """The request of the user: the address of the harness, the agent's ID and command, and the secret."""

    host: str
    port: int
    agent_id: int
    secret: bytes
    command: Sequence[str]
    service: bool
    """True to join every run until the user ends the program."""

    @property
    def address(self) -> str:
        return f"{self.host}:{self.port}"


@dataclass(frozen=True)
class JoinedRun:
    """A connection whose other end has proved that it knows the secret."""

    connection: socket.socket
    channel: Channel
    run: str
    name: str
    places: int
    """Number of incarnations of the agent that the harness runs at the same time."""


class FarProcess(Protocol):
    """A running `harness.play.remote.far_worker`. Its process ID is also the ID of its process group."""

    @property
    def pid(self) -> int: ...

    @property
    def returncode(self) -> int | None: ...

    async def wait(self) -> int: ...


StartWorker = Callable[[socket.socket, Path, Sequence[str]], Awaitable[FarProcess]]
"""A function that starts `harness.play.remote.far_worker` in a private network. Its arguments are a socket, a
directory, and the command of the agent.
"""


def join_commands(scenario: Scenario) -> list[str]:
    """Return the commands with which users let the remote agents of a scenario join."""
    remote = scenario.remote
    if remote is None or remote.listen is None:
        return []
    return [join_command(remote.listen, agent) for agent in remote.agents]


def join_command(listen: str, agent_id: int) -> str:
    """Return the command with which a user lets an agent join a harness at this address."""
    address = ListenAddress.parse(listen)
    host = "ADDRESS-OF-THIS-COMPUTER" if address.host in ("0.0.0.0", "::") else address.host  # noqa: S104
    where = str(ListenAddress(host, address.port))
    return f"ucp-harness join {where} --as {agent_id} --secret-file FILE -- COMMAND"


class RunOverError(Exception):
    """An error: no harness listens any more, so the run has ended."""


def join(request: JoinRequest, say: Callable[[str], None]) -> None:
    """Run incarnations of the agent until the run has ended. If the request has `service`, continue with the next run,
    without end. Raises MachineError if this machine has no private networks. Raises JoinError if no harness listens, or
    if the harness refuses the agent.
    """
    try:
        first_process = far_network.first_process([sys.executable, "-P", "-m", "harness.play.remote.far_worker"])
    except LabUnavailable as error:
        raise MachineError(str(error)) from None
    asyncio.run(_Joining(request, partial(_start_worker, first_process), say).run())


async def play_incarnations(
    request: JoinRequest, start: StartWorker, say: Callable[[str], None], directory: Path
) -> None:
    """Run incarnations of one agent, whose files are in `directory`. This process may run several agents at the same
    time. Unlike `join`, connect again if the harness does not answer in time. The harness is busy if hundreds of agents
    join at the same time.
    """
    await _Joining(request, start, say, is_patient=True).play(directory)


async def _start_worker(
    first_process: Sequence[str], inside: socket.socket, directory: Path, command: Sequence[str]
) -> asyncio.subprocess.Process:
    path = os.pathsep.join(filter(None, [str(Path(__file__).parents[3]), os.environ.get("PYTHONPATH")]))
    return await asyncio.create_subprocess_exec(
        *(*first_process, str(inside.fileno()), str(directory), *command),
        stdin=asyncio.subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": path},
        pass_fds=[inside.fileno()],
        start_new_session=True,
    )


@contextmanager
def directory_of_agents() -> Iterator[Path]:
    """Create a directory for the agent's files, and remove it afterwards. Also remove the directories of killed
    processes. A directory is kept if it is locked, because its process then still runs, or if it is younger than
    `NEW_S`, because a new directory has no lock for a moment.
    """
    for path in Path(tempfile.gettempdir()).glob(f"{DIRECTORY}*"):
        with contextlib.suppress(OSError):  # of another user, or in use
            if time.time() - path.lstat().st_ctime > NEW_S:
                with _locked(path):
                    shutil.rmtree(path)
    with (
        tempfile.TemporaryDirectory(prefix=DIRECTORY) as name,
        _locked(Path(name)),
        memory_directory(KEYS_PREFIX) as keys,
    ):
        (Path(name) / KEYS).symlink_to(keys)
        yield Path(name)


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Lock a directory. Raises OSError if another process has locked it."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(descriptor)


class _Joining:
    """A far end that runs one incarnation of its agent after another."""

    def __init__(
        self, request: JoinRequest, start: StartWorker, say: Callable[[str], None], *, is_patient: bool = False
    ) -> None:
        self._request, self._start, self._say, self._is_patient = request, start, say, is_patient
        self._session = secrets.token_hex(8)
        self._said = ""

    async def run(self) -> None:
        ended = asyncio.Event()
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            loop.add_signal_handler(number, ended.set)
        with directory_of_agents() as directory:
            playing = asyncio.create_task(self.play(directory))
            waiting = asyncio.create_task(ended.wait())
            await asyncio.wait({playing, waiting}, return_when=asyncio.FIRST_COMPLETED)
            waiting.cancel()
            playing.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await playing

    async def play(self, directory: Path) -> None:
        """Run the agent until the run has ended. If the request has `service`, run the agent in all later runs, too,
        without end. Raises JoinError.
        """
        joined = False
        while True:
            try:
                connected = await self._connect()
            except RunOverError as error:
                if self._request.service:
                    self._say_once(f"waits for a harness at {self._request.address}")
                    await asyncio.sleep(RETRY_S)
                    continue
                if joined:
                    self._say("the run is over")
                    return
                raise JoinError(f"{error}: start the run first, or add --service") from None
            except JoinError as error:
                if not self._request.service:
                    raise
                self._say_once(str(error))
                await asyncio.sleep(RETRY_S)
                continue
            joined = True
            shutil.rmtree(directory / "disks", ignore_errors=True)
            self._say_once(f"agent {self._request.agent_id} has joined {connected.name!r} at {self._request.address}")
            await self._play_run(connected, directory)

    async def _connect(self) -> JoinedRun:
        """Connect to the harness. Raises RunOverError or JoinError."""
        if self._is_patient:
            return await connect_patiently(self._request, self._session)
        return await connect(self._request, self._session)

    async def _play_run(self, first: JoinedRun, directory: Path) -> None:
        """Run incarnations until the harness accepts no further connection."""
        places = [
            self._play_place(connected, first.run, directory) for connected in (first, *[None] * (first.places - 1))
        ]
        ended = await asyncio.gather(*places, return_exceptions=True)
        for error in ended:
            if not isinstance(error, JoinError | RunOverError):
                raise error

    async def _play_place(self, connected: JoinedRun | None, run: str, directory: Path) -> NoReturn:
        """Run one incarnation after another, until RunOverError or JoinError is raised. RunOverError means that the run
        has ended.
        """
        while True:
            if connected is not None:
                await self._play_incarnation(connected, directory)
            connected = await connect(self._request, self._session)
            if connected.run != run:
                connected.connection.close()
                raise RunOverError("another run has begun")

    def _say_once(self, sentence: str) -> None:
        if sentence != self._said:
            self._said = sentence
            self._say(sentence)

    async def _play_incarnation(self, connected: JoinedRun, directory: Path) -> None:
        """Run a worker process with this connection until the worker ends. If the worker asks for another connection,
        provide one.
        """
        own_end, inside = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with own_end:
            own_end.setblocking(False)
            with inside:
                worker = await self._start(inside, directory, self._request.command)
            try:
                hand_over(own_end, connected.connection, connected.channel.to_json())
                ended = asyncio.create_task(worker.wait())
                while await self._asks(own_end, ended):
                    self._say_once("the connection is lost; the agent goes on, and this program connects again")
                    if (again := await self._reconnect(connected.run, ended)) is None:
                        break
                    hand_over(own_end, again.connection, again.channel.to_json())
                    self._say_once("the connection is back")
            except OSError:  # the worker has ended
                pass
            finally:
                if worker.returncode is None:
                    with contextlib.suppress(ProcessLookupError):
                        os.killpg(worker.pid, signal.SIGKILL)
                    await worker.wait()

    async def _asks(self, own_end: socket.socket, ended: asyncio.Task[int]) -> bool:
        """Wait until the worker asks for a connection, or ends. Return true if the worker asks for a connection."""
        asking = asyncio.create_task(asyncio.get_running_loop().sock_recv(own_end, 16))
        await asyncio.wait({asking, ended}, return_when=asyncio.FIRST_COMPLETED)
        if not asking.done():
            asking.cancel()
            return False
        return bool(asking.result())

    async def _reconnect(self, run: str, ended: asyncio.Task[int]) -> JoinedRun | None:
        """Connect again. Return None if the incarnation must end, because `REJOIN_LIMIT_S` has passed or the run has
        ended.
        """
        loop = asyncio.get_running_loop()
        deadline = loop.time() + REJOIN_LIMIT_S
        while loop.time() < deadline and not ended.done():
            try:
                connected = await connect(self._request, self._session)
            except RunOverError:
                return None
            except JoinError:
                await asyncio.sleep(RETRY_S)
                continue
            if connected.run == run:
                return connected
            connected.connection.close()
            return None
        return None


async def connect_patiently(request: JoinRequest, session: str) -> JoinedRun:
    """Connect to the harness, and try again if it does not answer. Raises RunOverError if no harness listens, and
    JoinRefusedError if the harness refuses the agent.
    """
    while True:
        try:
            return await connect(request, session)
        except JoinRefusedError:
            raise
        except JoinError:
            await asyncio.sleep(RETRY_S)


async def connect(request: JoinRequest, session: str) -> JoinedRun:
    """Connect to the harness. Raises RunOverError if no harness listens, and JoinError for any other problem."""
    loop = asyncio.get_running_loop()
    where = f"the harness at {request.address}"
    hello: dict[str, Any] = {
        "protocol": PROTOCOL,
        "contract": CONTRACT,
        "agent": request.agent_id,
        "session": session,
        "command": list(request.command),
    }
    connection = None
    try:
        async with asyncio.timeout(CONNECT_LIMIT_S):
            found = await loop.getaddrinfo(request.host, request.port, type=socket.SOCK_STREAM)
            family, kind, protocol, _, place = found[0]
            connection = socket.socket(family, kind, protocol)
            prepare(connection)
            await loop.sock_connect(connection, place)
        channel, welcome = await introduce(connection, request.secret, hello)
        places = min(MAX_PLACES, int(welcome["places"]))
        return JoinedRun(connection, channel, str(welcome["run"]), str(welcome["name"]), places)
    except BaseException as error:
        if connection is not None:
            connection.close()
        match error:
            case ConnectionRefusedError():
                raise RunOverError(f"no harness listens at {request.address}") from None
            case RefusedError():
                raise JoinRefusedError(f"{where} refused agent {request.agent_id}: {error}") from None
            case HandshakeError():
                raise JoinError(f"{where} {error}") from None
            case TimeoutError():
                raise JoinError(f"{where} does not answer: check the address and the firewall") from None
            case OSError():
                why = error.strerror or error
                raise JoinError(f"{where} cannot be reached ({why}): check the address") from None
        raise
