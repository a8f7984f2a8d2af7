"""List the run directories in a folder. The newest run is first."""

from collections.abc import Iterator
from dataclasses import dataclass
from heapq import nlargest
from pathlib import Path

from harness.archive.exports import RUN_FILE
from harness.archive.record_file import read_record
from harness.archive.run_record import RunRecord
from harness.errors import RunDirectoryError

RUNS = Path("runs")
"""Name of the folder for runs that were started without --out."""


@dataclass(frozen=True)
class PastRun:
    """A run directory with its record. `problem` is the reason why the record cannot be read. It is None for a readable
    record.
    """

    path: Path
    record: RunRecord
    problem: str | None

    @property
    def report(self) -> Path:
        return self.path / "report.html"


def past_runs(folder: Path, most: int) -> Iterator[PastRun]:
    """Yield the runs in `folder` whose run.json was written last, at most `most` of them. The newest run is first.

    Raises RunDirectoryError if `folder` is not a folder.
    """
    try:
        written = [(path.stat().st_mtime_ns, path) for path in folder.glob(f"*/{RUN_FILE}")]
    except OSError as error:
        raise RunDirectoryError(f"{folder} cannot be read: {error.strerror}") from None
    if not folder.is_dir():
        raise RunDirectoryError(
            f"{folder} does not exist: `ucp-harness run` creates it; otherwise name the folder of your runs"
        )
    for _, path in nlargest(most, written):
        file = read_record(path)
        yield PastRun(path.parent, file.record, str(file.error) if file.error else None)
