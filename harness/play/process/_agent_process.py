"""One agent under test as a program in its vehicle's namespace: started, asked, exported, stopped.

An agent that is killed and begins again, or comes back from a brown-out, has another life: another process, with a
directory of its own, so that nothing of an earlier life is overwritten, or found by an agent that should have nothing.
"""

import asyncio
import contextlib
import json
import os
import signal
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from harness.archive.directory import RunDirectory
from harness.archive.traces import HANDLER_RUN, SUFFIX, read_trace
from harness.errors import AgentFailedError, HarnessError, MachineError, ScenarioError, UnsupportedError
from harness.play._vehicle_keys import Handed
from harness.play.agent_control import (
    AgentControl,
    AgentRefusedError,
    AgentSilentError,
    AgentUnsupportedError,
    Status,
    last_words,
    last_words_in,
    located,
    of_a_shell,
)
from harness.play.child_processes import ChildProcesses
from harness.play.process._run_lab import MissionLab, Program
from harness.play.process.agent_mission import mission_file
from harness.play.variant import variant_in_use
from harness.scenario import Scenario
from netem.errors import SpawnError
from ucp.features import UNSUPPORTED
from ucp.trace import HandlerRun

START_LIMIT_S = 30.0
ANSWER_LIMIT_S = 10.0
"""Wall time after which an agent that does not answer counts as hung."""
STOP_GRACE_S = 5.0
ASK_AGAIN_S = 0.02
MOMENT_S = 0.5


def agent_command(scenario: Scenario, agent_id: int) -> list[str]:
    """What starts the agent here, but for the mission file: its files as absolute paths.

    Raises ScenarioError if there is no such program.
    """
    command = scenario.command_of(agent_id)
    if command is None:
        variant = variant_in_use()
        program = ["ucp.node"] if variant is None else ["harness.play.variant_agent", str(variant.file)]
        return [sys.executable, "-P", "-m", *program]
    of_whom = f" of agent {agent_id}" if isinstance(scenario.agent_command, dict) else ""
    return located(command, f"`agent_command`{of_whom}")


@dataclass
class _Incarnation:
    """`store` is where it keeps what it holds, if the scenario asks for that; `status` is its last."""

    directory: Path
    store: Path
    processes: ChildProcesses = field(default_factory=ChildProcesses)
    status: Status | None = None
    between_s: tuple[float, float] = (0.0, 0.0)
    """When it told its status, in mission seconds."""
    killed: bool = False
    """The data that it held is gone."""
    switched_off: bool = False
    """What it did between its last status and its end only its files tell."""
    reboot: bool = False
    """It began with what was on disk."""
    counted: bool = False
    """What it completed is known, though it was killed."""
    trace_brought: int = 0
    """Bytes of its trace that are where the checker looks for them."""

    def handler_runs(self) -> dict[str, int | float] | None:
        """How many it had counted when it was asked last."""
        if self.status is None:
            return None
        from_s, until_s = self.between_s
        return {"counted": self.status.handled, "from_s": round(from_s, 3), "until_s": round(until_s, 3)}


