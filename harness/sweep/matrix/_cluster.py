"""Run many tasks on a Dask cluster, with the same interface as `harness.run.parallel` for one machine.

Dask gives the tasks of a lost worker to other workers. Each task is one future, so it has exactly one outcome, even if
it was started several times.
"""

import asyncio
import concurrent.futures
import contextlib
from collections.abc import Callable, Iterable, Iterator, Sized
from itertools import islice
from typing import Any, TypeVar

from harness.errors import MachineError
from harness.play.machine.dask_cluster import connected
from harness.run.parallel import FailedTask, outcome_of, progress_bar, raise_error, sigterm_as_ctrl_c

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
