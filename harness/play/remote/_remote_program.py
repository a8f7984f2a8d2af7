"""Suspend, resume and kill a remote agent. The stand-in of the agent receives signals for these actions."""

import asyncio
import contextlib
import signal
from collections.abc import Callable, Sequence

from harness.play.process.lab_program import LabProgram

KILL_LIMIT_S = 3.0


class RemoteProgram:
    """Control a stand-in as if it were the remote agent. A process cannot catch SIGSTOP and SIGKILL. In place of these
    signals, the stand-in receives signals that it can catch.
    """

    def __init__(self, stand_in: LabProgram, left_behind: Callable[[], Sequence[str]]) -> None:
        """Create the program. `left_behind` returns the names of processes that the agent left on its computer."""
        self._stand_in, self._left_behind = stand_in, left_behind

    @property
    def returncode(self) -> int | None:
        return self._stand_in.returncode

    @property
    def end(self) -> str:
        return self._stand_in.end

    @property
    def left_behind(self) -> Sequence[str]:
        return self._left_behind()

    async def wait(self) -> int:
        return await self._stand_in.wait()

    async def send_signal(self, number: int) -> None:
        if number != signal.SIGKILL:
            await self._stand_in.send_signal(number)
            return
        await self._stand_in.send_signal(signal.SIGQUIT)
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self.wait(), KILL_LIMIT_S)
        await self._stand_in.send_signal(signal.SIGKILL)

    async def pause(self) -> None:
        await self._stand_in.send_signal(signal.SIGUSR1)

    async def resume(self) -> None:
        await self._stand_in.send_signal(signal.SIGUSR2)

    async def terminate(self, grace_s: float) -> int:
        return await self._stand_in.terminate(grace_s)
