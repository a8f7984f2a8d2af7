"""Report the progress of an exploration and its final numbers, and limit its memory and time."""

import resource
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

LOOK_EVERY = 200
"""Number of states between two reports of the progress."""
LOOK_EVERY_S = 0.1
"""Minimum time in seconds between two checks of memory and time in `ExplorationBudget.check`."""
_STATM = Path("/proc/self/statm")
Ended = Literal["complete", "flaw", "memory", "time", "interrupted"]


@dataclass(frozen=True)
class ExplorationProgress:
    """The progress of an exploration, which visits all states of a swarm and computes their successors."""

    states: int
    """Number of states found so far."""
    looked_at: int
    """Number of states whose successors were computed."""
    transitions: int
    depth: int
    """Number of steps of the swarm from the initial state to the states that are being explored."""
    seconds: float
    asked: str | None = None
    """The question about the whole graph that is now being answered. None until all states are explored."""


@dataclass(frozen=True)
class ExplorationFigures:
    """The size of an exploration. Except `steps` and the times, all numbers are the same for any number of processor
    cores.
    """

    states: int
    looked_at: int
    transitions: int
    local_states: int
    """Number of states of single agents that occur in explored states of the swarm."""
    steps: int
    """Number of steps that real agents computed in all processes."""
    zones: int
    """Number of zones that occur in explored states. A zone is a set of possible remaining times of the running
    timers.
    """
    depth: int | None
    seconds: float
    """Wall time of the exploration, in seconds."""
    processor_s: float
    """Processor time of all processes, in seconds."""


class LimitReachedError(Exception):
    """An error: the exploration reached its limit of memory or time."""

    def __init__(self, ended: Ended) -> None:
        super().__init__(ended)
        self.ended = ended


class ExplorationBudget:
    """The limits of an exploration: memory in bytes, and time in seconds from its start."""

    def __init__(self, most_bytes: float, most_s: float) -> None:
        self._began = time.monotonic()
        self._most_bytes = most_bytes
        self._most_s = most_s
        self._next_look_s = 0.0

    @property
    def seconds(self) -> float:
        return time.monotonic() - self._began

    def ended(self, elsewhere_bytes: float = 0.0) -> Ended | None:
        """Return the name of the limit that is reached, "memory" or "time". Return None if no limit is reached.

        `elsewhere_bytes` is the memory that the other processes use.
        """
        if memory_bytes() + elsewhere_bytes > self._most_bytes:
            return "memory"
        return "time" if self.seconds > self._most_s else None

    def check(self, elsewhere_bytes: float = 0.0) -> bool:
        """Check the limits, but at most once per LOOK_EVERY_S seconds. Return true if the limits were checked.

        Raises LimitReachedError if a limit is reached.
        """
        seconds = self.seconds
        if seconds < self._next_look_s:
            return False
        self._next_look_s = seconds + LOOK_EVERY_S
        if (ended := self.ended(elsewhere_bytes)) is not None:
            raise LimitReachedError(ended)
        return True


def memory_bytes() -> int:
    """Return the memory that this process uses, in bytes (proc_pid_statm(5)). On systems other than Linux, return its
    maximum memory so far.
    """
    try:
        return int(_STATM.read_text().split()[1]) * resource.getpagesize()
    except OSError:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak if sys.platform == "darwin" else peak * 1024
