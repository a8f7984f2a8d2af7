"""The rogue node as a process in its own place on the air: started, told what to inject, stopped.

It is ours, not under test: if it fails, the machine or the harness has failed, and the run ends with that.
"""

import asyncio
import os
import sys
from pathlib import Path
from typing import Any

from harness.archive.directory import ROGUE_CONTROL, RunDirectory
from harness.errors import MachineError
from harness.play.agent_control import AgentControl, AgentRefusedError, AgentSilentError
from harness.scenario import Scenario
from harness.scenario.changes import Injected
from netem.lab import Lab, LabProcess

START_LIMIT_S = 30.0
ANSWER_LIMIT_S = 10.0
STOP_GRACE_S = 5.0
ASK_AGAIN_S = 0.02


class RogueProcess:
    """`vehicle` is its ID on the air, where it is no agent's."""

    def __init__(self, vehicle: int, scenario: Scenario, seed: int, rundir: RunDirectory) -> None:
        self.vehicle = vehicle
        self.sent: dict[int, int] = {}
        """How many datagrams each injection that had begun had made when it was last asked."""
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
            env=dict(os.environ),
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
                    raise self._ended(self._process) from None
                if asyncio.get_running_loop().time() > deadline:
                    raise self._failed(f"did not answer within {START_LIMIT_S:g} s of its start") from None
                await asyncio.sleep(ASK_AGAIN_S)

    async def begin(self, epoch_us: int, captured: Path | None) -> None:
        """The mission begins; in the file `captured` are a vehicle's keys."""
        scenario = self._scenario
        roster, keys = list(scenario.roster), None if captured is None else str(captured)
        await self._ask(
            "start", epoch_us=epoch_us, speedup=scenario.speedup, roster=roster, seed=self._seed, captured=keys
        )

    async def inject(self, injected: Injected) -> None:
        await self._ask(
            "inject", what=injected.what, number=injected.number, injection=injected.injection.model_dump(mode="json")
        )

    async def watch(self) -> None:
        """Raises MachineError when the process ends."""
        assert self._process is not None, "it is watched once it runs"
        await self._process.wait()
        raise self._ended(self._process)

    async def stop(self) -> None:
        """Take down what it has sent, and end it. Raises MachineError if it has failed."""
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
            raise self._failed(f"does not {command}: {error}") from None

    def _ended(self, process: LabProcess) -> MachineError:
        return self._failed(f"ended by itself with {process.end}")

    def _failed(self, detail: str) -> MachineError:
        log = self._rundir.rogue_log
        return MachineError(f"the rogue node {detail}; its log is {log.relative_to(self._rundir.path)}")
