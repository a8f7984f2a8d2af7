"""Connect to a Dask cluster that the user started, and check the versions of its packages. The workers of the cluster
carry out either whole runs of a matrix, or the agents of a single run.
"""

import asyncio
import contextlib
import logging
import re
import warnings
from collections.abc import Iterator
from typing import Any

from harness.errors import HarnessError, MachineError, extra

CONNECT_S = 10.0
SAME_VERSIONS = ("dask", "distributed", "ucp-harness")
"""Packages that must have the same version on this machine, on the scheduler and on each worker."""


@contextlib.contextmanager
def connected(address: str) -> Iterator[Any]:
    """Return a client of the Dask scheduler at `address` (tcp://host:port), as a context manager.

    Raises HarnessError for an invalid address. Raises MachineError if no scheduler answers, if the cluster has no
    workers, or if its packages have other versions.
    """
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
