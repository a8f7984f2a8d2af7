"""The process backend, with agents and vehicles that run on the workers of a Dask cluster."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from harness.archive.directory import RunDirectory
from harness.errors import MachineError, ScenarioError
from harness.play._pace import VirtualTimePace
from harness.play.hosts._agent_hosts import AgentHosts
from harness.play.hosts._worker_task import why_not
from harness.play.machine.dask_cluster import connected
from harness.play.mission import Swarm
from harness.play.process._process_backend import ProcessBackend
from harness.play.process.vehicle_kinds import choose_vehicles
from harness.play.progress import ProgressDisplay
from harness.scenario import Scenario
from sitl.ardupilot import ArduPilot


class HostsBackend(ProcessBackend):
    """A backend that runs the network on this machine, and vehicles and agents on the workers of a Dask cluster."""

    def __init__(self, scheduler: str) -> None:
        """Create the backend. `scheduler` is the address of a Dask scheduler (tcp://host:port)."""
        self._scheduler = scheduler

    def refuse(self, scenario: Scenario) -> None:
        _refuse_scenario(scenario)
        super().refuse(scenario)
        programs = sorted({command[0] for command in self.agent_commands(scenario).values()})
        own = {self.agent_command(scenario, agent)[0] for agent in scenario.roster if not scenario.command_of(agent)}
        with connected(self._scheduler) as client:
            needed = [program for program in programs if program not in own]
            for worker, why in client.run(why_not, needed, _binaries(scenario), scenario.security is not None).items():
                if why is not None:
                    raise MachineError(f"the worker at {worker} cannot play agents: {why}")

    @asynccontextmanager
    async def open(
        self,
        scenario: Scenario,
        seed: int,
        rundir: RunDirectory,
        progress: ProgressDisplay,
        interrupted: asyncio.Event,
        *,
        interactive: bool = False,
        delivers_all: bool = False,
        pace: VirtualTimePace | None = None,
    ) -> AsyncIterator[Swarm]:
        commands = {
            agent: self.agent_command(scenario, agent) if scenario.command_of(agent) else None
            for agent in scenario.roster
        }
        async with AgentHosts.opened(self._scheduler, commands) as hosts:
            run = self.program_run(scenario, seed, rundir, progress, interrupted, interactive=interactive, hosts=hosts)
            async with run.opened() as swarm:
                yield swarm


def _refuse_scenario(scenario: Scenario) -> None:
    """Raise ScenarioError if the agents of the scenario cannot run on another computer."""
    if scenario.remote is not None:
        raise ScenarioError("`remote` does not work with --scheduler, which places all agents: leave out one of them")


def _binaries(scenario: Scenario) -> dict[str, str | None]:
    """Return the SHA-256 hashes of the ArduPilot programs, by path."""
    kinds = choose_vehicles(scenario).values()
    return {str(kind.binary): kind.sha256 for kind in kinds if isinstance(kind, ArduPilot)}
