"""Start, stop and query a program that runs in a virtual network. The program is an agent or a node of the harness, and
answers commands on a control socket.

The consequence of a failure depends on the caller: a mission ends, a conformance case fails, and a bisection skips the
program. This module therefore only reports failures, in errors of its own. Each caller converts these errors to its own
errors.
"""

import asyncio
import os
import signal
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol, Self

from harness.play._child_processes import ChildProcesses
from harness.play.agent_control import AgentControl, AgentSilentError, last_line_in
from harness.play.process.lab_program import LabProgram

START_LIMIT_S = 30.0
ANSWER_LIMIT_S = 10.0
"""A program counts as hung if it sends no answer for this number of seconds of wall time."""
STOP_GRACE_S = 5.0
RETRY_S = 0.02
END_LIMIT_S = 0.5
"""Maximum time between the end of a process and the report of this end, in seconds of wall time."""
MAX_OUTPUT_BYTES = 16 * 1024 * 1024
"""Maximum number of bytes that a program may print before it is ready."""


class ProgramEndedError(AgentSilentError):
    """An error: the program ended by itself. The message says how it ended."""


class Spawn(Protocol):
    """The type of the method `spawn` of a virtual network, for a certain vehicle."""

    async def __call__(
        self,
        argv: Sequence[str],
        /,
        *,
        cwd: Path,
        env: dict[str, str],
        stdout: Path,
        stderr: Path,
        max_file_bytes: int | None = None,
    ) -> LabProgram: ...


class ControlledProgram:
    """A running program, its control socket, its log, and the processes that it started."""

    def __init__(
        self,
        process: LabProgram,
        control: Path,
        log: Path,
        children: ChildProcesses,
        answer_limit_s: float,
        has_children: bool,
    ) -> None:
        self.process = process
        self.log = log
        self.children = children
        self._control = AgentControl(control)
        self._answer_limit_s = answer_limit_s
        self._has_children = has_children
        self._left_behind: Sequence[str] = ()

    @classmethod
    async def start(
        cls,
        spawn: Spawn,
        argv: Sequence[str],
        *,
        directory: Path,
        control: Path,
        log: Path,
        max_file_bytes: int | None = None,
        answer_limit_s: float | None = None,
        has_children: bool = True,
    ) -> Self:
        """Start the program in `directory` without waiting until it is ready. Its output goes to `log`.

        The time limit of an answer is ANSWER_LIMIT_S by default. If `has_children` is false, the program starts no
        other processes, and the harness does not search for such processes after the end of the program. Raises
        SpawnError, NetemError.
        """
        children = ChildProcesses()
        env = children.environment(os.environ)
        process = await spawn(argv, cwd=directory, env=env, stdout=log, stderr=log, max_file_bytes=max_file_bytes)
        return cls(process, control, log, children, answer_limit_s or ANSWER_LIMIT_S, has_children)

    @property
    def last_line(self) -> str:
        """The last line of the program's output that contains text, or an empty string."""
        return last_line_in(self.log)

    async def ready(self) -> dict[str, Any]:
        """Wait until the program answers, and return its status.

        Raises ProgramEndedError, AgentSilentError after START_LIMIT_S, and AgentRefusedError.
        """
        loop = asyncio.get_running_loop()
        deadline = loop.time() + START_LIMIT_S
        while True:
            try:
                if not self._control.exists:
                    raise AgentSilentError("it has no control socket")
                return await self._control.ask("status", timeout_s=self._answer_limit_s)
            except AgentSilentError:
                if self.process.returncode is not None:
                    raise self.ended() from None
                if loop.time() > deadline:
                    raise AgentSilentError(f"did not answer within {START_LIMIT_S:g} s of its start") from None
                if self.log.stat().st_size > MAX_OUTPUT_BYTES:
                    raise AgentSilentError("prints without end and does not answer its control socket") from None
                await asyncio.sleep(RETRY_S)

    async def ask(self, command: str, *, limit_s: float | None = None, **arguments: Any) -> dict[str, Any]:
        """Send a command to the program, and return its answer.

        Raises ProgramEndedError, AgentSilentError, AgentRefusedError or AgentUnsupportedError.
        """
        try:
            return await self._control.ask(command, timeout_s=limit_s or self._answer_limit_s, **arguments)
        except AgentSilentError:
            with suppress(TimeoutError):  # its connection can end before the process
                await asyncio.wait_for(self.process.wait(), END_LIMIT_S)
            if self.process.returncode is not None:
                raise self.ended() from None
            raise

    async def watch(self) -> None:
        """Wait until the program ends. Then raise ProgramEndedError. If the harness ends the program, it first cancels
        this call.
        """
        await self.process.wait()
        raise self.ended()

    def ended(self) -> ProgramEndedError:
        """Return the error for a program that has ended without a request."""
        return ProgramEndedError(f"ended by itself with {self.process.end}")

    async def kill(self) -> None:
        """Kill the program with SIGKILL. Its children may still run."""
        self._control.close()
        await self.process.send_signal(signal.SIGKILL)
        await self.process.wait()

    async def stop(self) -> int:
        """End the program with SIGTERM, or with SIGKILL after STOP_GRACE_S. Return its exit status or signal."""
        self._control.close()
        if (status := self.process.returncode) is not None:
            return status
        status = await self.process.terminate(STOP_GRACE_S)
        self._left_behind = self.process.left_behind
        return status

    async def end_children(self) -> list[str]:
        """End the processes that the ended program left behind, and return their names."""
        in_container, self._left_behind = self._left_behind, ()
        if not self._has_children:
            return [*in_container]
        return [*in_container, *await asyncio.to_thread(self.children.end_left_behind)]
