"""How far it is, and how it ended."""

import resource
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

LOOK_EVERY = 200
"""States between two looks at memory, clock and whoever watches."""
LOOK_EVERY_S = 0.1
"""Seconds between two such looks, where it is not states that are looked at."""
_STATM = Path("/proc/self/statm")
Ended = Literal["complete", "flaw", "memory", "time", "interrupted"]


@dataclass(frozen=True)
class Progress:
    """States known, of these looked at, ways between them, how many instants from the beginning.

    `asked` is what the whole graph is asked, once there are no other states.
    """

    states: int
    looked_at: int
    transitions: int
    depth: int
    seconds: float
    asked: str | None = None


@dataclass(frozen=True)
class Figures:
    """What was looked at: all but `steps` and the seconds is the same on any number of cores.

    `local_states` and `zones` are those that occur in states. `steps` is how many steps the real agent computed, in all
    processes. `seconds` are of the clock on the wall, `processor_s` of all processes.
    """

    states: int
    looked_at: int
    transitions: int
    local_states: int
    steps: int
    zones: int
    depth: int | None
    seconds: float
    processor_s: float


class GivenUpError(Exception):
    """A bound of memory or time was reached."""

    def __init__(self, ended: Ended) -> None:
        super().__init__(ended)
        self.ended = ended


class Budget:
    """So much memory, and so much time from now on, in seconds."""

    def __init__(self, most_bytes: float, most_s: float) -> None:
        self._began = time.monotonic()
        self._most_bytes = most_bytes
        self._most_s = most_s
        self._next_look_s = 0.0

    @property
    def seconds(self) -> float:
        return time.monotonic() - self._began

    def ended(self, elsewhere_bytes: float = 0.0) -> Ended | None:
        """By what it is used up; other processes have taken `elsewhere_bytes`."""
        if memory_bytes() + elsewhere_bytes > self._most_bytes:
            return "memory"
        return "time" if self.seconds > self._most_s else None

    def check(self, elsewhere_bytes: float = 0.0) -> bool:
        """Whether it looked; to be called again and again, for it mostly does not.

        Raises GivenUpError if it is used up.
        """
        seconds = self.seconds
        if seconds < self._next_look_s:
            return False
        self._next_look_s = seconds + LOOK_EVERY_S
        if (ended := self.ended(elsewhere_bytes)) is not None:
            raise GivenUpError(ended)
        return True


def memory_bytes() -> int:
    """What this process has taken: proc_pid_statm(5). Where there is no such file, what it has ever taken."""
    try:
        return int(_STATM.read_text().split()[1]) * resource.getpagesize()
    except OSError:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak if sys.platform == "darwin" else peak * 1024
