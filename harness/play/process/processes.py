"""The backend of processes: vehicles and agents as programs of this machine, in a private network."""

import asyncio
from collections.abc import Callable
from contextlib import AbstractAsyncContextManager
from datetime import UTC, datetime
from typing import ClassVar

from harness.archive.directory import RunDirectory
from harness.backend_names import BackendName
from harness.play.backend import Backend
from harness.play.mission import Swarm
from harness.play.process import agent
from harness.play.process.backend import ProcessRun
from harness.play.process.lab import MissionLab
from harness.play.process.preflight import network_needs, refuse_what_programs_cannot
from harness.play.process.vehicle_kinds import choose_vehicles
from harness.play.progress import Progress
from harness.scenario import Scenario
from netem.lab import Lab as ProcessLab


class Processes(Backend):
    name: ClassVar[BackendName] = "process"

    def refuse(self, scenario: Scenario) -> None:
        refuse_what_programs_cannot(scenario)
        self.agent_command(scenario)

    def agent_command(self, scenario: Scenario) -> list[str]:
        """What starts an agent, but for the mission file. Raises HarnessError if nothing would."""
        return agent.agent_command(scenario)

    async def open_lab(self, scenario: Scenario, rundir: RunDirectory, say: Callable[[str], None]) -> MissionLab:
        """What vehicles and agents live in; see `harness.play.process.lab.OpenLab`."""
        return await ProcessLab.open(scenario.on_the_air, needs=network_needs(scenario), log=rundir.lab_log)

    def open(
        self,
        scenario: Scenario,
        seed: int,
        rundir: RunDirectory,
        progress: Progress,
        interrupted: asyncio.Event,
        *,
        keeps_disks: bool = False,
    ) -> AbstractAsyncContextManager[Swarm]:
        # Another run is another mission: its blocks must not be taken for this one's.
        initial_data = f"{scenario.name}, seed {seed}, {datetime.now(UTC).isoformat()}".encode()
        return ProcessRun(
            scenario,
            seed,
            choose_vehicles(scenario),
            initial_data,
            rundir,
            progress,
            interrupted,
            agent_command=self.agent_command(scenario),
            open_lab=self.open_lab,
            keeps_disks=keeps_disks,
        ).opened()
