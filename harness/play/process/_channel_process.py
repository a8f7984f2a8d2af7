"""Start the process that simulates a shared radio channel, forward each change to it, and stop it.

This process belongs to the harness and not to the system under test. If the process fails, the machine or the harness
has failed, and the run ends.
"""

import asyncio
import dataclasses
import json
import sys
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from harness.archive.directory import RunDirectory
from harness.archive.run_journals import CHANNEL_FILE
from harness.archive.run_record import ChannelRecord
from harness.errors import MachineError
from harness.play.agent_control import AgentRefusedError, AgentSilentError
from harness.play.process._channel_node import CONTROL, VALUE
from harness.play.process.controlled_program import ControlledProgram
from harness.scenario import Scenario
from netem.conditions import NetworkConditions
from netem.lab import Lab
from netem.radio import Place
from ucp.messages import PORT

ANSWER_LIMIT_S = 30.0
LOG = "channel.log"


class ChannelProcess:
    """The process that simulates the shared radio channel of one run."""

    def __init__(self, scenario: Scenario, seed: int, rundir: RunDirectory) -> None:
        assert scenario.network.channel is not None, "the caller checks this"
        self._model = scenario.network.channel
        self._scenario = scenario
        self._seed = seed
        self._rundir = rundir
        self._program: ControlledProgram | None = None
        self._conditions = NetworkConditions()
        self._begun = False
        self._asking = asyncio.Lock()
        """A lock for the file that carries large values. Only one command at a time may use the file."""

    async def start(self, lab: Lab) -> None:
        """Start the process and wait until it listens. Raises MachineError."""
        place = self._rundir.path
        self._program = await ControlledProgram.start(
            partial(lab.spawn, None, role="channel"),
            [sys.executable, "-P", "-m", "harness.play.process._channel_node", CHANNEL_FILE, str(PORT)],
            directory=place,
            control=place / CONTROL,
            log=place / LOG,
            answer_limit_s=ANSWER_LIMIT_S,
        )
        try:
            await self._program.ready()
        except AgentSilentError as error:
            raise self._failed(str(error)) from None

    async def begin(self, epoch_us: int, places: Mapping[int, Place]) -> None:
        """Start to deliver the broadcasts of all vehicles, in place of the switch. Mission second 0 is `epoch_us`."""
        roster = list(self._scenario.roster)
        figures = dataclasses.asdict(self._model.radio())
        await self._ask(
            "start",
            roster=roster,
            others=[self._scenario.rogue] if self._scenario.rogue else [],
            preset=self._model.preset,
            figures=figures,
            processing_s=self._model.processing_s,
            seed=self._seed,
            speedup=self._scenario.speedup,
            epoch_us=epoch_us,
        )
        self._begun = True
        await self.move(places)
        await self.apply(self._conditions)

    async def move(self, places: Mapping[int, Place]) -> None:
        """Set the positions of the vehicles."""
        ordered = [places[vehicle] for vehicle in self._scenario.roster]
        coordinates = [value for place in ordered for value in dataclasses.astuple(place)]
        await self._ask("move", places=coordinates)

    async def apply(self, conditions: NetworkConditions) -> None:
        """Apply these network conditions to all frames whose transmission ends after this call. Before the mission,
        store the conditions until the mission starts.
        """
        self._conditions = conditions
        if not self._begun:
            return
        async with self._asking:
            self._value.write_text(json.dumps(conditions.to_json()), encoding="utf-8")
            await self._ask("apply")
            self._value.unlink()

    async def clear(self) -> None:
        """End the simulation of the channel, so that the switch delivers all broadcasts from now on."""
        await self._ask("clear")

    async def totals(self) -> ChannelRecord | None:
        """Return the channel's data for run.json. Return None if the mission has not begun."""
        if not self._begun:
            return None
        async with self._asking:
            await self._ask("totals")
            totals = json.loads(self._value.read_text(encoding="utf-8"))
            self._value.unlink()
        return ChannelRecord.model_validate({"model": self._model.to_json(), **totals})

    async def watch(self) -> None:
        """Raise MachineError when the process ends, unless `stop` was called before."""
        try:
            await self._started.watch()
        except AgentSilentError as error:
            raise self._failed(str(error)) from None

    async def stop(self) -> None:
        """End the process."""
        if self._program is not None:
            await self._program.stop()

    @property
    def _value(self) -> Path:
        return self._rundir.path / VALUE

    async def _ask(self, command: str, **arguments: Any) -> None:
        try:
            await self._started.ask(command, **arguments)
        except (AgentSilentError, AgentRefusedError) as error:
            raise self._failed(f"cannot {command}: {error}") from None

    @property
    def _started(self) -> ControlledProgram:
        assert self._program is not None, "`start` comes first"
        return self._program

    def _failed(self, detail: str) -> MachineError:
        return MachineError(f"the process of the shared channel {detail}; its log is {LOG}")
