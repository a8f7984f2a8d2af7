"""Wait for agents on other computers, and pass their connections to the stand-ins of a run.

A far end may connect at any time of a run. Its connection waits here until a stand-in needs it, or replaces the lost
connection of a stand-in. Each connection carries at most one incarnation of an agent. After it, the far end connects
again.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import secrets
import socket
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from harness.archive.directory import RunDirectory
from harness.archive.run_record import CutOff, RemoteRecord
from harness.errors import MachineError, ScenarioError
from harness.play.process._run_lab import LabProgram
from harness.play.remote._far_clock import FarClock, ping
from harness.play.remote._handshake import PROTOCOL, HandshakeError, Hello, receive_hello
from harness.play.remote._remote_program import RemoteProgram
from harness.play.remote._wire import Channel, Kind, WireError, bind_path, hand_over, prepare
from harness.play.remote.secret_file import read_secret
from harness.scenario import Scenario
from harness.scenario.agent_options import RemoteOptions
from harness.scenario.changes import NetworkChange, timeline_of
from netem.conditions import Delay, LinkConditions, NetworkConditions
from sitl.address import ListenAddress
from ucp.features import CONTRACT

SOCKET = "join"
JOIN_LIMIT_S = 300.0
"""Wall seconds in which all remote agents must join before the run."""
PINGS = 20
PING_LIMIT_S = 10.0
MAX_HANDSHAKES = 16
"""Maximum number of connections in their handshake. Further connections are closed at once."""
MAX_COMPLAINTS = 10
MAX_STAND_IN_BYTES = 4096
MAX_TEXT = 200


@dataclass
class _RemoteVehicle:
    """A vehicle whose agent runs on another computer."""

    agent_id: int
    host: str = ""
    command: list[str] = field(default_factory=list)
    session: str = ""
    held: tuple[socket.socket, Channel] | None = None
    """The connection that waits for a stand-in."""
    stand_in: socket.socket | None = None
    offset_s: float | None = None
    epoch_us: int | None = None
    delay_s: float = 0.0
    """Median delay of the connection in one direction, in wall seconds, before the run."""
    measured: dict[str, Any] = field(default_factory=dict)
    lost: int = 0
    lost_before: int = 0
    cut_off: bool = False
    cuts: list[CutOff] = field(default_factory=list)
    left_behind: tuple[str, ...] = ()
    """Names of the processes that the last incarnation of the agent left running."""
    joins: int = 0
    joined: asyncio.Event = field(default_factory=asyncio.Event)


class RemoteAgents:
    """The agents of a run that are on other computers. Without such agents, all methods do nothing."""

    def __init__(self, scenario: Scenario, rundir: RunDirectory, now: Callable[[], float]) -> None:
        self._scenario, self._rundir, self._now = scenario, rundir, now
        self._run = secrets.token_hex(8)
        self._vehicles = {agent: _RemoteVehicle(agent) for agent in (scenario.remote.agents if scenario.remote else ())}
        self._tasks: set[asyncio.Task[None]] = set()
        self._handshakes = 0
        self._complaints = 0
        self._ended = False
        self.when_cut_off: Callable[[], None] = lambda: None
        """Called when a vehicle was cut off, or came back."""

    def __contains__(self, agent_id: int) -> bool:
        return agent_id in self._vehicles

    @property
    def cut_off(self) -> frozenset[int]:
        """The vehicles whose connection is lost."""
        return frozenset(vehicle.agent_id for vehicle in self._vehicles.values() if vehicle.cut_off)

    def was_cut_off(self, agent_id: int) -> bool:
        """Return true if the connection to the agent was lost during the run."""
        return agent_id in self._vehicles and bool(self._vehicles[agent_id].cuts)

    def end(self) -> None:
        """Keep the vehicles cut off that are cut off now, because the mission ends."""
        self._ended = True

    def program(self, agent_id: int, stand_in: LabProgram) -> LabProgram:
        """Return the program that the harness controls in place of the stand-in."""
        return RemoteProgram(stand_in, lambda: self._vehicles[agent_id].left_behind)

    def stand_in_command(self) -> list[str]:
        """Return the command of a stand-in, without the mission file."""
        return [sys.executable, "-P", "-m", "harness.play.remote.stand_in", str(self._rundir.path / SOCKET)]

    @asynccontextmanager
    async def opened(self) -> AsyncIterator[None]:
        """Listen inside this context. Raises HarnessError if the address or the secret cannot be used."""
        options = self._scenario.remote
        if options is None:
            yield
            return
        secret = read_secret(Path(options.secret_file))
        listener = _listening(options)
        inside = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        path = self._rundir.path / SOCKET
        try:
            with listener, inside:
                bind_path(inside, path)
                path.chmod(0o600)
                inside.listen()
                inside.setblocking(False)
                accepting = [
                    asyncio.create_task(self._accept(listener, secret)),
                    asyncio.create_task(self._accept_stand_ins(inside)),
                ]
                try:
                    yield
                finally:
                    for task in (*accepting, *self._tasks):
                        task.cancel()
                    await asyncio.gather(*accepting, *self._tasks, return_exceptions=True)
                    self._close()
        finally:
            path.unlink(missing_ok=True)

    def _close(self) -> None:
        for vehicle in self._vehicles.values():
            if vehicle.held is not None:
                vehicle.held[0].close()
            if vehicle.stand_in is not None:
                asyncio.get_running_loop().remove_reader(vehicle.stand_in)
                vehicle.stand_in.close()

    async def wait(self, show: Callable[[str], None]) -> None:
        """Wait until all agents have joined. Raises MachineError after `JOIN_LIMIT_S`, and ScenarioError if the
        scenario asks for shorter delays than the connections have.
        """
        if not self._vehicles:
            return
        try:
            async with asyncio.timeout(JOIN_LIMIT_S):
                while missing := [str(v.agent_id) for v in self._vehicles.values() if not v.joined.is_set()]:
                    show(f"waiting for agent {', '.join(missing)} to join")
                    await self._vehicles[int(missing[0])].joined.wait()
        except TimeoutError:
            raise MachineError(
                f"agent {', '.join(missing)} did not join within {JOIN_LIMIT_S:g} s: type the command above on its "
                "computer"
            ) from None
        for change in timeline_of(self._scenario):
            if isinstance(change, NetworkChange):
                self.compensated(change.conditions.at_speed(self._scenario.speedup))

    # Far ends

    def _start(self, coroutine: Any) -> None:
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
            if self._handshakes >= MAX_HANDSHAKES:
                connection.close()
                continue
            self._handshakes += 1
            self._start(self._greet(connection, str(address[0]), secret))

    async def _greet(self, connection: socket.socket, host: str, secret: bytes) -> None:
        """Check a new connection, and keep it for a stand-in."""
        try:
            prepare(connection)
            hello = await receive_hello(connection, secret)
            vehicle, refused = self._vehicle_for(hello, host)
            if vehicle is None:
                await hello.answer({"refused": refused})
                self._complain(f"{host} was refused: {refused}")
                connection.close()
                return
            channel = await hello.answer({"run": self._run, "name": self._scenario.name})
            if not vehicle.joined.is_set():
                vehicle.delay_s = await _measured_delay(connection, channel)
            vehicle.host, vehicle.session = host, hello.words["session"]
            vehicle.command = [str(word)[:MAX_TEXT] for word in hello.words["command"]]
            vehicle.joins += 1
            await self._keep(vehicle, connection, channel)
            vehicle.joined.set()
        except (HandshakeError, WireError) as error:
            self._complain(f"{host} {error}")
            connection.close()
        except (OSError, TimeoutError):
            connection.close()
        except asyncio.CancelledError:
            connection.close()
            raise
        finally:
            self._handshakes -= 1

    def _vehicle_for(self, hello: Hello, host: str) -> tuple[_RemoteVehicle | None, str]:
        """Return the vehicle that a far end asks for, or a sentence that refuses it."""
        words = hello.words
        if words.get("protocol") != PROTOCOL or words.get("contract") != CONTRACT:
            mine = f"{PROTOCOL} and version {CONTRACT} of the agent contract"
            return None, f"this harness has {mine}: install the same version of ucp-harness on both computers"
        agent_id, session, command = words.get("agent"), words.get("session"), words.get("command")
        if type(agent_id) is not int or not isinstance(session, str) or not isinstance(command, list):
            return None, "its hello lacks the agent, the session or the command"
        vehicle = self._vehicles.get(agent_id)
        if vehicle is None:
            awaited = ", ".join(map(str, self._vehicles))
            return None, f"this mission awaits agent {awaited}, not agent {agent_id}: use --as {awaited}"
        if vehicle.session not in ("", session) and _is_alive(vehicle):
            return None, f"agent {agent_id} has joined from {vehicle.host} already: end that one, or use another --as"
        return vehicle, ""

    async def _keep(self, vehicle: _RemoteVehicle, connection: socket.socket, channel: Channel) -> None:
        if vehicle.stand_in is not None:
            self._hand_over(vehicle, connection, channel)
            return
        await asyncio.get_running_loop().sock_sendall(connection, channel.encode(Kind.IDLE))
        if vehicle.held is not None:
            vehicle.held[0].close()
        vehicle.held = connection, channel

    def _hand_over(self, vehicle: _RemoteVehicle, connection: socket.socket, channel: Channel) -> None:
        assert vehicle.stand_in is not None
        with contextlib.suppress(OSError):  # the stand-in has ended
            hand_over(vehicle.stand_in, connection, {**channel.to_json(), "offset_s": vehicle.offset_s})

    def _complain(self, sentence: str) -> None:
        self._complaints += 1
        if self._complaints <= MAX_COMPLAINTS:
            sys.stderr.write(f"ucp-harness: {sentence}\n")

    # Stand-ins

    async def _accept_stand_ins(self, inside: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        while True:
            connection, _ = await loop.sock_accept(inside)
            first = json.loads(await loop.sock_recv(connection, MAX_STAND_IN_BYTES))
            vehicle = self._vehicles[first["agent"]]
            vehicle.stand_in = connection
            vehicle.lost_before += vehicle.lost
            vehicle.lost, vehicle.left_behind = 0, ()
            loop.add_reader(connection, self._hear, vehicle, connection)
            if vehicle.held is not None:
                held, vehicle.held = vehicle.held, None
                self._hand_over(vehicle, *held)

    def _hear(self, vehicle: _RemoteVehicle, stand_in: socket.socket) -> None:
        """Read a message of a stand-in."""
        try:
            data = stand_in.recv(MAX_STAND_IN_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            asyncio.get_running_loop().remove_reader(stand_in)
            stand_in.close()
            if vehicle.stand_in is stand_in:
                vehicle.stand_in = None
                self._set_cut_off(vehicle, False)
            return
        message = json.loads(data)
        vehicle.offset_s = message.get("offset_s", vehicle.offset_s)
        vehicle.epoch_us = message.get("epoch_us", vehicle.epoch_us)
        if (measured := message.get("clock")) is not None:
            most_s = max(measured["delay_most_s"], vehicle.measured.get("delay_most_s", 0.0))
            vehicle.measured = {**measured, "delay_most_s": most_s}
        vehicle.left_behind = tuple(message.get("left_behind", vehicle.left_behind))
        vehicle.lost = message.get("lost", vehicle.lost)
        if "cut_off" in message:
            self._set_cut_off(vehicle, message["cut_off"])
        if (line := message.get("lag")) is not None:
            self._rundir.append_lag(vehicle.agent_id, line)

    def _set_cut_off(self, vehicle: _RemoteVehicle, cut_off: bool) -> None:
        if vehicle.cut_off == cut_off or self._ended:
            return
        vehicle.cut_off = cut_off
        at_s = round(self._now(), 3)
        if cut_off:
            vehicle.cuts.append(CutOff(from_s=at_s))
        else:
            vehicle.cuts[-1].until_s = at_s
        self.when_cut_off()

    # Network conditions and records

    def compensated(self, conditions: NetworkConditions) -> NetworkConditions:
        """Return network conditions in wall time, with delays that are shorter by the delay of the connections.

        Raises ScenarioError if a link must have a shorter delay than its connections have. A link for which the
        scenario asks for no delay keeps the delay of its connections, which the record shows.
        """
        if not self._vehicles:
            return conditions
        links = dict(conditions.links)
        for sender in self._scenario.roster:
            for receiver in self._scenario.roster:
                cost_s = sum(self._vehicles[end].delay_s for end in (sender, receiver) if end in self._vehicles)
                link = conditions.link(sender, receiver)
                if sender != receiver and cost_s and link.delay is not None:
                    links[sender, receiver] = _sooner(link, link.delay, cost_s, (sender, receiver))
        return replace(conditions, links=links)

    def records(self) -> dict[str, RemoteRecord]:
        """Return the record of each remote agent for run.json."""
        return {
            str(vehicle.agent_id): RemoteRecord(
                host=vehicle.host,
                command=vehicle.command,
                joins=vehicle.joins,
                epoch_us=vehicle.epoch_us,
                cut_off=vehicle.cuts,
                lost=vehicle.lost_before + vehicle.lost,
                **vehicle.measured,
            )
            for vehicle in self._vehicles.values()
        }


def _sooner(link: LinkConditions, delay: Delay, cost_s: float, pair: tuple[int, int]) -> LinkConditions:
    if delay.mean_s == 0:
        return link
    if delay.mean_s - delay.jitter_s < cost_s:
        least_ms = 1000 * (delay.mean_s - delay.jitter_s)
        raise ScenarioError(
            f"the link from {pair[0]} to {pair[1]} must have a delay of {least_ms:.3g} ms "
            f"of wall time, but the connection to the other computer alone takes {1000 * cost_s:.3g} ms: use a smaller "
            "`speedup`, a greater delay, or a faster connection"
        )
    return replace(link, delay=replace(delay, mean_s=delay.mean_s - cost_s))


def _is_alive(vehicle: _RemoteVehicle) -> bool:
    """Return true if the far end that joined before still has a connection."""
    if vehicle.held is not None:
        try:
            return vehicle.held[0].recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT) != b""
        except BlockingIOError:
            return True
        except OSError:
            return False
    return vehicle.stand_in is not None and not vehicle.cut_off


async def _measured_delay(connection: socket.socket, channel: Channel) -> float:
    """Return the median delay of a new connection in one direction, in seconds. Raises OSError or WireError."""
    loop, clock = asyncio.get_running_loop(), FarClock()
    async with asyncio.timeout(PING_LIMIT_S):
        for _ in range(PINGS):
            await loop.sock_sendall(connection, channel.encode(Kind.PING, ping()))
            answers: list[Any] = []
            while not answers:
                if not (data := await loop.sock_recv(connection, 1024)):
                    raise HandshakeError("closed the connection before the run")
                answers = channel.decode(data)
            clock.receive(answers[0].payload)
    return clock.delay_s


def _listening(options: RemoteOptions) -> socket.socket:
    if options.listen is None:
        named = ", ".join(map(str, options.agents))
        raise ScenarioError(
            f"agent {named} joins from another computer, but no address is set for it: add `--listen ADDRESS:PORT`"
        )
    address = ListenAddress.parse(options.listen)
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
            f"the harness cannot listen at {options.listen} ({error.strerror}): name an address of this machine, and a "
            "free port"
        ) from None
    listener.setblocking(False)
    return listener
