"""Carry out runs of a matrix on other machines, and copy their directories to this machine.

On a cluster, a worker carries out a run with real programs in its own temporary directory. If the matrix keeps the
directory of the run, the worker returns the directory together with the results. The directories are small, because
large traces are packed. If a directory is still too large for a message, the worker omits its largest files.

`cluster` has the same interface as `harness.run.parallel` for one machine. Dask gives the tasks of a lost worker
to other workers. Each task is one future, so it has exactly one outcome, even if it was started several times.
"""

import asyncio
import concurrent.futures
import contextlib
import io
import zipfile
from collections.abc import Callable, Iterable, Iterator, Sized
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

from harness.errors import HarnessError, MachineError
from harness.play.backends import BACKENDS
from harness.play.machine.dask_cluster import connected
from harness.run.parallel import FailedTask, outcome_of, progress_bar, raise_error, sigterm_as_ctrl_c
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
    """A function that carries out a run in a worker of a Dask cluster. The function calls `play` on the computer of the
    worker.
    """

    play: RunPlayer

    def __call__(self, task: MatrixTask) -> AwayRun:
        if BACKENDS[task.point.backend].plays_in_memory:
            return AwayRun(outcome_of(self.play, task), b"")
        from distributed import get_worker

        worker: Any = get_worker()
        with TemporaryDirectory(prefix="ucp-", dir=worker.local_directory) as scratch:
            there = replace(self.play, directory=Path(scratch), is_cancelled=_cancellation(worker))
            outcome = outcome_of(_checked(there), task)
            archive = _pack(Path(scratch), directory_name(task))
        if isinstance(outcome, FailedTask):
            outcome = FailedTask(outcome.reason.replace(scratch, str(self.play.directory)))
        elif isinstance(outcome, HarnessError):
            outcome.args = (f"the worker at {worker.address} cannot play a run: {outcome}",)
        return AwayRun(outcome, archive)


def _cancellation(worker: Any) -> Callable[[], bool]:
    """Return a function that returns true if the scheduler has cancelled the present task of this thread, for example
    because the user pressed Ctrl-C. Dask does not end an active task itself.
    """
    key = worker.get_current_task()

    def is_cancelled() -> bool:
        task = worker.state.tasks.get(key)
        return task is None or task.state == "cancelled"

    return is_cancelled


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


T = TypeVar("T")
R = TypeVar("R")


@contextlib.contextmanager
def cluster(
    tasks: Iterable[T], work: Callable[[T], R], address: str, *, what: str | None = None
) -> Iterator[Iterator[tuple[T, R | FailedTask]]]:
    """Yield (task, result) for each task in order of completion. `address` is the Dask scheduler (tcp://host:port).

    Results, errors and interrupts are treated as in `harness.run.parallel.sweep`. The workers must be able to import
    `work`. At the end of the context, unfinished tasks are cancelled. If the number of tasks is unknown, the next task
    is taken only when a thread of a worker is free.

    Raises HarnessError for an invalid address. Raises MachineError if no scheduler answers, if the scheduler has no
    workers or runs different versions, or if the connection is lost.
    """
    total = len(tasks) if isinstance(tasks, Sized) else None
    with sigterm_as_ctrl_c(), progress_bar(what, total) as count, connected(address) as client:
        yield _outcomes(client, tasks, work, address, count)


def _outcomes(
    client: Any, tasks: Iterable[T], work: Callable[[T], R], address: str, count: Callable[[Any], Any]
) -> Iterator[tuple[T, R | FailedTask]]:
    from distributed import as_completed

    # `work` is a task of its own, so each worker receives it once. Dask recreates it if its worker is lost.
    shared = client.submit(_same, work, pure=False)
    waiting, task_of, ended = iter(tasks), dict[Any, T](), as_completed(loop=client.loop)
    while True:
        active = len(tasks) if isinstance(tasks, Sized) else sum(client.nthreads().values())
        following = [*islice(waiting, max(0, active - len(task_of)))]
        for future, task in zip(
            client.map(outcome_of, [shared] * len(following), following, pure=False), following, strict=True
        ):
            task_of[future] = task
            ended.add(future)
        if not task_of:
            return
        future = next(ended)
        task = task_of.pop(future)
        try:
            outcome = future.result()
        except (Exception, asyncio.CancelledError, concurrent.futures.CancelledError) as error:
            if future.status != "error":
                raise MachineError(
                    f"the scheduler at {address} was lost: repeat the command with the same --out to continue"
                ) from None
            outcome = FailedTask(f"{type(error).__name__}: {error}")
        del future  # the reference would keep its outcome in memory
        yield task, raise_error(count(outcome))


def _same(work: T) -> T:
    return work
