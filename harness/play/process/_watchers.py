"""Run tasks during a mission, for example to watch programs. An error in a task ends the mission."""

import asyncio
from collections import defaultdict
from collections.abc import AsyncIterator, Awaitable, Coroutine
from contextlib import asynccontextmanager
from typing import Any, TypeVar

from harness.errors import AgentFailedError, HarnessError, InterruptedRunError

T = TypeVar("T")


class MissionTasks:
    """A group of tasks that run during a mission. An exception in a task ends the mission. The tasks end at the end of
    the mission, or earlier through `stop`.
    """

    def __init__(self) -> None:
        self._group = asyncio.TaskGroup()
        self._tasks: dict[str, list[asyncio.Task[None]]] = defaultdict(list)
        """The tasks that watch or control a program or a flight, by the name of the program or flight."""

    @asynccontextmanager
    async def guard(self, *watched: Coroutine[Any, Any, None]) -> AsyncIterator[None]:
        """Run the mission in this context, together with the tasks in `watched`. If one of these tasks fails, raise the
        error of the task.
        """
        try:
            async with self._group:
                for coroutine in watched:
                    self.start(coroutine)
                yield
                for what in list(self._tasks):
                    self.stop(what)
        except BaseExceptionGroup as errors:
            raise _root_error(errors) from None

    def start(self, coroutine: Coroutine[Any, Any, None], of: str = "mission") -> None:
        self._tasks[of].append(self.create_task(coroutine))

    def stop(self, of: str) -> None:
        for task in self._tasks.pop(of, ()):
            task.cancel()

    def create_task(self, coroutine: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """Start a task that `stop` does not cancel. The mission ends only after the task has ended.

        Raises RuntimeError if a failure is already ending the mission.
        """
        try:
            return self._group.create_task(coroutine)
        except RuntimeError:
            coroutine.close()
            raise


async def open_unless_interrupted(opening: Awaitable[T], interrupted: asyncio.Event) -> T:
    """Wait for `opening`, and return its result. If the user interrupts the run, cancel `opening` and raise
    InterruptedRunError.
    """
    opened = asyncio.ensure_future(opening)
    interruption = asyncio.create_task(interrupted.wait())
    await asyncio.wait({opened, interruption}, return_when=asyncio.FIRST_COMPLETED)
    interruption.cancel()
    if not opened.done():
        opened.cancel()
        await asyncio.wait({opened})
    if opened.cancelled():
        raise InterruptedRunError("the run was interrupted before its start")
    return opened.result()


def _root_error(errors: BaseExceptionGroup[BaseException]) -> BaseException:
    """Return the error that probably caused the other errors. If an agent failed, return its failure. Otherwise return
    a HarnessError.
    """
    flat: list[BaseException] = []
    for error in errors.exceptions:
        flat += [_root_error(error)] if isinstance(error, BaseExceptionGroup) else [error]
    return min(flat, key=lambda error: (not isinstance(error, HarnessError), not isinstance(error, AgentFailedError)))
