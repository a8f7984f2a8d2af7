"""Run an agent under test as a program in the network namespace of its vehicle.

The harness starts the program, sends commands to its control socket, and collects its files. If an agent starts again
after a kill or a power failure, it is a new incarnation: a new process in a new directory. The new process cannot
overwrite files of an earlier incarnation. It gets the stored data of the earlier incarnation only if the fault left the
disk intact.
"""

import asyncio
import contextlib
import json
import os
import signal
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from harness.archive.directory import RunDirectory
from harness.archive.run_record import AgentRecord, HandlerRuns
from harness.archive.trace_files import SUFFIX, open_trace
from harness.archive.traces import HANDLER_RUN, read_trace
from harness.errors import AgentFailedError, HarnessError, MachineError, ScenarioError, UnsupportedError
from harness.play._vehicle_keys import KeyDirectories
from harness.play.agent_control import (
    AgentRefusedError,
    AgentSilentError,
    AgentStatus,
    AgentUnsupportedError,
    is_shell_error,
    last_line,
    resolve_command,
)
from harness.play.process._run_lab import MissionLab
from harness.play.process.agent_mission import mission_file
from harness.play.process.controlled_program import ControlledProgram, ProgramEndedError
from harness.play.process.lab_program import LabProgram
from harness.play.trace_space import trace_quota
from harness.play.variant import variant_in_use
from harness.scenario import Scenario
from netem.errors import SpawnError
from ucp.features import UNSUPPORTED
from ucp.trace import HandlerRun


def agent_command(scenario: Scenario, agent_id: int) -> list[str]:
    """Return the command of the agent with absolute paths. The caller appends the name of the mission file.

    Raises ScenarioError if the program does not exist.
    """
    command = scenario.command_of(agent_id)
    if command is None:
        variant = variant_in_use()
        program = ["ucp.node"] if variant is None else ["harness.play.variant_agent", str(variant.file)]
        return [sys.executable, "-P", "-m", *program]
    owner = f" of agent {agent_id}" if isinstance(scenario.agent_command, dict) else ""
    return resolve_command(command, f"`agent_command`{owner}")


@dataclass
class _ProcessIncarnation:
    """The files and the status of an agent between a start and the next end of its process."""

    directory: Path
    store: Path
    """The file in which the agent stores its state, if the agent has a disk."""
    status: AgentStatus | None = None
    """The last status that the agent reported."""
    status_between_s: tuple[float, float] = (0.0, 0.0)
    """Two mission seconds. The agent read the counters in `status` between them."""
    killed: bool = False
    """True if the incarnation ended by SIGKILL and its disk was not kept."""
    switched_off: bool = False
    """True if the incarnation ended by SIGTERM. Only the files of the incarnation then show its actions after its last
    status.
    """
    reboot: bool = False
    """True if the incarnation started with the data on the agent's disk."""
    completed_known: bool = False
    """True if the harness has read from the trace which blocks this killed incarnation completed."""
    trace_bytes_copied: int = 0
    """Number of bytes of this incarnation's trace that were already appended to the complete trace of the agent."""

    def handler_runs(self) -> HandlerRuns | None:
        """Return the number of handler runs in the last report of the agent, and the time of this report. Return None
        without a report.
        """
        if self.status is None:
            return None
        from_s, until_s = self.status_between_s
        return HandlerRuns(counted=self.status.handled, from_s=round(from_s, 3), until_s=round(until_s, 3))


