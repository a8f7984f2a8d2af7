"""Measure mission time, in seconds since the start of a mission. Mission time runs `speedup` times as fast as wall
time.
"""

import time

MICROSECONDS = 1_000_000


class MissionClock:
    """A clock for mission time. It never goes back, even if the wall clock of the machine is changed."""

    def __init__(self, speedup: float) -> None:
        self.speedup = speedup
        self.epoch_us: int | None = None
        self._started = 0.0  # on the monotonic clock

    @property
    def running(self) -> bool:
        return self.epoch_us is not None

    def start(self, epoch_us: int) -> None:
        """Set the wall time at which mission time is 0. `epoch_us` is this time in microseconds since the Unix epoch.
        It may be in the past or in the future.
        """
        self.epoch_us = epoch_us
        self._started = time.monotonic() - (time.time() - epoch_us / MICROSECONDS)

    def now(self) -> float:
        """Return the mission time in seconds. Before the start of the mission it is 0."""
        if self.epoch_us is None:
            return 0.0
        return max(0.0, (time.monotonic() - self._started) * self.speedup)

    def timestamp_us(self, now: float) -> int:
        """Convert the mission time `now` to microseconds since the Unix epoch. If the speedup is above 1, the result is
        later than the wall time.
        """
        return (self.epoch_us or 0) + round(now * MICROSECONDS)

    def wall_s(self, mission_s: float) -> float:
        """Convert a number of mission seconds to seconds of wall time."""
        return mission_s / self.speedup
