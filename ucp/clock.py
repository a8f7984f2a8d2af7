"""Mission time: seconds since the mission's start, running `speedup` times as fast as the wall clock."""

import time

MICROSECONDS = 1_000_000


class MissionClock:
    """Does not run before `start`. Never goes back, whatever happens to the machine's wall clock."""

    def __init__(self, speedup: float) -> None:
        self.speedup = speedup
        self.epoch_us: int | None = None
        self._started = 0.0  # on the monotonic clock

    @property
    def running(self) -> bool:
        return self.epoch_us is not None

    def start(self, epoch_us: int) -> None:
        """Let mission time be 0 at `epoch_us`, microseconds since the Unix epoch; it may lie in the past or future."""
        self.epoch_us = epoch_us
        self._started = time.monotonic() - (time.time() - epoch_us / MICROSECONDS)

    def now(self) -> float:
        """Mission seconds; 0 before the start."""
        if self.epoch_us is None:
            return 0.0
        return max(0.0, (time.monotonic() - self._started) * self.speedup)

    def timestamp_us(self, now: float) -> int:
        """Microseconds since the Unix epoch at mission time `now`; at a speedup they run ahead of the wall clock."""
        return (self.epoch_us or 0) + round(now * MICROSECONDS)

    def wall_s(self, mission_s: float) -> float:
        """How long `mission_s` take on the wall clock."""
        return mission_s / self.speedup
