"""Many tasks on a Dask cluster: outcomes as they end, as `harness.run.parallel` has them of one machine.

Dask hands a lost worker's tasks to others. Each task is one future, so its outcome comes once, however often it had to
be worked on.
"""

import asyncio
import concurrent.futures
import contextlib
import logging
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

from harness.errors import HarnessError, MachineError
from harness.run.parallel import Failed, outcome_of, raised, shown, terminated_is_interrupted

T = TypeVar("T")
R = TypeVar("R")

CONNECT_S = 10.0
SAME_VERSIONS = ("dask", "distributed", "ucp-harness")
"""Packages that must be the same here, on the scheduler and on every worker."""


@contextlib.contextmanager
def cluster(
    tasks: Sequence[T], work: Callable[[T], R], address: str, *, what: str | None = None
) -> Iterator[Iterator[tuple[T, R | Failed]]]:
    """Each task with its outcome, as they end, from the workers of the scheduler at `address`, tcp://host:port.

    Outcomes, errors and interrupts as `harness.run.parallel.sweep` has them; `work` has to be importable on the
    workers. Raises MachineError if there is no such scheduler, it has no workers, its versions differ, or it is lost;
    HarnessError for an address that is none. Leaving the block takes back what has not been worked on.
    """
    with terminated_is_interrupted(), shown(what, len(tasks)) as count, _connected(address) as client:
        yield _outcomes(client, tasks, work, address, count)


@contextlib.contextmanager
def _connected(address: str) -> Iterator[Any]:
    if not re.fullmatch(r"tcp://[^/\s]+:\d+", address):
        raise HarnessError(f"--scheduler {address} is not an address such as tcp://127.0.0.1:8786")
    try:
        import distributed
    except ImportError:
        raise MachineError(
            "--scheduler needs Dask, which is not installed here: pip install 'ucp-harness[cluster]'"
        ) from None
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # what goes wrong we say ourselves
    try:
        versions = asyncio.run(asyncio.wait_for(_versions(address), CONNECT_S))
    except Exception as error:  # whatever another version, or no Dask at all, makes of our greeting
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
    """The packages of SAME_VERSIONS: here, on the scheduler, and on each worker."""
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
                raise MachineError(f"{node} has {has}, and here is {here[package]}: install the same version on both")


def _outcomes(
    client: Any, tasks: Sequence[T], work: Callable[[T], R], address: str, count: Callable[[Any], Any]
) -> Iterator[tuple[T, R | Failed]]:
    from distributed import as_completed

    if not tasks:
        return
    # As a task of its own, `work` goes to each worker once, and is made again if a worker is lost with it.
    shared = client.submit(_same, work, pure=False)
    futures = client.map(outcome_of, [shared] * len(tasks), tasks, pure=False)
    task_of = dict(zip(futures, tasks, strict=True))
    ended = as_completed(futures, loop=client.loop)
    del futures  # so that an outcome is kept no longer than we need it
    for future in ended:
        task = task_of.pop(future)
        try:
            outcome = future.result()
        except (Exception, asyncio.CancelledError, concurrent.futures.CancelledError) as error:
            if future.status != "error":
                raise MachineError(
                    f"the scheduler at {address} was lost: the same command with the same --out goes on"
                ) from None
            outcome = Failed(f"{type(error).__name__}: {error}")
        yield task, raised(count(outcome))


def _same(work: T) -> T:
    return work
