"""One agent under test as a process in its vehicle's namespace: started, asked, exported, stopped."""

import asyncio
import base64
import dataclasses
import os
import shutil
import signal
import sys
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from harness.agents import AgentControl, AgentRefusedError, AgentSilentError, Status
from harness.errors import VIOLATED, HarnessError, MachineError, ScenarioError
from harness.rundir import RunDirectory
from harness.scenario import Scenario
from harness.seeds import agent_seed
from netem.lab import Lab, LabProcess
from sitl.vehicle import AGENT_PORT
from ucp.mission import SCHEMA as MISSION_SCHEMA

PORT = 14600
START_LIMIT_S = 30.0
ANSWER_LIMIT_S = 10.0
"""Wall time after which an agent that does not answer counts as hung."""
STOP_GRACE_S = 5.0
ASK_AGAIN_S = 0.02


def agent_command(scenario: Scenario) -> list[str]:
    """What starts an agent, but for the mission file. Raises ScenarioError if there is no such program."""
    if scenario.agent_command is None:
        return [sys.executable, "-P", "-m", "ucp.node"]
    program, *arguments = scenario.agent_command
    found = shutil.which(program)
    if found is None:
        raise ScenarioError(f"`agent_command`: {program} is no program: give a path, or a name on PATH")
    return [str(Path(found).absolute()), *arguments]  # agents work in a directory of their own


class AgentFailedError(HarnessError):
    """An agent crashed, hung, or did not start: the thing under test failed."""

    exit_status = VIOLATED

    def __init__(self, agent_id: int, outcome: str, detail: str) -> None:
        super().__init__(f"agent {agent_id} {detail}; its log is agents/{agent_id}.log")
        self.agent_id = agent_id
        self.outcome = outcome


class AgentProcess:
    """`status` is the agent's last, None before the first; `outcome` is what became of it, for run.json."""

    def __init__(self, agent_id: int, rundir: RunDirectory) -> None:
        self.agent_id = agent_id
        self.status: Status | None = None
        self.outcome = "not started"
        self.detail: str | None = None
        self._rundir = rundir
        self._control = AgentControl(rundir.agents / f"{agent_id}.control")
        self._process: LabProcess | None = None

    async def start(self, lab: Lab, scenario: Scenario, seed: int, initial_data: bytes, with_vehicle: bool) -> None:
        """Start the process and wait until it answers. Raises AgentFailedError, AgentRefusedError."""
        mission = _mission(self.agent_id, lab, scenario, seed, initial_data, with_vehicle)
        path = self._rundir.write_mission(self.agent_id, mission)
        output = self._rundir.agents / f"{self.agent_id}.log"
        self._process = await lab.spawn(
            self.agent_id,
            [*agent_command(scenario), path.name],
            cwd=self._rundir.agents,
            env=dict(os.environ),
            stdout=output,
            stderr=output,
        )
        self.outcome = "running"
        deadline = asyncio.get_running_loop().time() + START_LIMIT_S
        while True:
            try:
                self._take(await self._control.ask("status", timeout_s=ANSWER_LIMIT_S))
                return
            except AgentSilentError:
                if self._process.returncode is not None:
                    raise self._crashed(self._process.returncode) from None
                if asyncio.get_running_loop().time() > deadline:
                    raise self._failed("hung", f"did not answer within {START_LIMIT_S:g} s of its start") from None
                await asyncio.sleep(ASK_AGAIN_S)

    async def watch(self) -> None:
        """Raises AgentFailedError when the process ends."""
        assert self._process is not None
        raise self._crashed(await self._process.wait())

    async def ask(self, command: str, **arguments: Any) -> dict[str, Any]:
        """Raises AgentFailedError if the agent does not answer, AgentRefusedError if it cannot."""
        try:
            return await self._control.ask(command, timeout_s=ANSWER_LIMIT_S, **arguments)
        except AgentRefusedError as error:
            raise AgentRefusedError(f"agent {self.agent_id} refused to {command}: {error}") from None
        except AgentSilentError as error:
            if self._process is not None and self._process.returncode is not None:
                raise self._crashed(self._process.returncode) from None
            raise self._failed("hung", f"stopped answering: {error}") from None

    async def poll(self) -> Status:
        """Ask for the status. Raises AgentFailedError."""
        return self._take(await self.ask("status"))

    def _take(self, status: dict[str, Any]) -> Status:
        try:
            self.status = Status.model_validate(status)
        except ValidationError as error:
            wrong = ", ".join(dict.fromkeys(str(problem["loc"][0]) for problem in error.errors()))
            detail = f"does not follow the agent contract: in its status {wrong} is missing or wrong"
            raise self._failed("broken", detail) from None
        return self.status

    async def export(self) -> None:
        """Have the chain exported. Raises AgentFailedError, or MachineError if the agent could not write it."""
        await self.poll()
        try:
            await self.ask("export")
        except AgentRefusedError as error:
            self.outcome, self.detail = "not exported", str(error)
            raise MachineError(f"{error}; what was written before is there") from None

    async def export_finally(self) -> None:
        """The last export, of an agent that still runs. Raises as `export`."""
        if self.outcome == "running":
            await self.export()
            self.outcome = "exported"

    async def stop(self) -> None:
        self._control.close()
        if self._process is not None and self._process.returncode is None:
            if self.outcome == "hung":
                await self._process.send_signal(signal.SIGKILL)
                await self._process.wait()
            else:
                await self._process.terminate(STOP_GRACE_S)

    def to_json(self) -> dict[str, Any]:
        told = {"idle", "bytes_sent", "dropped", "send_failures", "trace_problem"}
        status = self.status.model_dump(include=told) if self.status else {}
        return {"outcome": self.outcome, "detail": self.detail, **status}

    def _crashed(self, returncode: int) -> AgentFailedError:
        how = signal.Signals(-returncode).name if returncode < 0 else f"status {returncode}"
        return self._failed("crashed", f"ended by itself with {how}")

    def _failed(self, outcome: str, detail: str) -> AgentFailedError:
        self.outcome, self.detail = outcome, detail
        return AgentFailedError(self.agent_id, outcome, detail)


def _mission(
    agent_id: int, lab: Lab, scenario: Scenario, seed: int, initial_data: bytes, with_vehicle: bool
) -> dict[str, Any]:
    events = scenario.events
    return {
        "schema": MISSION_SCHEMA,
        "agent_id": agent_id,
        "roster": list(scenario.roster),
        "initial_data": base64.b64encode(initial_data).decode("ascii"),
        "network": {"address": lab.addresses[agent_id], "broadcast": lab.broadcast, "port": PORT},
        "events": {
            "source": events.source if with_vehicle else "random",
            "mean_s": events.mean_s,
            "position_interval_s": events.position_interval_s,
            "vehicle_host": "127.0.0.1",
            "vehicle_port": AGENT_PORT,
        },
        "settings": dataclasses.asdict(scenario.settings),
        "quirks": dataclasses.asdict(scenario.quirks),
        "seed": agent_seed(seed, agent_id),
        "speedup": scenario.speedup,
        "epoch_us": None,
    }
