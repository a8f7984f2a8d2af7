"""Control the speed of virtual time: unlimited, limited to a multiple of real time, or paused with single steps."""

import asyncio
import math
import time
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager

TICK_S = 0.05
"""Maximum seconds of wall time that paused or limited virtual time waits before it checks the clock again."""
CATCH_UP_S = 1.0
"""Maximum delay in seconds of wall time that a simulation catches up by running faster. After a greater delay, it
continues at the requested speed and stays late.
"""
NEXT_RUN = math.inf
"""A special value for the end of a single step. With this value, the step ends with the next handler run of any agent.
"""


class VirtualTimePace:
    """The speed of virtual time in one run. Before virtual time advances, the simulation calls `allowed_until`. This
    method returns the time up to which virtual time may advance. Only the event loop of the run may use this object.
    """

    def __init__(self, factor: float | None = None, *, paused: bool = False) -> None:
        """Set the initial speed. `factor` is the number of mission seconds per second of wall time. If it is None, the
        speed is unlimited.
        """
        self.factor = factor
        self.paused = paused
        self._step: Future[float] | None = None
        self._step_to_s = 0.0
        self._now_s = 0.0
        self._limited = True
        self._anchor: tuple[float, float] | None = None
        """A pair of a wall time and the corresponding mission second. The object computes later mission seconds from
        this pair and the current speed. None if the next check must set the pair.
        """
        self._pace_changed = asyncio.Event()

    @property
    def stops_at_next_run(self) -> bool:
        """True if the current single step of virtual time ends at the next handler run."""
        return self._step is not None and self._step_to_s == NEXT_RUN

    def set_factor(self, factor: float | None) -> None:
        """Set the number of mission seconds per second of wall time. If it is None, the speed is unlimited."""
        self.factor = factor
        self._change()

    def pause(self) -> None:
        """Pause virtual time."""
        self.paused = True
        self._change()

    def resume(self) -> None:
        self.paused = False
        self._change()

    def step(self, to_s: float, done: "Future[float]") -> None:
        """Advance virtual time to mission second `to_s`, and then pause. With `NEXT_RUN`, advance to the next handler
        run. The future `done` receives the mission second at the end of the step. The caller must pass the future in
        the state "running".
        """
        self.paused = True
        self._change()
        self._step, self._step_to_s = done, to_s

    @contextmanager
    def unlimited(self) -> Iterator[None]:
        """Remove all speed limits inside the context. The run uses this context to apply an event that the user causes
        by hand, because such an event takes no mission time.
        """
        self._limited = False
        try:
            yield
        finally:
            self._limited = True

    def end_step(self) -> None:
        """End the current single step of paused virtual time, if there is one."""
        if self._step is not None:
            self._step.set_result(self._now_s)
        self._step = None

    def record_run(self, now_s: float) -> None:
        """Record that a handler has run. If a single step waits for a handler run, the step ends."""
        self._now_s = now_s
        self.end_step()

    async def allowed_until(self, now_s: float) -> float | None:
        """Return the mission second up to which virtual time may advance now. Infinity means no limit. If virtual time
        may not advance now, wait for a short time, and return None.
        """
        self._now_s = now_s
        if not self._limited:
            return math.inf
        if self._step is not None:
            if self._step_to_s > now_s:
                return self._step_to_s
            self.end_step()
        if self.paused:
            self._anchor = None
            await self._wait()
            return None
        if self.factor is None:
            return math.inf
        return await self._allowed_by_factor(now_s, self.factor)

    async def _allowed_by_factor(self, now_s: float, factor: float) -> float | None:
        if self._anchor is None or time.monotonic() - self._wall_time_of(now_s, factor) > CATCH_UP_S:
            self._anchor = time.monotonic(), now_s
        if self._wall_time_of(now_s, factor) > time.monotonic() - TICK_S:
            await self._wait()
            if self._anchor is None:
                return None  # the pace has changed meanwhile
        wall_s, since_s = self._anchor
        allowed_s = since_s + (time.monotonic() - wall_s) * factor
        return allowed_s if allowed_s > now_s else None

    def _wall_time_of(self, mission_s: float, factor: float) -> float:
        """Return the wall time at which virtual time must reach this mission second."""
        assert self._anchor is not None
        wall_s, since_s = self._anchor
        return wall_s + (mission_s - since_s) / factor

    def _change(self) -> None:
        self._anchor = None
        self._pace_changed.set()
        self.end_step()

    async def _wait(self) -> None:
        self._pace_changed.clear()
        try:
            await asyncio.wait_for(self._pace_changed.wait(), TICK_S)
        except TimeoutError:
            return
