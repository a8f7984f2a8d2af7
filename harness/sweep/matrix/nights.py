"""`--nights`: a directory that keeps the matrix.json of each finished night, for the trend in the report."""

import re
from dataclasses import dataclass
from pathlib import Path

from harness.errors import MachineError, RunDirectoryError, ScenarioError
from harness.sweep.matrix.baseline import load_night
from harness.sweep.matrix.matrix_file import Matrix
from harness.sweep.matrix.matrix_record import MatrixRecord
from ucp.agent_files import write_json_atomically

LAST = 60
"""So many nights are read: those whose files' names come last, and the names that we give begin with the date."""


@dataclass(frozen=True, slots=True)
class Nights:
    """Those in `directory` that are of one matrix, by when they were begun; `left_out` says why others are not."""

    directory: Path
    records: list[MatrixRecord]
    left_out: list[str]

    @property
    def said_left_out(self) -> str:
        """How many; nothing if none is."""
        if not self.left_out:
            return ""
        which = "1 file" if len(self.left_out) == 1 else f"{len(self.left_out)} files"
        return f"{which} in {self.directory} left out of the trend"


def opened(directory: Path) -> Path:
    """Makes it if need be. Raises RunDirectoryError if it cannot be."""
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunDirectoryError(f"{directory} cannot be made: {error.strerror}; choose another --nights") from None
    return directory


def keep(record: MatrixRecord, directory: Path) -> None:
    """Add a night if it is finished; once, however often it is added. Raises MachineError if the disk refuses."""
    if record.outcome != "completed":
        return
    path = directory / f"{re.sub('[^0-9TZ]', '', record.started_at)}.json"
    try:
        write_json_atomically(path, record.to_json())
    except OSError as error:
        raise MachineError(f"{path} cannot be written: {error.strerror}") from None


def read(directory: Path, matrix: Matrix) -> Nights:
    """What `directory` has of `matrix`."""
    records, left_out = [], []
    for path in sorted(directory.glob("*.json"))[-LAST:]:
        try:
            records.append(load_night(path, matrix))
        except ScenarioError as error:
            left_out.append(str(error))
    return Nights(directory, sorted(records, key=lambda record: record.started_at), left_out)
