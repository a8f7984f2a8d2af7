"""Let agents on other computers take part in a run.

A far end may connect at any time of a run. Its connection waits here until a stand-in needs it, or replaces the lost
connection of a stand-in. Each connection carries at most one incarnation of an agent. After the end of the incarnation,
the far end connects again.
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from harness.archive.directory import RunDirectory
from harness.archive.run_record import CutOff, RemoteRecord
from harness.errors import MachineError, ScenarioError
from harness.play.hosts._agent_hosts import AgentHosts
from harness.play.process.lab_program import LabProgram
from harness.play.remote._far_ends import JOIN_LIMIT_S, SOCKET, WORKER, FarEnd, FarEnds, listening
from harness.play.remote._remote_program import RemoteProgram
from harness.play.remote._stand_in_task import StandInTask
from harness.play.remote.secret_file import read_secret
from harness.scenario import Scenario
from harness.scenario.changes import NetworkChange, timeline_of
from netem.conditions import Delay, LinkConditions, NetworkConditions
from ucp.messages import PORT

MAX_MEASUREMENTS = 8
"""Maximum number of connections whose delay the harness measures at the same time. More measurements would delay each
other.
"""


@dataclass
class _RemoteVehicle:
    """A vehicle whose agent runs on another computer."""

    agent_id: int
    host: str = ""
    command: list[str] = field(default_factory=list)
    session: str = ""
    held: FarEnd | None = None
    """An unused connection to the other computer for the next incarnation of the agent, or None."""
    stand_in: socket.socket | None = None
    offset_s: float | None = None
    epoch_us: int | None = None
    delay_s: float = 0.0
    """Median delay of the connection in one direction before the run, in seconds of wall time."""
    measured: dict[str, Any] = field(default_factory=dict)
    lost: int = 0
    lost_before: int = 0
    cut_off: bool = False
    cuts: list[CutOff] = field(default_factory=list)
    left_behind: tuple[str, ...] = ()
    """Names of the processes that the last incarnation of the agent left running."""
    is_connected: bool = False
    """True if another computer is connected and runs the current incarnation."""
    incarnations: int = 0
    is_complete: bool = False
    """True if the records of the current incarnation are complete up to its end."""
    incomplete: list[int] = field(default_factory=list)
    """Numbers of the incarnations whose records lack the end."""
    joins: int = 0
    joined: asyncio.Event = field(default_factory=asyncio.Event)

    @property
    def is_alive(self) -> bool:
        """True if a far end of the agent is connected now. Its connection is either unused, or in use by a stand-in."""
        if self.held is not None:
            return self.held.is_connected
        return self.stand_in is not None and self.is_connected


class RemoteAgents:
    """The agents of a run that run on other computers. If the run has no such agents, all methods do nothing."""

    def __init__(
        self, scenario: Scenario, rundir: RunDirectory, now: Callable[[], float], hosts: AgentHosts | None = None
    ) -> None:
        """Prepare for remote agents. `hosts` are the cluster workers that run all agents of the run. Without a cluster,
        `hosts` is None, and users on other computers let the agents join.
        """
        self._scenario, self._rundir, self._now, self._hosts = scenario, rundir, now, hosts
        agents = hosts.agents if hosts else scenario.remote.agents if scenario.remote else ()
        self._vehicles = {agent: _RemoteVehicle(agent) for agent in agents}
        self._ended = False
        self._measuring = asyncio.Semaphore(MAX_MEASUREMENTS)
        self._far_ends: FarEnds | None = None
        self.when_cut_off: Callable[[], None] = lambda: None
        """A function that is called when a vehicle is cut off or connected again."""

    def __contains__(self, agent_id: int) -> bool:
        return agent_id in self._vehicles

    @property
    def cut_off(self) -> frozenset[int]:
        """The vehicles whose connection is lost."""
        return frozenset(vehicle.agent_id for vehicle in self._vehicles.values() if vehicle.cut_off)

    def was_cut_off(self, agent_id: int) -> bool:
        """Return true if the connection to the agent was lost during the run."""
        return agent_id in self._vehicles and bool(self._vehicles[agent_id].cuts)

    def loss(self, agent_id: int) -> str | None:
        """Return None if a far end runs the agent. Otherwise return a phrase that completes a sentence that starts with
        "agent 7".
        """
        vehicle = self._vehicles[agent_id]
        if vehicle.is_connected:
            return None
        return f"cannot go on, because the connection to its computer {vehicle.host} was lost"

    async def end(self) -> None:
        """Record that the mission ends, and accept no further far ends. Vehicles that are cut off now stay cut off."""
        self._ended = True
        if self._far_ends is not None:
            await self._far_ends.stop_listening()

    def program(self, agent_id: int, stand_in: LabProgram) -> LabProgram:
        """Return the program that the harness controls in place of the stand-in."""
        return RemoteProgram(stand_in, lambda: self._vehicles[agent_id].left_behind)

    def stand_in_command(self, agent_id: int) -> list[str]:
        """Return the command of a stand-in, without the mission file."""
        measures_lag = self._hosts is None  # each worker measures its delays once for all its agents
        task = StandInTask(agent_id, agent_id, agent_id, PORT, self._scenario.speedup, measures_lag)
        return task.command(self._rundir.path / SOCKET)

    @asynccontextmanager
    async def opened(self) -> AsyncIterator[None]:
        """Listen inside this context. Raises HarnessError if the address or the secret cannot be used."""
        if not self._vehicles:
            yield
            return
        secret, listeners = self._meeting_point()
        has_keys = self._scenario.security is not None
        self._far_ends = FarEnds(self, self._scenario.name, agents=len(self._vehicles), has_keys=has_keys)
        async with self._far_ends.opened(listeners, secret, self._rundir.path):
            if self._hosts is not None:
                self._hosts.start()
            try:
                yield
            finally:
                for vehicle in self._vehicles.values():
                    if vehicle.held is not None:
                        vehicle.held.connection.close()

    def _meeting_point(self) -> tuple[bytes, Sequence[socket.socket]]:
        """Return the secret that far ends must know, and the sockets to which they connect. Raises HarnessError."""
        if self._hosts is not None:
            return self._hosts.secret, self._hosts.listen()
        options = self._scenario.remote
        assert options is not None
        secret = read_secret(Path(options.secret_file))
        if options.listen is None:
            named = ", ".join(map(str, options.agents))
            raise ScenarioError(
                f"agent {named} joins from another computer, but no address is set for it: add `--listen ADDRESS:PORT`"
            )
        return secret, [listening(options.listen)]

    async def wait(self, show: Callable[[str], None]) -> None:
        """Wait until all agents have joined. Raises MachineError after `JOIN_LIMIT_S`. Raises ScenarioError if the
        scenario asks for shorter delays than the delays of the connections.
        """
        if not self._vehicles:
            return
        joining = [asyncio.create_task(self._wait_for_all(show)), asyncio.create_task(self.watch_hosts())]
        try:
            done, _ = await asyncio.wait(joining, timeout=JOIN_LIMIT_S, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in joining:
                task.cancel()
        if not done:
            missing = ", ".join(map(str, self._missing()))
            how = "look at its worker" if self._hosts else "type the command above on its computer"
            raise MachineError(f"agent {missing} did not join within {JOIN_LIMIT_S:g} s: {how}")
        for task in done:
            task.result()
        for change in timeline_of(self._scenario):
            if isinstance(change, NetworkChange):
                self.compensated(change.conditions.at_speed(self._scenario.speedup))

    async def watch_hosts(self) -> None:
        """Wait until a worker of the cluster is lost, then raise MachineError. If no cluster runs the agents, wait
        forever.
        """
        await (self._hosts.watch() if self._hosts is not None else asyncio.Event().wait())

    async def _wait_for_all(self, show: Callable[[str], None]) -> None:
        while missing := self._missing():
            show(f"waiting for agent {', '.join(map(str, missing))} to join")
            await self._vehicles[missing[0]].joined.wait()
        if self._hosts is not None:
            await self._hosts.joined()

    def _missing(self) -> list[int]:
        return [vehicle.agent_id for vehicle in self._vehicles.values() if not vehicle.joined.is_set()]

    # The methods of harness.play.remote._far_ends.Host

    def refusal(self, agent_id: int, session: str, host: str) -> str:
        if agent_id == WORKER and self._hosts is not None:
            return self._hosts.refusal(session)
        vehicle = self._vehicles.get(agent_id)
        if vehicle is None:
            awaited = ", ".join(map(str, self._vehicles))
            return f"this mission awaits agent {awaited}, not agent {agent_id}: use --as {awaited}"
        if self._hosts is not None and vehicle.session not in ("", session):
            return f"agent {agent_id} has begun in another process, and its data are lost with it"
        if vehicle.session not in ("", session) and vehicle.is_alive:
            return f"agent {agent_id} has joined from {vehicle.host} already: end that one, or use another --as"
        return ""

    async def receive(self, far_end: FarEnd) -> None:
        if far_end.agent_id == WORKER and self._hosts is not None:
            await self._hosts.receive(far_end, self._rundir.append_lag)
            return
        vehicle = self._vehicles[far_end.agent_id]
        if not vehicle.joined.is_set():
            async with self._measuring:
                vehicle.delay_s = await far_end.measured_delay()
        vehicle.host, vehicle.session, vehicle.command = far_end.host, far_end.session, far_end.command
        vehicle.joins += 1
        if vehicle.stand_in is not None:
            far_end.hand_over(vehicle.stand_in, vehicle.offset_s)
            vehicle.is_connected = True
        else:
            await far_end.keep()
            if vehicle.held is not None:
                vehicle.held.connection.close()
            vehicle.held = far_end
        vehicle.joined.set()

    def begin(self, number: int, stand_in: socket.socket) -> None:
        vehicle = self._vehicles[number]
        vehicle.stand_in = stand_in
        vehicle.lost_before += vehicle.lost
        vehicle.lost, vehicle.left_behind = 0, ()
        vehicle.incarnations += 1
        vehicle.is_complete, vehicle.is_connected = False, vehicle.held is not None
        if vehicle.held is not None:
            vehicle.held.hand_over(stand_in, vehicle.offset_s)
            vehicle.held = None

    def hear(self, number: int, stand_in: socket.socket, message: dict[str, Any]) -> None:
        vehicle = self._vehicles[number]
        if not message and vehicle.stand_in is stand_in:
            vehicle.stand_in = None
            self._set_cut_off(vehicle, False)
            if not vehicle.is_complete:
                vehicle.incomplete.append(vehicle.incarnations)
        if "gone" in message or "waits" in message:
            vehicle.is_connected = False
        vehicle.offset_s = message.get("offset_s", vehicle.offset_s)
        vehicle.epoch_us = message.get("epoch_us", vehicle.epoch_us)
        if (measured := message.get("clock")) is not None:
            most_s = max(measured["delay_most_s"], vehicle.measured.get("delay_most_s", 0.0))
            vehicle.measured = {**measured, "delay_most_s": most_s}
        if "left_behind" in message:
            vehicle.left_behind, vehicle.is_complete = tuple(message["left_behind"]), True
        vehicle.lost = message.get("lost", vehicle.lost)
        if "cut_off" in message:
            vehicle.is_connected = not message["cut_off"]
            self._set_cut_off(vehicle, message["cut_off"])
        if (line := message.get("lag")) is not None:
            self._rundir.append_lag(str(vehicle.agent_id), line.encode())

    def measure_lag(self) -> None:
        """Let the workers of a cluster measure their delays, from the start of the mission."""
        if self._hosts is not None:
            epochs_us = {vehicle.agent_id: vehicle.epoch_us for vehicle in self._vehicles.values()}
            self._hosts.measure_lag(epochs_us, self._scenario.speedup)

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
        """Return network conditions in wall time. The delay of the connection is subtracted from the delay of each
        link.

        Raises ScenarioError if a link must have a shorter delay than the connections of its agents have. If the
        scenario sets no delay for a link, the link has the delay of these connections. The record shows this delay.
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
                worker=self._hosts.worker_of(vehicle.agent_id) if self._hosts else None,
                command=vehicle.command,
                joins=vehicle.joins,
                epoch_us=vehicle.epoch_us,
                cut_off=vehicle.cuts,
                lost=vehicle.lost_before + vehicle.lost,
                incomplete=vehicle.incomplete,
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
