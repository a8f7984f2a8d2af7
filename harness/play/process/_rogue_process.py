"""Run the rogue node (a sender of forged messages outside the swarm) as a process in its own network namespace.

The harness starts this process, sends commands for injections to it, and stops it. The rogue node is part of the
harness and not under test. If it fails, the run fails with a MachineError.
"""

import sys
from functools import partial
from pathlib import Path
from typing import Any

from harness.archive.directory import ROGUE_CONTROL, RunDirectory
from harness.errors import MachineError
from harness.play.agent_control import AgentRefusedError, AgentSilentError
from harness.play.process.controlled_program import ControlledProgram
from harness.scenario import Scenario
from harness.scenario.changes import TimedInjection
from netem.lab import Lab


class RogueProcess:
    """The process of the rogue node. `vehicle` is the ID of the rogue node in the network. No agent has this ID."""

    def __init__(self, vehicle: int, scenario: Scenario, seed: int, rundir: RunDirectory) -> None:
        self.vehicle = vehicle
        self.sent: dict[int, int] = {}
        """The number of datagrams that each injection sent, by the number of the injection. `stop` sets these values.
        """
        self._scenario = scenario
        self._seed = seed
        self._rundir = rundir
        self._program: ControlledProgram | None = None

    async def start(self, lab: Lab) -> None:
        """Start the process and wait until it answers. Raises MachineError if this fails."""
        place = self._rundir.path
        self._program = await ControlledProgram.start(
            partial(lab.spawn, self.vehicle),
            [sys.executable, "-P", "-m", "harness.play.rogue"],
            directory=place,
            control=place / ROGUE_CONTROL,
            log=self._rundir.rogue_log,
        )
        try:
            await self._program.ready()
        except AgentSilentError as error:
            raise self._failure(str(error)) from None

    async def begin(self, epoch_us: int, captured: Path | None) -> None:
        """Start the mission of the rogue node. `captured` is the file with the keys of a captured vehicle."""
        scenario = self._scenario
        roster, keys = list(scenario.roster), None if captured is None else str(captured)
        await self._ask(
            "start", epoch_us=epoch_us, speedup=scenario.speedup, roster=roster, seed=self._seed, captured=keys
        )

    async def inject(self, injected: TimedInjection) -> None:
        """Request an injection of messages. Raises MachineError."""
        await self._ask(
            "inject", what=injected.what, number=injected.number, injection=injected.injection.model_dump(mode="json")
        )

    async def watch(self) -> None:
        """Wait for the process to end without a request, then raise MachineError."""
        try:
            await self._started.watch()
        except AgentSilentError as error:
            raise self._failure(str(error)) from None

    async def stop(self) -> None:
        """Store the numbers of sent datagrams in `sent`, and end the process. Raises MachineError if it has failed."""
        if self._program is None or self._program.process.returncode is not None:
            return
        answer = await self._ask("status")
        self.sent = {int(number): count for number, count in answer["sent"].items()}
        await self._program.stop()

    async def _ask(self, command: str, **arguments: Any) -> dict[str, Any]:
        try:
            return await self._started.ask(command, **arguments)
        except (AgentSilentError, AgentRefusedError) as error:
            raise self._failure(f"does not {command}: {error}") from None

    @property
    def _started(self) -> ControlledProgram:
        assert self._program is not None, "`start` comes first"
        return self._program

    def _failure(self, detail: str) -> MachineError:
        log = self._rundir.rogue_log
        return MachineError(f"the rogue node {detail}; its log is {log.relative_to(self._rundir.path)}")