class AgentProcess:
    """`status` is the agent's last, None while it has none; `outcome` is what became of it, for run.json.

    `now` tells mission seconds.
    """

    def __init__(self, agent_id: int, rundir: RunDirectory, command: Sequence[str], now: Callable[[], float]) -> None:
        self.agent_id = agent_id
        self._command = command
        self._now = now
        self.outcome = "not started"
        self.detail: str | None = None
        self._rundir = rundir
        self._lives: list[_Incarnation] = []
        self._process: Program | None = None
        self._being_asked = asyncio.Lock()
        """Nobody stops or kills it while it is asked for its status."""
        self._completed_before: list[str] = []
        self._left_behind: list[str] = []

    @property
    def lives(self) -> int:
        """How many it has had, this one included."""
        return len(self._lives)

    @property
    def awake(self) -> bool:
        """Whether it runs and answers."""
        return self.outcome == "running"

    @property
    def status(self) -> Status | None:
        return self._lives[-1].status if self.outcome in ("running", "paused") else None

    # A life

    async def start(
        self,
        lab: MissionLab,
        scenario: Scenario,
        seed: int,
        initial_data: bytes,
        with_vehicle: bool,
        keeps_disk: bool,
        epoch_us: int | None,
        keys: Handed,
    ) -> None:
        """Start the program and wait until it answers; with `epoch_us` it joins the mission that began then.

        With `keeps_disk` it stores what it holds, to be rebooted with it. `keys` are the mission's, if it is secured.
        Raises AgentFailedError, AgentRefusedError, UnsupportedError; ScenarioError for a program that is none.
        """
        life = self._begin_life()
        bundle = keys.hand(self.agent_id, kept=life.reboot)
        mission = mission_file(
            self.agent_id,
            scenario,
            seed,
            initial_data,
            address=lab.addresses[self.agent_id],
            broadcast=lab.broadcast,
            with_vehicle=with_vehicle,
            life=len(self._lives),
            epoch_us=epoch_us,
            store=os.path.relpath(life.store, life.directory) if keeps_disk else None,
            bundle=None if bundle is None else str(bundle),
        )
        path = self._rundir.write_mission(life.directory, self.agent_id, mission)
        output = self._log
        self._control = AgentControl(self._control_path)
        try:
            self._process = await lab.spawn(
                self.agent_id,
                [*self._command, path.name],
                cwd=life.directory,
                env=life.processes.environment(os.environ),
                stdout=output,
                stderr=output,
                role="agent",
            )
        except SpawnError as error:
            if scenario.command_of(self.agent_id) is None:
                raise
            raise ScenarioError(f"`agent_command` of agent {self.agent_id}: {error}") from None
        await self._wait_until_it_answers(self._process)
        self.outcome = "running"

    def _begin_life(self) -> _Incarnation:
        directory = self._rundir.agent(self.agent_id, len(self._lives) + 1)
        kept = self.outcome == "rebooting"
        store = self._lives[-1].store if kept else directory / f"{self.agent_id}.store"
        self._lives.append(_Incarnation(directory, store, reboot=kept))
        return self._lives[-1]

    async def _wait_until_it_answers(self, process: Program) -> None:
        deadline = asyncio.get_running_loop().time() + START_LIMIT_S
        while True:
            try:
                asked_s = self._now()
                self._take(await self._control.ask("status", timeout_s=ANSWER_LIMIT_S), asked_s)
                return
            except AgentSilentError:
                if process.returncode is not None:
                    raise self._crashed(process) from None
                if asyncio.get_running_loop().time() > deadline:
                    raise self._failed("hung", f"did not answer within {START_LIMIT_S:g} s of its start") from None
                await asyncio.sleep(ASK_AGAIN_S)

    async def watch(self) -> None:
        """Raises AgentFailedError when the process ends, or UnsupportedError."""
        assert self._process is not None
        await self._process.wait()
        raise self._crashed(self._process)

    async def kill(self, *, disk_kept: bool = False) -> None:
        """SIGKILL, which no agent survives; what it held is gone but for its disk, if that is kept.

        Stop watching it before. Raises AgentFailedError if it had failed by itself.
        """
        assert self._process is not None
        async with self._being_asked:
            if self.awake:
                await self._ask_status()  # its counters die with it
            self._control.close()
            self.outcome = "rebooting" if disk_kept else "killed"
            self._lives[-1].killed = not disk_kept
            await self._process.send_signal(signal.SIGKILL)
            await self._process.wait()
            await self._end_children()
            self._control_path.unlink(missing_ok=True)

    async def switch_off(self) -> None:
        """SIGTERM: it exports its chain and ends. Stop watching it before. Raises AgentFailedError if it does not."""
        assert self._process is not None
        async with self._being_asked:
            if self.awake:
                await self._ask_status()
            at_s = self._now()
            self._control.close()
            status = await self._process.terminate(STOP_GRACE_S)
            self._lives[-1].switched_off = True
            self._left_behind += await self._end_children()
            if status != 0:
                raise self._failed("not exported", f"was switched off (SIGTERM) and ended with {self._process.end}")
            self.outcome, self.detail = "exported", f"switched off at {at_s:.1f} s"
            self._rundir.copy_export(self.agent_id, self._lives[-1].directory)

    async def pause(self) -> None:
        """It stands still, and what reaches it waits in its socket, as much as fits there."""
        assert self._process is not None
        async with self._being_asked:
            await self._process.pause()
            self.outcome = "paused"

    async def resume(self) -> None:
        assert self._process is not None
        await self._process.resume()
        self.outcome = "running"

    # What it is asked

    async def ask(self, command: str, **arguments: Any) -> dict[str, Any]:
        """Raises AgentFailedError if the agent does not answer, AgentRefusedError if it cannot, UnsupportedError."""
        try:
            return await self._control.ask(command, timeout_s=ANSWER_LIMIT_S, **arguments)
        except AgentUnsupportedError as error:
            raise self._unsupported(f"refused the command {command}: {last_words(str(error))}") from None
        except AgentRefusedError as error:
            raise AgentRefusedError(f"agent {self.agent_id} refused to {command}: {error}") from None
        except AgentSilentError as error:
            if self._process is not None and await self._has_ended(self._process):
                raise self._crashed(self._process) from None
            raise self._failed("hung", f"stopped answering: {error}") from None

    async def _has_ended(self, process: Program) -> bool:
        """Of which one hears a moment after its connection is lost."""
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(process.wait(), MOMENT_S)
        return process.returncode is not None

    async def poll(self) -> Status | None:
        """Ask for the status; None of an agent that is dead or paused. Raises AgentFailedError."""
        async with self._being_asked:
            return await self._ask_status() if self.awake else None

    async def _ask_status(self) -> Status:
        asked_s = self._now()
        return self._take(await self.ask("status"), asked_s)

    def _take(self, answer: dict[str, Any], asked_s: float) -> Status:
        try:
            status = Status.model_validate(answer)
        except ValidationError as error:
            wrong = ", ".join(dict.fromkeys(str(problem["loc"][0]) for problem in error.errors()))
            detail = f"does not follow the agent contract: in its status {wrong} is missing or wrong"
            raise self._failed("broken", detail) from None
        life = self._lives[-1]
        life.status = status
        own_s = status.mission_s
        life.between_s = (asked_s, self._now()) if own_s is None else (own_s, own_s)
        return status

    async def export(self) -> None:
        """Have the chain exported. Raises AgentFailedError, or MachineError if the agent could not write it."""
        await self.poll()
        try:
            await self.ask("export")
        except AgentRefusedError as error:
            self.outcome, self.detail = "not exported", str(error)
            raise MachineError(f"{error}; the part written before is kept") from None
        self._rundir.copy_export(self.agent_id, self._lives[-1].directory)

    async def export_finally(self) -> None:
        """The last export, of an agent that is still alive. Raises as `export`."""
        if self.outcome == "paused":
            await self.resume()
        if self.awake:
            await self.export()
            self.outcome = "exported"

    def runs_since(self, mission_s: float, handler: str) -> list[HandlerRun]:
        """What its trace has of this handler after then, of this life; damage is the checker's affair."""
        runs: list[HandlerRun] = []
        trace = self._lives[-1].directory / f"{self.agent_id}{SUFFIX}"
        name = json.dumps(handler).encode()
        for line in reversed(trace.read_bytes().split(b"\n")[1:-1] if trace.exists() else ()):
            if name in line:
                with contextlib.suppress(ValidationError):
                    run = HANDLER_RUN.validate_json(line)
                    if run.t <= mission_s:
                        break
                    runs.append(run)
        return runs[::-1]

    # The end

    async def stop(self) -> None:
        if self._process is None:
            return
        self._control.close()
        if self._process.returncode is None:
            if self.outcome == "hung":
                await self._process.send_signal(signal.SIGKILL)
                await self._process.wait()
            else:
                await self._process.terminate(STOP_GRACE_S)
        left = await self._end_children()
        if self._process.returncode != -signal.SIGKILL:  # no agent ends its children after SIGKILL
            self._left_behind += left

    async def _end_children(self) -> list[str]:
        return await asyncio.to_thread(self._lives[-1].processes.end_left_behind)

    def put_together(self) -> None:
        """Put what all lives have left where that of one life would be: for the checker. Raises OSError.

        May be done again and again: what is there is not put there twice.
        """
        for number, life in enumerate(self._lives, 1):
            if life.killed and not life.counted:
                trace = read_trace(life.directory / f"{self.agent_id}{SUFFIX}")
                self._completed_before += trace.completed() if trace else []
                life.counted = True
            if number > 1:
                life.trace_brought += self._rundir.append_trace(self.agent_id, life.directory, life.trace_brought)
                self._rundir.copy_export(self.agent_id, life.directory)

    def to_json(self) -> dict[str, Any]:
        lives = self._lives
        record = {
            "outcome": self.outcome,
            "detail": self.detail,
            "command": list(self._command),
            "version": next((life.status.version for life in reversed(lives) if life.status is not None), None),
            "restarts": sum(not life.reboot for life in lives[1:]),
            "reboots": sum(life.reboot for life in lives),
            "completed_before": list(dict.fromkeys(self._completed_before)),
            "left_behind": self._left_behind,
        }
        statuses = [life.status for life in lives if life.status is not None]
        if not statuses:
            return record
        ended_at_once = self.outcome in ("killed", "rebooting") or lives[-1].switched_off
        last_words_of = None if ended_at_once else lives[-1].status
        failures = [status.send_failures for status in statuses if status.send_failures is not None]
        return record | {
            "idle": last_words_of.idle if last_words_of else None,
            "bytes_sent": sum(status.bytes_sent for status in statuses),
            "dropped": dict(sum((Counter(status.dropped) for status in statuses), Counter())),
            "send_failures": sum(failures) if failures else None,
            "trace_problem": next((status.trace_problem for status in statuses if status.trace_problem), None),
            "handler_runs": [life.handler_runs() for life in lives],
        }

    @property
    def _control_path(self) -> Path:
        return self._lives[-1].directory / f"{self.agent_id}.control"

    @property
    def _log(self) -> Path:
        return self._lives[-1].directory / f"{self.agent_id}.log"

    def _crashed(self, process: Program) -> HarnessError:
        """What it means that it has ended: at its start it may say that it lacks what the mission needs."""
        status = self._lives[-1].status
        words = last_words_in(self._log)
        if process.returncode != UNSUPPORTED or (status is not None and status.started):
            return self._failed("crashed", f"ended by itself with {process.end}")
        if of_a_shell(words):
            return self._failed("crashed", f"ended by itself with {process.end} ({words})")
        return self._unsupported(words)

    def _unsupported(self, words: str) -> UnsupportedError:
        error = UnsupportedError.of(self.agent_id, self._command, words)
        self.outcome, self.detail = "not supported", str(error)
        return error

    def _failed(self, outcome: str, detail: str) -> AgentFailedError:
        self.outcome, self.detail = outcome, detail
        log = self._log.relative_to(self._rundir.path)
        return AgentFailedError(self.agent_id, outcome, f"{detail}; its log is {log}")


def reboots_with_disk(agent_id: int, scenario: Scenario) -> bool:
    """Whether the scenario ever asks for what is on the agent's disk."""
    return any(fault.disk_left == "kept" and agent_id in fault.agents for fault in scenario.faults_in_order())
