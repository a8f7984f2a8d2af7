"""Read and write results.jsonl, the list of finished runs, so that an interrupted matrix can continue.

The first line is the resolved matrix. Each further line is one run. Lines are only appended.
"""

import contextlib
import fcntl
import json
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, BinaryIO

from pydantic import ValidationError

from harness.archive.directory import claim
from harness.errors import HarnessError, MachineError, RunDirectoryError
from harness.sweep.matrix._cell import Run
from harness.sweep.matrix._matrix_file import Matrix, MatrixTask
from ucp.agent_files import write_atomically
from ucp.plain_file import parse_json

FILE = "results.jsonl"
SCHEMA = "ucp-matrix-results/1"


class MatrixResults:
    """A list of the finished runs of a matrix. It contains at most one result for each task."""

    def __init__(self, directory: Path, started_at: str, runs: dict[MatrixTask, Run], file: BinaryIO) -> None:
        self.directory, self.started_at, self.runs = directory, started_at, runs
        self._file = file

    def add(self, run: Run) -> None:
        """Append the result of a run to the file. Raises MachineError if the file cannot be written."""
        line = _line(run.model_dump(mode="json"))
        try:
            if self._file.write(line) < len(line):
                raise OSError(None, "No space left on device")
        except OSError as error:
            raise MachineError(
                f"{self.directory / FILE} cannot be written: {error.strerror}; it has all finished runs: free some "
                f"space, and repeat the command with --out {self.directory} to continue"
            ) from None
        self.runs[run.task] = run


@contextlib.contextmanager
def opened(directory: Path, matrix: Matrix) -> Iterator[MatrixResults]:
    """Open the results of `matrix` in `directory`, which may be new or empty. If the matrix cannot be played, and a new
    directory contains no result, remove the directory.

    Raises RunDirectoryError if the directory contains other files, or if another command uses it.
    """
    path = directory / FILE
    is_new = not directory.exists()
    with contextlib.ExitStack() as stack:
        try:
            if not path.exists():
                claim(directory)
                write_atomically(path, _line(_header(matrix)).decode("ascii"))
            file = stack.enter_context(path.open("r+b", buffering=0))
        except OSError as error:
            raise RunDirectoryError(f"{path} cannot be written: {error.strerror}; choose another --out") from None
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise RunDirectoryError(f"another command works on the matrix in {directory}: wait for its end") from None
        content = file.read()
        # an incomplete last line remains of a command that was interrupted while writing
        whole = content.rfind(b"\n") + 1
        first, *lines = content[:whole].splitlines() or [b""]
        started_at = _start_time(first, matrix, directory)
        file.truncate(whole)
        file.seek(whole)
        results = MatrixResults(directory, started_at, _read(lines, matrix, path), file)
        try:
            yield results
        except HarnessError:
            if is_new and [*directory.iterdir()] == [path] and not results.runs:
                path.unlink()
                directory.rmdir()
            raise


def _header(matrix: Matrix) -> dict[str, object]:
    now = datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
    return {"schema": SCHEMA, "started_at": now, "matrix": matrix.model_dump(mode="json")}


def _start_time(line: bytes, matrix: Matrix, directory: Path) -> str:
    """Return the time at which the matrix in `directory` was started. Raises RunDirectoryError if the directory
    contains the results of another matrix.
    """
    try:
        header = parse_json(line)
    except ValueError:
        header = None
    if not isinstance(header, dict) or header.get("schema") != SCHEMA:
        raise RunDirectoryError(f"{directory} is not empty: choose another --out; existing files are not overwritten")
    if header.get("matrix") != matrix.model_dump(mode="json"):
        raise RunDirectoryError(f"{directory} holds the results of another matrix file: choose another --out")
    return str(header.get("started_at"))


def _read(lines: list[bytes], matrix: Matrix, path: Path) -> dict[MatrixTask, Run]:
    asked = set(matrix.tasks)
    runs: dict[MatrixTask, Run] = {}
    for number, line in enumerate(lines, 2):
        try:
            run = Run.model_validate_json(line)
        except ValidationError:
            run = None
        if run is None or run.task not in asked:
            raise RunDirectoryError(
                f"{path} line {number} is not a run of this matrix: remove the line to play it again"
            )
        runs.setdefault(run.task, run)
    return runs


def _line(document: dict[str, Any]) -> bytes:
    return json.dumps(document, separators=(",", ":")).encode("ascii") + b"\n"
