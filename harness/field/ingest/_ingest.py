"""What came home, sorted."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from harness.archive.exports import Export
from harness.archive.traces import Trace
from harness.errors import FieldError
from ucp.events import LoggableEvent

if TYPE_CHECKING:
    from ucp.secure.bundle import PublicKeys


@dataclass(frozen=True)
class Remark:
    """Something true of a file, or of a line of it: a sentence's end, as "it is not of this mission"."""

    path: Path
    why: str
    line: int | None = None
    """Counting from 1; None for the whole file."""
    counts: str = "line"
    """What `line` counts: of a bag its messages."""

    @property
    def sentence(self) -> str:
        where = f"{self.path}" if self.line is None else f"{self.path}, {self.counts} {self.line}"
        return "".join(letter if letter.isprintable() else "?" for letter in f"{where}: {self.why}")


@dataclass(frozen=True)
class LeftOut(Remark):
    """A file, or lines of it, that is not used, and why."""


@dataclass
class Flight:
    """What is left of one mission of one swarm, by agent ID."""

    initial_data: bytes | None
    """BD_0 of the mission, if any file says it."""
    traces: dict[int, Trace] = field(default_factory=dict)
    exports: dict[int, Export] = field(default_factory=dict)
    captures: dict[int, Path] = field(default_factory=dict)
    roster: tuple[int, ...] = ()
    """As the traces say it; empty if there is none."""
    epoch_us: int | None = None
    """Mission second 0 in microseconds since the Unix epoch, if any trace or capture says it."""
    more_captures: list[Path] = field(default_factory=list)
    """Further captures of the same vehicles, and those of points that only listened."""
    logged: dict[int, list[LoggableEvent]] = field(default_factory=dict)
    """Events that an agent was given, as somebody beside it took them down: its own trace has them anyway."""
    sources: dict[int, list[Path]] = field(default_factory=dict)
    """The files that the trace of an agent was read from."""
    public_keys: "PublicKeys | None" = None
    """Of a secured mission, if they came along."""

    @property
    def agents(self) -> list[int]:
        """All that left anything, the lowest ID first."""
        return sorted({*self.traces, *self.exports, *self.captures, *self.logged})

    @property
    def files(self) -> int:
        return len(self.traces) + len(self.exports) + len(self.captures) + len(self.logged)


@dataclass
class Homecoming:
    """The flights that are in the files, the one with the most in it first, and what is left out.

    `remarks` are of what is used all the same: a clock that was set, a header that another agent's trace had to lend.
    """

    flights: list[Flight]
    left_out: list[LeftOut]
    remarks: list[Remark] = field(default_factory=list)

    def largest(self) -> Flight:
        """The flight with the most in it. Raises FieldError if nothing can be used."""
        if not self.flights:
            why = f": {self.left_out[0].sentence}" if self.left_out else ""
            error = FieldError(f"none of these files is a usable trace, chain export or capture{why}")
            error.details = [left_out.sentence for left_out in self.left_out[1:]]
            raise error
        return self.flights[0]

    def sentences(self) -> Iterator[str]:
        """What is left out, what must be known of the rest, and what the other flights are: for people."""
        yield from (left_out.sentence for left_out in self.left_out)
        yield from (remark.sentence for remark in self.remarks)
        for flight in self.flights[1:]:
            agents = ", ".join(map(str, flight.agents)) or "none"
            yield f"{flight.files} of the files belong to another flight than the largest one (agents: {agents})"
