"""How far it is, and how it ended."""

import resource
import sys
from dataclasses import dataclass
from typing import Literal

Ended = Literal["complete", "flaw", "memory", "time", "interrupted"]


@dataclass(frozen=True)
class Progress:
    """States known, of these looked at, ways between them, how many instants from the beginning."""

    states: int
    looked_at: int
    transitions: int
    depth: int
    seconds: float


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


def memory_bytes() -> int:
    """What this process has ever taken."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
