"""The backend of processes: vehicles and agents as programs of this machine, in a private network.

What builds networks and flies vehicles takes its time to import, which who plays in virtual time need not wait for.
"""

import asyncio
import base64
from collections.abc import Callable
from contextlib import AbstractAsyncContextManager
from datetime import UTC, datetime
from typing import TYPE_CHECKING, ClassVar

from harness.archive.directory import RunDirectory
from harness.backend_names import BackendName
from harness.play._pace import Pace
from harness.play.backend import Backend
from harness.play.mission import Swarm
from harness.play.progress import Progress
from harness.scenario import Scenario

if TYPE_CHECKING:
    from harness.play.process._run_lab import MissionLab


class Processes(Backend):
    name: ClassVar[BackendName] = "process"

    def refuse(self, scenario: Scenario) -> None:
        from harness.play.process.process_preflight import refuse_what_programs_cannot

        refuse_what_programs_cannot(scenario)
        self.agent_commands(scenario)

    def agent_command(self, scenario: Scenario, agent_id: int) -> list[str]:
        """What starts the agent, but for the mission file. Raises HarnessError if nothing would."""
        from harness.play.process._agent_process import agent_command

        return agent_command(scenario, agent_id)

    def agent_commands(self, scenario: Scenario) -> dict[int, list[str]]:
        """What starts each agent. Raises as `agent_command`."""
        return {agent_id: self.agent_command(scenario, agent_id) for agent_id in scenario.roster}

    async def open_lab(self, scenario: Scenario, rundir: RunDirectory, say: Callable[[str], None]) -> "MissionLab":
        """What vehicles and agents live in; see `harness.play.process._run_lab.OpenLab`."""
        from harness.play.process.process_preflight import network_needs
        from netem.lab import Lab

        return await Lab.open(scenario.on_the_air, needs=network_needs(scenario), log=rundir.lab_log)

    def open(
        self,
        scenario: Scenario,
        seed: int,
        rundir: RunDirectory,
        progress: Progress,
        interrupted: asyncio.Event,
        *,
        told: bool = False,
        delivers_all: bool = False,
        pace: Pace | None = None,
    ) -> AbstractAsyncContextManager[Swarm]:
        from harness.play.process._program_backend import ProcessRun
        from harness.play.process.vehicle_kinds import choose_vehicles

        # Another run is another mission: its blocks must not be taken for this one's.
        own = f"{scenario.name}, seed {seed}, {datetime.now(UTC).isoformat()}".encode()
        initial_data = own if scenario.initial_data is None else base64.b64decode(scenario.initial_data)
        return ProcessRun(
            scenario,
            seed,
            choose_vehicles(scenario),
            initial_data,
            rundir,
            progress,
            interrupted,
            agent_commands=self.agent_commands(scenario),
            open_lab=self.open_lab,
            keeps_disks=told,
        ).opened()
