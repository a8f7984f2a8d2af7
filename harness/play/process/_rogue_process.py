"""Run the rogue node, a sender of forged messages outside the swarm, as a process in its own network namespace.

The harness starts it, orders injections, and stops it. The rogue node is part of the harness and not under test. If it
fails, the run fails with a MachineError.
"""

import asyncio
import os
import sys
from pathlib import Path
from typing import Any

from harness.archive.directory import ROGUE_CONTROL, RunDirectory
from harness.errors import MachineError
from harness.play.agent_control import AgentControl, AgentRefusedError, AgentSilentError
from harness.play.child_processes import passed_on
from harness.scenario import Scenario
from harness.scenario.changes import TimedInjection
from netem.lab import Lab, LabProcess

START_LIMIT_S = 30.0
ANSWER_LIMIT_S = 10.0
STOP_GRACE_S = 5.0
RETRY_S = 0.02


class RogueProcess:
    """The process of the rogue node. `vehicle` is its ID in the network, which no agent has."""

    def __init__(self, vehicle: int, scenario: Scenario, seed: int, rundir: RunDirectory) -> None:
        self.vehicle = vehicle
        self.sent: dict[int, int] = {}
        """Number of an injection -> number of datagrams that it made. Filled by `stop`."""
        self._scenario = scenario
        self._seed = seed
        self._rundir = rundir
        self._control = AgentControl(rundir.path / ROGUE_CONTROL)
        self._process: LabProcess | None = None

    async def start(self, lab: Lab) -> None:
        """Start the process and wait until it answers. Raises MachineError."""
        log = self._rundir.rogue_log
        self._process = await lab.spawn(
            self.vehicle,
            [sys.executable, "-P", "-m", "harness.play.rogue"],
            cwd=self._rundir.path,
            env=passed_on(os.environ),
            stdout=log,
            stderr=log,
        )
        deadline = asyncio.get_running_loop().time() + START_LIMIT_S
        while True:
            try:
                await self._control.ask("status", timeout_s=ANSWER_LIMIT_S)
                return
            except AgentSilentError:
                if self._process.returncode is not None:
                    raise self._end_error(self._process) from None
                if asyncio.get_running_loop().time() > deadline:
                    raise self._failure(f"did not answer within {START_LIMIT_S:g} s of its start") from None
                await asyncio.sleep(RETRY_S)

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
        assert self._process is not None, "`start` comes first"
        await self._process.wait()
        raise self._end_error(self._process)

    async def stop(self) -> None:
        """Store the numbers of sent datagrams in `sent`, and end the process. Raises MachineError if it has failed."""
        if self._process is None or self._process.returncode is not None:
            return
        answer = await self._ask("status")
        self.sent = {int(number): count for number, count in answer["sent"].items()}
        self._control.close()
        await self._process.terminate(STOP_GRACE_S)

    async def _ask(self, command: str, **arguments: Any) -> dict[str, Any]:
        try:
            return await self._control.ask(command, timeout_s=ANSWER_LIMIT_S, **arguments)
        except (AgentSilentError, AgentRefusedError) as error:
            raise self._failure(f"does not {command}: {error}") from None

    def _end_error(self, process: LabProcess) -> MachineError:
        return self._failure(f"ended by itself with {process.end}")

    def _failure(self, detail: str) -> MachineError:
        log = self._rundir.rogue_log
        return MachineError(f"the rogue node {detail}; its log is {log.relative_to(self._rundir.path)}")
