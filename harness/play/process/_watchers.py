"""What runs beside a mission, and ends it when something goes wrong: watchers of programs, the user's Ctrl-C."""

import asyncio
from collections import defaultdict
from collections.abc import AsyncIterator, Awaitable, Coroutine
from contextlib import asynccontextmanager
from typing import Any, TypeVar

from harness.errors import AgentFailedError, HarnessError, InterruptedRunError

T = TypeVar("T")


class Watchers:
    """Tasks beside a mission. What one of them raises ends the mission, and they end with it, or before by `stop`."""

    def __init__(self) -> None:
        self._group = asyncio.TaskGroup()
        self._tasks: dict[str, list[asyncio.Task[None]]] = defaultdict(list)
        """Of what -> the tasks that watch it, or fly it."""

    @asynccontextmanager
    async def guard(self, *watched: Coroutine[Any, Any, None]) -> AsyncIterator[None]:
        """The mission is inside, beside what is watched all along; raises the first failure of anything."""
        try:
            async with self._group:
                for coroutine in watched:
                    self.start(coroutine)
                yield
                for what in list(self._tasks):
                    self.stop(what)
        except BaseExceptionGroup as errors:
            raise _first(errors) from None

    def start(self, coroutine: Coroutine[Any, Any, None], of: str = "mission") -> None:
        self._tasks[of].append(self.task(coroutine))

    def stop(self, of: str) -> None:
        for task in self._tasks.pop(of, ()):
            task.cancel()

    def task(self, coroutine: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """One that the mission waits for. Raises RuntimeError if the mission is ending by a failure already."""
        try:
            return self._group.create_task(coroutine)
        except RuntimeError:
            coroutine.close()
            raise


async def unless_interrupted(opening: Awaitable[T], interrupted: asyncio.Event) -> T:
    """What is opened. Raises InterruptedRunError, once what was begun has been taken back."""
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


def _first(errors: BaseExceptionGroup[BaseException]) -> BaseException:
    """The error to report: an agent's or vehicle's own before what followed from it."""
    flat: list[BaseException] = []
    for error in errors.exceptions:
        flat += [_first(error)] if isinstance(error, BaseExceptionGroup) else [error]
    return min(flat, key=lambda error: (not isinstance(error, HarnessError), not isinstance(error, AgentFailedError)))
