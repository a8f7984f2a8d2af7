"""The process backend, which runs vehicles and agents as programs on this machine, in a private network. The modules
for networks and vehicles are imported only when a run needs them, because these imports are slow.
"""

import asyncio
import base64
from collections.abc import Callable
from contextlib import AbstractAsyncContextManager
from datetime import UTC, datetime
from typing import TYPE_CHECKING, ClassVar

from harness.archive.directory import RunDirectory
from harness.backend_names import BackendName
from harness.play._pace import VirtualTimePace
from harness.play.backend import Backend
from harness.play.mission import Swarm
from harness.play.progress import ProgressDisplay
from harness.scenario import Scenario

if TYPE_CHECKING:
    from harness.play.hosts._agent_hosts import AgentHosts
    from harness.play.process._program_run import ProgramRun
    from harness.play.process._run_lab import MissionLab


class ProcessBackend(Backend):
    """The backend that runs each vehicle and each agent as a process on this machine."""

    name: ClassVar[BackendName] = "process"

    def refuse(self, scenario: Scenario) -> None:
        from harness.play.process.process_preflight import refuse_unplayable

        refuse_unplayable(scenario)
        self.agent_commands(scenario)

    def agent_command(self, scenario: Scenario, agent_id: int) -> list[str]:
        """Return the command of the agent without the name of its mission file. Raises HarnessError if the command
        cannot be executed.
        """
        from harness.play.process._agent_process import agent_command

        return agent_command(scenario, agent_id)

    def agent_commands(self, scenario: Scenario) -> dict[int, list[str]]:
        """Return the command of each agent. Raises the errors of `agent_command`."""
        return {agent_id: self.agent_command(scenario, agent_id) for agent_id in scenario.roster}

    async def open_lab(self, scenario: Scenario, rundir: RunDirectory, say: Callable[[str], None]) -> "MissionLab":
        """Open the virtual network in which the vehicles and agents run. See
        `harness.play.process._run_lab.OpenLab`.
        """
        from harness.play.process.process_preflight import network_needs
        from netem.lab import Lab

        return await Lab.open(scenario.network_nodes, needs=network_needs(scenario), log=rundir.lab_log)

    def open(
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
    ) -> AbstractAsyncContextManager[Swarm]:
        return self.program_run(scenario, seed, rundir, progress, interrupted, interactive=interactive).opened()

    def program_run(
        self,
        scenario: Scenario,
        seed: int,
        rundir: RunDirectory,
        progress: ProgressDisplay,
        interrupted: asyncio.Event,
        *,
        interactive: bool,
        hosts: "AgentHosts | None" = None,
    ) -> "ProgramRun":
        """Return the run without opening it. If the agents run on other computers, `hosts` controls these agents."""
        from harness.play.process._program_run import ProgramRun
        from harness.play.process.vehicle_kinds import choose_vehicles

        # Each run needs an inception block of its own, so that blocks of different runs cannot be confused.
        unique = f"{scenario.name}, seed {seed}, {datetime.now(UTC).isoformat()}".encode()
        initial_data = unique if scenario.initial_data is None else base64.b64decode(scenario.initial_data)
        return ProgramRun(
            scenario,
            seed,
            choose_vehicles(scenario),
            initial_data,
            rundir,
            progress,
            interrupted,
            agent_commands=self.agent_commands(scenario),
            open_lab=self.open_lab,
            keeps_disks=interactive,
            hosts=hosts,
        )
