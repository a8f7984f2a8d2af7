"""Define the result of reading many files: the flights in them, and remarks on the files."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from harness.archive.exports import Export
from harness.archive.traces import Trace
from harness.errors import FieldError
from harness.field.flight_logs._matching import MatchedLog
from ucp.events import LoggableEvent

if TYPE_CHECKING:
    from ucp.secure.bundle import PublicKeys


@dataclass(frozen=True)
class FileRemark:
    """A remark on a file, or on one line of the file. `why` completes a sentence, as in "it is not of this mission"."""

    path: Path
    why: str
    line: int | None = None
    """Number of the line, counted from 1, or None if the remark concerns the whole file."""
    counts: str = "line"
    """The unit of `line`, for example "message" in a ROS bag."""

    @property
    def sentence(self) -> str:
        where = f"{self.path}" if self.line is None else f"{self.path}, {self.counts} {self.line}"
        return "".join(character if character.isprintable() else "?" for character in f"{where}: {self.why}")


@dataclass(frozen=True)
class UnusedPart(FileRemark):
    """A file, or a part of a file, that is not used, with the reason."""


@dataclass
class Flight:
    """The records of one flight of a swarm, by agent ID."""

    initial_data: bytes | None
    """The data of the inception block (BD_0), or None if no file contains it."""
    traces: dict[int, Trace] = field(default_factory=dict)
    exports: dict[int, Export] = field(default_factory=dict)
    captures: dict[int, Path] = field(default_factory=dict)
    roster: tuple[int, ...] = ()
    """The roster according to the traces or mission files. The roster is empty if there are no such files."""
    epoch_us: int | None = None
    """The time of mission second 0 in microseconds since the Unix epoch, or None if no trace or capture contains it."""
    more_captures: list[Path] = field(default_factory=list)
    """Further captures of the same vehicles, and captures of observation points without a vehicle."""
    logged: dict[int, list[LoggableEvent]] = field(default_factory=dict)
    """Events of the agents that a separate recorder recorded. The events in traces are not included."""
    sources: dict[int, list[Path]] = field(default_factory=dict)
    """The files from which the trace of each agent was read, by agent ID."""
    flight_logs: list[MatchedLog] = field(default_factory=list)
    """The flight logs of the vehicles that carried these agents."""
    mission_files: dict[int, Path] = field(default_factory=dict)
    """The mission file of each agent, by agent ID. If a vehicle did not come home, this may be the only file of its
    agent.
    """
    public_keys: "PublicKeys | None" = None
    """The public keys of a secured mission, or None if no file contains them."""

    @property
    def agents(self) -> list[int]:
        """The IDs of all agents that have at least one record, in ascending order."""
        return sorted({*self.traces, *self.exports, *self.captures, *self.logged})

    @property
    def files(self) -> int:
        return len(self.traces) + len(self.exports) + len(self.captures) + len(self.logged) + len(self.flight_logs)


@dataclass
class IngestResult:
    """The flights in the files, and the omitted files. The flight with the most records is first."""

    flights: list[Flight]
    left_out: list[UnusedPart]
    remarks: list[FileRemark] = field(default_factory=list)
    """Remarks on files that are used, for example on a changed clock, or on a header that was copied from another
    agent's trace.
    """

    def largest(self) -> Flight:
        """Return the flight with the most records. Raises FieldError if no file is usable."""
        if not self.flights:
            why = f": {self.left_out[0].sentence}" if self.left_out else ""
            error = FieldError(f"none of these files is a usable trace, chain export or capture{why}")
            error.details = [left_out.sentence for left_out in self.left_out[1:]]
            raise error
        return self.flights[0]

    def sentences(self) -> Iterator[str]:
        """Yield sentences for the user about omitted files, remarks, and further flights."""
        yield from (left_out.sentence for left_out in self.left_out)
        yield from (remark.sentence for remark in self.remarks)
        for flight in self.flights[1:]:
            agents = ", ".join(map(str, flight.agents)) or "none"
            yield f"{flight.files} of the files belong to another flight than the largest one (agents: {agents})"