class AgentProcess:
    """The process of one agent. The object also keeps the files and results of its earlier processes."""

    def __init__(
        self,
        agent_id: int,
        rundir: RunDirectory,
        command: Sequence[str],
        now: Callable[[], float],
        *,
        controlled: Callable[[LabProgram], LabProgram] | None = None,
        loss: Callable[[], str | None] = lambda: None,
    ) -> None:
        """Create the object without starting the process. `command` starts the agent. The harness appends the path of
        the mission file to this command. `now` returns mission seconds.

        A remote agent runs on another computer. For such an agent, `command` starts a stand-in on this machine.
        `controlled` then returns the program to control in place of the stand-in, and `loss` returns a phrase if the
        other computer is lost.
        """
        self.agent_id = agent_id
        self._command = command
        self._now = now
        self._controlled, self._loss = controlled, loss
        self.outcome = "not started"
        """The state of the agent as one or two words. After the run, `run.json` records this state, together with
        `detail`.
        """
        self.detail: str | None = None
        self._rundir = rundir
        self._incarnations: list[_ProcessIncarnation] = []
        self._program: ControlledProgram | None = None
        self._control_lock = asyncio.Lock()
        """A lock that is held while the agent answers a status request. Faults wait for this lock before they end or
        pause the agent.
        """
        self._completed_before: list[str] = []
        self._left_behind: list[str] = []

    @property
    def incarnations(self) -> int:
        """The number of times the agent was started so far."""
        return len(self._incarnations)

    @property
    def awake(self) -> bool:
        """True if the agent runs, is not paused, and has not failed."""
        return self.outcome == "running"

    @property
    def status(self) -> AgentStatus | None:
        """The newest status report since the last start, or None if the agent is neither running nor paused."""
        return self._incarnations[-1].status if self.outcome in ("running", "paused") else None

    # Start and end of an incarnation

    async def start(
        self,
        lab: MissionLab,
        scenario: Scenario,
        seed: int,
        initial_data: bytes,
        with_vehicle: bool,
        keeps_disk: bool,
        epoch_us: int | None,
        keys: KeyDirectories,
    ) -> None:
        """Start the program, and wait until it reports its status.

        - `keeps_disk`: the agent stores its state in a file, so that it can reboot with this state.
        - `epoch_us`: start time of the mission that the agent joins. None if the mission has not started.
        - `keys`: the key directories of a secured mission.

        Raises AgentFailedError, AgentRefusedError or UnsupportedError, and ScenarioError if the program cannot be run.
        """
        incarnation = self._begin_incarnation()
        bundle = keys.write_bundle(self.agent_id, kept=incarnation.reboot)
        mission = mission_file(
            self.agent_id,
            scenario,
            seed,
            initial_data,
            address=lab.addresses[self.agent_id],
            broadcast=lab.broadcast,
            with_vehicle=with_vehicle,
            incarnation=len(self._incarnations),
            epoch_us=epoch_us,
            store=os.path.relpath(incarnation.store, incarnation.directory) if keeps_disk else None,
            bundle=None if bundle is None else str(bundle),
        )
        path = self._rundir.write_mission(incarnation.directory, self.agent_id, mission)
        try:
            self._program = await ControlledProgram.start(
                partial(self._spawn, lab),
                [*self._command, path.name],
                directory=incarnation.directory,
                control=self._control_path,
                log=self._log,
                max_file_bytes=trace_quota(scenario, self._rundir.path),
                has_children=self._controlled is None,
            )
        except SpawnError as error:
            if scenario.command_of(self.agent_id) is None:
                raise
            raise ScenarioError(f"`agent_command` of agent {self.agent_id}: {error}") from None
        requested_s = self._now()
        try:
            self._accept_status(await self._program.ready(), requested_s)
        except ProgramEndedError:
            raise self._end_error() from None
        except AgentSilentError as error:
            raise self._failure("hung", str(error)) from None
        self.outcome = "running"

    async def _spawn(self, lab: MissionLab, argv: Sequence[str], /, **options: Any) -> LabProgram:
        if self._controlled is None:
            return await lab.spawn(self.agent_id, argv, role="agent", **options)
        return self._controlled(await lab.network.spawn(self.agent_id, argv, role="agent", fork=True, **options))

    def _begin_incarnation(self) -> _ProcessIncarnation:
        directory = self._rundir.agent(self.agent_id, len(self._incarnations) + 1)
        kept = self.outcome == "rebooting"
        store = self._incarnations[-1].store if kept else directory / f"{self.agent_id}.store"
        self._incarnations.append(_ProcessIncarnation(directory, store, reboot=kept))
        return self._incarnations[-1]

    @property
    def _started(self) -> ControlledProgram:
        assert self._program is not None, "`start` comes first"
        return self._program

    async def watch(self) -> None:
        """Wait until the process ends without a request of the harness. Then raise AgentFailedError or
        UnsupportedError.
        """
        await self._started.process.wait()
        raise self._end_error()

    async def kill(self, *, disk_kept: bool = False) -> None:
        """Kill the process with SIGKILL. If `disk_kept` is true, the next start uses the data on the agent's disk.

        Cancel the task that runs `watch` first. Raises AgentFailedError if the agent has already failed.
        """
        async with self._control_lock:
            if self.awake:
                await self._ask_status()  # the counters are lost with the process
            self.outcome = "rebooting" if disk_kept else "killed"
            self._incarnations[-1].killed = not disk_kept
            await self._started.kill()
            await self._started.end_children()
            self._control_path.unlink(missing_ok=True)

    async def switch_off(self) -> None:
        """End the process with SIGTERM. An agent exports its chain when it receives this signal. Cancel the task that
        runs `watch` first.

        Raises AgentFailedError if the agent ends with an error or does not end.
        """
        async with self._control_lock:
            if self.awake:
                await self._ask_status()
            at_s, program = self._now(), self._started
            status = await program.stop()
            self._incarnations[-1].switched_off = True
            self._left_behind += await program.end_children()
            if status != 0:
                raise self._failure("not exported", f"was switched off (SIGTERM) and ended with {program.process.end}")
            self.outcome, self.detail = "exported", f"switched off at {at_s:.1f} s"
            self._rundir.copy_export(self.agent_id, self._incarnations[-1].directory)

    async def pause(self) -> None:
        """Suspend the process. During the pause, messages wait in the socket buffer of the process. When the buffer is
        full, further messages are lost.
        """
        async with self._control_lock:
            await self._started.process.pause()
            self.outcome = "paused"

    async def resume(self) -> None:
        await self._started.process.resume()
        self.outcome = "running"

    # Commands

    async def ask(self, command: str, **arguments: Any) -> dict[str, Any]:
        """Send a command to the agent, and return its answer.

        Raises AgentFailedError if the agent does not answer, AgentRefusedError if it refuses the command, and
        UnsupportedError if it does not support the command.
        """
        try:
            return await self._started.ask(command, **arguments)
        except AgentUnsupportedError as error:
            raise self._unsupported_error(f"refused the command {command}: {last_line(str(error))}") from None
        except AgentRefusedError as error:
            raise AgentRefusedError(f"agent {self.agent_id} refused to {command}: {error}") from None
        except ProgramEndedError:
            raise self._end_error() from None
        except AgentSilentError as error:
            raise self._failure("hung", f"stopped answering: {error}") from None

    async def poll(self) -> AgentStatus | None:
        """Request the status of the agent. Return None if the agent is dead or paused. Raises the errors of `ask`."""
        async with self._control_lock:
            return await self._ask_status() if self.awake else None

    async def _ask_status(self) -> AgentStatus:
        requested_s = self._now()
        return self._accept_status(await self.ask("status"), requested_s)

    def _accept_status(self, answer: dict[str, Any], requested_s: float) -> AgentStatus:
        try:
            status = AgentStatus.model_validate(answer)
        except ValidationError as error:
            wrong = ", ".join(dict.fromkeys(str(problem["loc"][0]) for problem in error.errors()))
            detail = f"does not follow the agent contract: in its status {wrong} is missing or wrong"
            raise self._failure("broken", detail) from None
        incarnation = self._incarnations[-1]
        incarnation.status = status
        own_s = status.mission_s
        incarnation.status_between_s = (requested_s, self._now()) if own_s is None else (own_s, own_s)
        return status

    async def export(self) -> None:
        """Request a chain export from the agent, and copy it to the file that the checker reads.

        Raises AgentFailedError, or MachineError if the agent could not write the export.
        """
        await self.poll()
        try:
            await self.ask("export")
        except AgentRefusedError as error:
            self.outcome, self.detail = "not exported", str(error)
            raise MachineError(f"{error}; the part written before is kept") from None
        self._rundir.copy_export(self.agent_id, self._incarnations[-1].directory)

    async def export_at_end(self) -> None:
        """Export the chain for the last time if the agent is alive. Raises the errors of `export`."""
        if self.outcome == "paused":
            await self.resume()
        if self.awake:
            await self.export()
            self.outcome = "exported"

    def handler_runs_since(self, mission_s: float, handler: str) -> list[HandlerRun]:
        """Return the runs of this handler that the trace shows after `mission_s` and since the agent's last start. The
        oldest run is first. Lines that cannot be parsed are skipped, because the checker reports them.
        """
        runs: list[HandlerRun] = []
        trace = self._incarnations[-1].directory / f"{self.agent_id}{SUFFIX}"
        name = json.dumps(handler).encode()
        content = b""
        with contextlib.suppress(FileNotFoundError), open_trace(trace) as file:
            content = file.read()
        for line in reversed(content.split(b"\n")[1:-1]):
            if name in line:
                with contextlib.suppress(ValidationError):
                    run = HANDLER_RUN.validate_json(line)
                    if run.t <= mission_s:
                        break
                    runs.append(run)
        return runs[::-1]

    # End of the run

    async def stop(self) -> None:
        if self._program is None:
            return
        await (self._program.kill() if self.outcome == "hung" else self._program.stop())
        left = await self._program.end_children()
        if self._program.process.returncode != -signal.SIGKILL:  # no agent ends its children after SIGKILL
            self._left_behind += left

    def collect_files(self) -> None:
        """Write the files that the checker reads: one trace, joined from all starts of the agent, and a copy of its
        last export.

        A repeated call appends only new lines. Raises OSError.
        """
        for number, incarnation in enumerate(self._incarnations, 1):
            if incarnation.killed and not incarnation.completed_known:
                trace = read_trace(incarnation.directory / f"{self.agent_id}{SUFFIX}")
                self._completed_before += trace.completed() if trace else []
                incarnation.completed_known = True
            if number > 1:
                incarnation.trace_bytes_copied += self._rundir.append_trace(
                    self.agent_id, incarnation.directory, incarnation.trace_bytes_copied
                )
                self._rundir.copy_export(self.agent_id, incarnation.directory)

    def record(self) -> AgentRecord:
        """Return the outcome of the agent for `run.json`."""
        incarnations = self._incarnations
        statuses = [incarnation.status for incarnation in incarnations if incarnation.status is not None]
        record = AgentRecord(
            outcome=self.outcome,
            detail=self.detail,
            command=list(self._command),
            version=statuses[-1].version if statuses else None,
            restarts=sum(not incarnation.reboot for incarnation in incarnations[1:]),
            reboots=sum(incarnation.reboot for incarnation in incarnations),
            completed_before=list(dict.fromkeys(self._completed_before)),
            left_behind=self._left_behind,
        )
        if not statuses:
            return record
        ended_at_once = self.outcome in ("killed", "rebooting") or incarnations[-1].switched_off
        last_status = None if ended_at_once else incarnations[-1].status
        failures = [status.send_failures for status in statuses if status.send_failures is not None]
        record.idle = last_status.idle if last_status else None
        record.bytes_sent = sum(status.bytes_sent for status in statuses)
        record.dropped = dict(sum((Counter(status.dropped) for status in statuses), Counter()))
        record.send_failures = sum(failures) if failures else None
        record.trace_problem = next((status.trace_problem for status in statuses if status.trace_problem), None)
        record.handler_runs = [incarnation.handler_runs() for incarnation in incarnations]
        return record

    @property
    def _control_path(self) -> Path:
        return self._incarnations[-1].directory / f"{self.agent_id}.control"

    @property
    def _log(self) -> Path:
        return self._incarnations[-1].directory / f"{self.agent_id}.log"

    def _end_error(self) -> HarnessError:
        """Return the error for an agent whose process ended without a request.

        If the process ended with exit status 127 before the start of the mission, the agent lacks a feature of the
        mission. The exception is a shell that did not find the agent's program, because a shell then also ends with
        127. The method recognizes this case by the message of the shell.
        """
        status, program = self._incarnations[-1].status, self._started
        words, end = program.last_line, str(program.ended())
        if program.process.returncode != UNSUPPORTED or (status is not None and status.started):
            return self._failure("crashed", end)
        if is_shell_error(words):
            return self._failure("crashed", f"{end} ({words})")
        return self._unsupported_error(words)

    def _unsupported_error(self, words: str) -> UnsupportedError:
        error = UnsupportedError.of(self.agent_id, self._command, words)
        self.outcome, self.detail = "not supported", str(error)
        return error

    def _failure(self, outcome: str, detail: str) -> HarnessError:
        """Return the error for an agent that failed. If the connection to a remote agent's computer is lost, the agent
        is not at fault, and the error is a MachineError.
        """
        if (loss := self._loss()) is not None:
            self.outcome, self.detail = "not exported", loss
            return MachineError(f"agent {self.agent_id} {loss}")
        self.outcome, self.detail = outcome, detail
        log = self._log.relative_to(self._rundir.path)
        return AgentFailedError(self.agent_id, outcome, f"{detail}; its log is {log}")
