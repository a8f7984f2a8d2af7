"""Accept the connections of other computers on which agents run (far ends), and pass each connection to a stand-in.

A stand-in is the local program that represents such an agent. Runs (`_remote_agents`) and conformance tests
(`agent_pool`) use this module through the interface `Host`. The host decides which far ends it accepts, and which
stand-in receives each connection.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import secrets
import socket
import sys
from collections.abc import AsyncIterator, Coroutine, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from harness.errors import MachineError
from harness.play.remote._far_clock import FarClock, ping
from harness.play.remote._handshake import PROTOCOL, HandshakeError, Hello, receive_hello
from harness.play.remote._wire import Channel, Kind, WireError, hand_over, prepare
from harness.play.unix_sockets import bind_path
from sitl.address import ListenAddress
from ucp.features import CONTRACT

SOCKET = "join"
WORKER = 0
"""The ID that a worker of a cluster sends in place of an agent ID, when it connects for its vehicles
(`harness.play.hosts`). In this case, the session is the address of the worker.
"""
JOIN_LIMIT_S = 300.0
"""Time limit for the connection of all far ends, in seconds of wall time."""
PINGS = 20
PING_LIMIT_S = 10.0
MAX_HANDSHAKES = 16
"""Maximum number of connections that perform their handshake at the same time, in addition to one connection for each
agent. Further connections are closed immediately.
"""
MAX_COMPLAINTS = 10
MAX_STAND_IN_BYTES = 4096
MAX_TEXT = 200


@dataclass
class FarEnd:
    """A connection from another computer. The other computer knows the secret and offers to run an agent."""

    agent_id: int
    session: str
    """An identifier that all connections of one `ucp-harness join` share."""
    command: list[str]
    host: str
    connection: socket.socket
    channel: Channel

    @property
    def is_connected(self) -> bool:
        """True if the far end has not closed the connection. No other code may read from the connection yet."""
        try:
            return self.connection.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT) != b""
        except BlockingIOError:
            return True
        except OSError:
            return False

    async def keep(self) -> None:
        """Inform the far end that its connection stays unused until an incarnation of its agent starts. Raises
        OSError.
        """
        loop = asyncio.get_running_loop()
        await loop.sock_sendall(self.connection, self.channel.encode(Kind.IDLE))

    def hand_over(self, stand_in: socket.socket, offset_s: float | None) -> None:
        """Pass the connection to a stand-in. `offset_s` is the offset of the far clock in seconds, or None before its
        first measurement.
        """
        with contextlib.suppress(OSError):  # the stand-in has ended
            hand_over(stand_in, self.connection, {**self.channel.to_json(), "offset_s": offset_s})

    async def measured_delay(self) -> float:
        """Return the median delay of the new connection in one direction, in seconds. Raises OSError or WireError."""
        loop, clock = asyncio.get_running_loop(), FarClock()
        async with asyncio.timeout(PING_LIMIT_S):
            for _ in range(PINGS):
                await loop.sock_sendall(self.connection, self.channel.encode(Kind.PING, ping()))
                answers: list[Any] = []
                while not answers:
                    if not (data := await loop.sock_recv(self.connection, 1024)):
                        raise HandshakeError("closed the connection before the run")
                    answers = self.channel.decode(data)
                clock.receive(answers[0].payload)
        return clock.delay_s


class Host(Protocol):
    """The owner of the connections to other computers: a run or a conformance test."""

    def refusal(self, agent_id: int, session: str, host: str) -> str:
        """Return the sentence with which the host refuses a far end. Return an empty text if the host accepts the far
        end.
        """

    async def receive(self, far_end: FarEnd) -> None:
        """Accept a new connection of a far end. Raises HandshakeError, WireError or OSError if the connection fails."""

    def begin(self, number: int, stand_in: socket.socket) -> None:
        """Accept the connection of a new stand-in. `number` identifies the stand-in, as `StandInTask.number` does."""

    def hear(self, number: int, stand_in: socket.socket, message: dict[str, Any]) -> None:
        """Handle a message of a stand-in. An empty message means that the stand-in has ended."""


class FarEnds:
    """The sockets at which far ends (agents on other computers) connect, and tasks for their connections."""

    def __init__(self, host: Host, name: str, *, places: int = 1, agents: int = 1, has_keys: bool = False) -> None:
        """Create the object without listening. `name` describes the run to the user of the other computer.

        `places` is the number of incarnations that each far end runs at the same time. `agents` is the number of agents
        that may join at the same time. If `has_keys` is true, the harness sends keys to the agents, and accepts only
        encrypted connections.
        """
        self._max_handshakes = MAX_HANDSHAKES + agents
        self._host, self._name, self._places, self._has_keys = host, name, places, has_keys
        self._run = secrets.token_hex(8)
        self._accepting: dict[socket.socket, asyncio.Task[None]] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._stand_ins: set[socket.socket] = set()
        self._handshakes = 0
        self._complaints = 0

    @asynccontextmanager
    async def opened(self, listeners: Sequence[socket.socket], secret: bytes, directory: Path) -> AsyncIterator[None]:
        """Accept far ends inside this context, and close the listening sockets at its end."""
        inside = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        path = directory / SOCKET
        try:
            with contextlib.ExitStack() as sockets:
                for each in (*listeners, inside):
                    sockets.enter_context(each)
                bind_path(inside, path)
                path.chmod(0o600)
                inside.listen(MAX_HANDSHAKES)
                inside.setblocking(False)
                self._accepting = {
                    listener: asyncio.create_task(self._accept(listener, secret)) for listener in listeners
                }
                accepting = asyncio.create_task(self._accept_stand_ins(inside))
                try:
                    yield
                finally:
                    await self.stop_listening()
                    for task in (accepting, *self._tasks):
                        task.cancel()
                    await asyncio.gather(accepting, *self._tasks, return_exceptions=True)
                    for stand_in in [*self._stand_ins]:
                        self._forget(stand_in)
        finally:
            path.unlink(missing_ok=True)

    async def stop_listening(self) -> None:
        """Close the listening sockets. A far end that cannot connect again concludes that no other incarnation of its
        agent follows.
        """
        for task in self._accepting.values():
            task.cancel()
        await asyncio.gather(*self._accepting.values(), return_exceptions=True)
        for listener in self._accepting:
            listener.close()

    def _start(self, coroutine: Coroutine[Any, Any, None]) -> None:
        task = asyncio.create_task(coroutine)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _accept(self, listener: socket.socket, secret: bytes) -> None:
        loop = asyncio.get_running_loop()
        while True:
            try:
                connection, address = await loop.sock_accept(listener)
            except OSError:  # no file descriptor is free, or the client has gone
                await asyncio.sleep(1.0)
                continue
            if self._handshakes >= self._max_handshakes:
                connection.close()
                continue
            self._handshakes += 1
            self._start(self._greet(connection, str(address[0]), secret))

    async def _greet(self, connection: socket.socket, host: str, secret: bytes) -> None:
        """Check a new connection, and pass it to the host."""
        try:
            prepare(connection)
            hello = await receive_hello(connection, secret)
            if refused := self.refusal(hello, host):
                await hello.answer({"refused": refused})
                self._warn(f"{host} was refused: {refused}")
                connection.close()
                return
            channel = await hello.answer({"run": self._run, "name": self._name, "places": self._places})
            words = hello.words
            command = [str(word)[:MAX_TEXT] for word in words["command"]]
            await self._host.receive(FarEnd(words["agent"], words["session"], command, host, connection, channel))
        except (HandshakeError, WireError) as error:
            self._warn(f"{host} {error}")
            connection.close()
        except (OSError, TimeoutError):
            connection.close()
        except asyncio.CancelledError:
            connection.close()
            raise
        finally:
            self._handshakes -= 1

    def refusal(self, hello: Hello, host: str) -> str:
        """Return the sentence with which the host refuses a far end. Return an empty text if the host accepts it."""
        words = hello.words
        if words.get("protocol") != PROTOCOL or words.get("contract") != CONTRACT:
            mine = f"{PROTOCOL} and version {CONTRACT} of the agent contract"
            return f"this harness has {mine}: install the same version of ucp-harness on both computers"
        agent_id, session, command = words.get("agent"), words.get("session"), words.get("command")
        if type(agent_id) is not int or not isinstance(session, str) or not isinstance(command, list):
            return "its hello lacks the agent, the session or the command"
        if self._has_keys and not hello.is_encrypted:
            return (
                "this mission has keys, which must travel encrypted: run `pip install 'ucp-harness[secure]'` on the "
                "agent's computer"
            )
        return self._host.refusal(agent_id, session, host)

    def _warn(self, sentence: str) -> None:
        self._complaints += 1
        if self._complaints <= MAX_COMPLAINTS:
            sys.stderr.write(f"ucp-harness: {sentence}\n")

    # Stand-ins

    async def _accept_stand_ins(self, inside: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        while True:
            stand_in, _ = await loop.sock_accept(inside)
            first = await loop.sock_recv(stand_in, MAX_STAND_IN_BYTES)
            if not first:  # it was killed at its start
                stand_in.close()
                continue
            number = json.loads(first)["number"]
            self._stand_ins.add(stand_in)
            self._host.begin(number, stand_in)
            loop.add_reader(stand_in, self._hear, number, stand_in)

    def _hear(self, number: int, stand_in: socket.socket) -> None:
        """Read all messages of a stand-in that have arrived. A stand-in sends these messages before it sends the answer
        of its agent. The host therefore reads the messages before the answer.
        """
        data = b"-"
        while data:
            try:
                data = stand_in.recv(MAX_STAND_IN_BYTES)
            except BlockingIOError:
                return
            except OSError:
                data = b""
            if not data:
                self._forget(stand_in)
            self._host.hear(number, stand_in, json.loads(data) if data else {})

    def _forget(self, stand_in: socket.socket) -> None:
        self._stand_ins.discard(stand_in)
        asyncio.get_running_loop().remove_reader(stand_in)
        stand_in.close()


def listening(listen: str) -> socket.socket:
    """Return a socket that listens at ADDRESS:PORT. Raises MachineError if the address cannot be used."""
    address = ListenAddress.parse(listen)
    try:
        family, kind, protocol, _, place = socket.getaddrinfo(address.host, address.port, type=socket.SOCK_STREAM)[0]
        listener = socket.socket(family, kind, protocol)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(place)
            listener.listen(MAX_HANDSHAKES)
        except OSError:
            listener.close()
            raise
    except OSError as error:
        raise MachineError(
            f"the harness cannot listen at {listen} ({error.strerror}): name an address of this machine, and a "
            "free port"
        ) from None
    listener.setblocking(False)
    return listener
