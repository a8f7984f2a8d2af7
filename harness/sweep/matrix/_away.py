"""Carry out runs of a matrix on other machines, and copy their directories to this machine.

On a cluster, a worker carries out a run with real programs in its own temporary directory. If the matrix keeps the
directory of the run, the worker returns the directory together with the results. The directories are small, because
large traces are packed. If a directory is still too large for a message, the worker omits its largest files.
"""

import io
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from harness.errors import HarnessError
from harness.play.backends import BACKENDS
from harness.run.parallel import FailedTask, outcome_of
from harness.sweep.matrix._cell import Run
from harness.sweep.matrix._cell_play import RunPlayer, directory_name
from harness.sweep.matrix._matrix_file import MatrixTask

MAX_DIRECTORY_BYTES = 128 * 1024 * 1024


@dataclass(frozen=True)
class AwayRun:
    """The result of a run on another machine. `archive` is the run directory as a ZIP file. It is empty if no directory
    is kept.
    """

    outcome: Run | FailedTask | HarnessError
    archive: bytes

    def unpack(self, directory: Path) -> Run | FailedTask:
        """Write the run directory to this machine, and return the result of the run. Raises HarnessError if an error in
        the run ends the matrix.
        """
        if self.archive:
            with zipfile.ZipFile(io.BytesIO(self.archive)) as archive:
                archive.extractall(directory)
        if isinstance(self.outcome, HarnessError):
            raise self.outcome
        return self.outcome


@dataclass(frozen=True)
class AwayPlayer:
    """A function that carries out a run in a worker of a Dask cluster. `play` is the function that carries out a run on
    the machine on which it is called.
    """

    play: RunPlayer

    def __call__(self, task: MatrixTask) -> AwayRun:
        if BACKENDS[task.point.backend].plays_in_memory:
            return AwayRun(outcome_of(self.play, task), b"")
        from distributed import get_worker

        worker: Any = get_worker()
        with TemporaryDirectory(prefix="ucp-", dir=worker.local_directory) as scratch:
            there = replace(self.play, directory=Path(scratch))
            outcome = outcome_of(_checked(there), task)
            archive = _pack(Path(scratch), directory_name(task))
        if isinstance(outcome, FailedTask):
            outcome = FailedTask(outcome.reason.replace(scratch, str(self.play.directory)))
        elif isinstance(outcome, HarnessError):
            outcome.args = (f"the worker at {worker.address} cannot play a run: {outcome}",)
        return AwayRun(outcome, archive)


def _checked(play: RunPlayer) -> Callable[[MatrixTask], Run]:
    """Return a function that checks whether this machine can carry out a run, and then carries out the run."""

    def checked(task: MatrixTask) -> Run:
        play.refuse([task.point])
        return play(task)

    return checked


def _pack(scratch: Path, name: str) -> bytes:
    """Return the directory `name` in `scratch` as a ZIP file. Return no bytes if the matrix does not keep the
    directory.
    """
    sizes = {path: path.stat().st_size for path in (scratch / name).rglob("*") if path.is_file()}
    if not sizes:
        return b""
    content, left = io.BytesIO(), MAX_DIRECTORY_BYTES
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for path, size in sorted(sizes.items(), key=lambda item: item[1]):
            if size <= left:
                archive.write(path, path.relative_to(scratch))
                left -= size
    return content.getvalue()
