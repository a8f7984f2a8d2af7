"""What came home, sorted."""

from dataclasses import dataclass, field
from pathlib import Path

from harness.archive.exports import Export
from harness.archive.traces import Trace


@dataclass(frozen=True)
class LeftOut:
    """A file, or lines of it, that is not used, and why: a sentence's end, as "it is not of this mission"."""

    path: Path
    why: str
    line: int | None = None
    """Counting from 1; None for the whole file."""


@dataclass
class Flight:
    """What is left of one mission of one swarm, by agent ID."""

    initial_data: bytes | None
    """BD_0 of the mission, if any file says it."""
    traces: dict[int, Trace] = field(default_factory=dict)
    exports: dict[int, Export] = field(default_factory=dict)
    captures: dict[int, Path] = field(default_factory=dict)


@dataclass
class Homecoming:
    """The flights that are in the files, the one with the most in it first, and what is left out."""

    flights: list[Flight]
    left_out: list[LeftOut]
