"""Run many tasks on a Dask cluster, with the same interface as `harness.run.parallel` for one machine.

Dask gives the tasks of a lost worker to other workers. Each task is one future, so it has exactly one outcome, even if
it was started several times.
"""

import asyncio
import concurrent.futures
import contextlib
import logging
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Sized
from itertools import islice
from typing import Any, TypeVar

from harness.errors import HarnessError, MachineError, extra
from harness.run.parallel import FailedTask, outcome_of, progress_bar, raise_error, sigterm_as_ctrl_c

T = TypeVar("T")
R = TypeVar("R")

CONNECT_S = 10.0
SAME_VERSIONS = ("dask", "distributed", "ucp-harness")
"""Packages that must have the same version on this machine, on the scheduler and on each worker."""


@contextlib.contextmanager
def cluster(
    tasks: Iterable[T], work: Callable[[T], R], address: str, *, what: str | None = None
) -> Iterator[Iterator[tuple[T, R | FailedTask]]]:
    """Yield (task, result) for each task in order of completion. `address` is the Dask scheduler (tcp://host:port).

    Results, errors and interrupts are treated as in `harness.run.parallel.sweep`. The workers must be able to import
    `work`. At the end of the context, unfinished tasks are cancelled. If the number of tasks is unknown, the next task
    is taken only when a thread of a worker is free.

    Raises HarnessError for an invalid address. Raises MachineError if no scheduler answers, if it has no workers or
    different versions, or if the connection is lost.
    """
    total = len(tasks) if isinstance(tasks, Sized) else None
    with sigterm_as_ctrl_c(), progress_bar(what, total) as count, _connected(address) as client:
        yield _outcomes(client, tasks, work, address, count)


@contextlib.contextmanager
def _connected(address: str) -> Iterator[Any]:
    if not re.fullmatch(r"tcp://[^/\s]+:\d+", address):
        raise HarnessError(f"--scheduler {address} is not an address such as tcp://127.0.0.1:8786")
    with extra("cluster", "--scheduler"):
        import distributed
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # we report errors ourselves
    try:
        versions = asyncio.run(asyncio.wait_for(_versions(address), CONNECT_S))
    except Exception as error:  # another version or another program may raise any exception here
        raise MachineError(
            f"no Dask scheduler answers at {address} ({type(error).__name__}): start `dask scheduler` there, of "
            f"version {distributed.__version__}"
        ) from None
    _refuse_other_versions(versions, address)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", distributed.versions.VersionMismatchWarning)
        try:
            client = distributed.Client(address, timeout=CONNECT_S, set_as_default=False)
        except OSError as error:
            raise MachineError(f"the scheduler at {address} was lost while we connected: {error}") from None
    with client:
        yield client


async def _versions(address: str) -> dict[str, dict[str, str | None]]:
    """Return the versions of the packages in SAME_VERSIONS on this machine, on the scheduler, and on each worker."""
    from distributed import rpc
    from distributed.versions import get_versions

    async with rpc(address) as scheduler:
        its = await scheduler.versions(packages=SAME_VERSIONS)
        question = {"op": "versions", "packages": SAME_VERSIONS}
        workers = await scheduler.broadcast(msg=question, on_error="ignore")
    answers = {"here": get_versions(SAME_VERSIONS), f"the scheduler at {address}": its}
    answers |= {f"the worker at {worker}": answer for worker, answer in workers.items()}
    return {node: {name: answer["packages"].get(name) for name in SAME_VERSIONS} for node, answer in answers.items()}


def _refuse_other_versions(versions: dict[str, dict[str, str | None]], address: str) -> None:
    here, _, *workers = versions.values()
    if not workers:
        raise MachineError(f"the scheduler at {address} has no workers: start some with `dask worker {address}`")
    for node, packages in versions.items():
        for package, version in packages.items():
            if version != here[package]:
                has = f"{package} {version}" if version else f"no {package}"
                raise MachineError(
                    f"{node} has {has}, but this machine has {here[package]}: install the same version on both"
                )


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
