"""How fast virtual time goes: as fast as it can, at a real-time factor, or not at all but for single steps."""

import asyncio
import math
import time
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager

TICK_S = 0.05
"""Wall time between two looks at the clock."""
CATCH_UP_S = 1.0
"""Who is later than this, in wall time, does not try to make up for it."""
NEXT_RUN = math.inf
"""A step of this length ends with the next handler run of any agent."""


class Pace:
    """Of one run; of its event loop only. Virtual time asks it before it goes on, and is told how far it may go."""

    def __init__(self, factor: float | None = None, *, paused: bool = False) -> None:
        """`factor`: mission seconds per second of wall time; None: as fast as it can."""
        self.factor = factor
        self.paused = paused
        self._step: Future[float] | None = None
        self._step_to_s = 0.0
        self._now_s = 0.0
        self._heeded = True
        self._anchor: tuple[float, float] | None = None
        """A moment of wall time, and the mission second of that moment; None: it is the next one."""
        self._changed = asyncio.Event()

    @property
    def wants_run(self) -> bool:
        """Whether it is to stop at the next handler run."""
        return self._step is not None and self._step_to_s == NEXT_RUN

    def set(self, factor: float | None) -> None:
        """From now on go so fast."""
        self.factor = factor
        self._turn()

    def pause(self) -> None:
        """Stand still."""
        self.paused = True
        self._turn()

    def go_on(self) -> None:
        self.paused = False
        self._turn()

    def step(self, to_s: float, done: "Future[float]") -> None:
        """Pause, but go on until then, or with `NEXT_RUN` until the next handler run.

        `done`, which is running, has when it stands again.
        """
        self.paused = True
        self._turn()
        self._step, self._step_to_s = done, to_s

    @contextmanager
    def unheeded(self) -> Iterator[None]:
        """Inside, time goes as fast as it can: for what is done in no time."""
        self._heeded = False
        try:
            yield
        finally:
            self._heeded = True

    def stop_stepping(self) -> None:
        """A step that is under way ends here."""
        if self._step is not None:
            self._step.set_result(self._now_s)
        self._step = None

    def ran(self, now_s: float) -> None:
        """A handler has run, which ends a step that was to go so far."""
        self._now_s = now_s
        self.stop_stepping()

    async def allows(self, now_s: float) -> float | None:
        """Until when, in mission seconds, time may go on; None, after a moment, if it may not."""
        self._now_s = now_s
        if not self._heeded:
            return math.inf
        if self._step is not None:
            if self._step_to_s > now_s:
                return self._step_to_s
            self.stop_stepping()
        if self.paused:
            self._anchor = None
            await self._wait()
            return None
        if self.factor is None:
            return math.inf
        return await self._in_time(now_s, self.factor)

    async def _in_time(self, now_s: float, factor: float) -> float | None:
        if self._anchor is None or time.monotonic() - self._due(now_s, factor) > CATCH_UP_S:
            self._anchor = time.monotonic(), now_s
        if self._due(now_s, factor) > time.monotonic() - TICK_S:
            await self._wait()
            if self._anchor is None:
                return None  # it goes otherwise by now
        wall_s, since_s = self._anchor
        allowed_s = since_s + (time.monotonic() - wall_s) * factor
        return allowed_s if allowed_s > now_s else None

    def _due(self, mission_s: float, factor: float) -> float:
        """When, in wall time, it is that mission second."""
        assert self._anchor is not None
        wall_s, since_s = self._anchor
        return wall_s + (mission_s - since_s) / factor

    def _turn(self) -> None:
        self._anchor = None
        self._changed.set()
        self.stop_stepping()

    async def _wait(self) -> None:
        self._changed.clear()
        try:
            await asyncio.wait_for(self._changed.wait(), TICK_S)
        except TimeoutError:
            return
