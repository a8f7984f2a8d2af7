"""What this machine can do, for tests that need more than Python.

`UCP_REQUIRE` is a list of "lab", "netem", "nftables", "uml", "cc", "browser", "tshark", "docker", "tlc" and "ros"
(comma between): what it names may not be missing, a test that would be skipped for the lack of it fails instead.
"""

from __future__ import annotations

import asyncio
import functools
import os
import shutil
import tempfile
from pathlib import Path
from typing import NoReturn

import pytest

from harness.play.containers._container_preflight import require_root
from harness.play.containers.docker_engine import DockerError, Engine
from harness.proof.specification import _tlc
from netem import uml
from netem.errors import UmlError
from netem.lab import Lab, LabUnavailable


@functools.cache
def unavailable(engine: str | None) -> LabUnavailable | None:
    """Why there is no lab with this engine (None: any) here, if there is none."""

    async def attempt() -> None:
        lab = await Lab.open([1, 2], engine=engine, log=Path(folder, "lab.log"))  # type: ignore[arg-type]
        await lab.close()

    with tempfile.TemporaryDirectory() as folder:
        try:
            asyncio.run(attempt())
        except LabUnavailable as error:
            return error
    return None


def require(engine: str | None) -> None:
    """Skip, or fail if UCP_REQUIRE says that it has to be there."""
    if (error := unavailable(engine)) is None:
        return
    elsewhere = "; `make test-netem` runs it in User Mode Linux" if engine == "netem" else ""
    do_without("lab" if error.stage != "engine" else str(engine), f"{error.reason}{elsewhere}")


def require_uml() -> None:
    """The same of User Mode Linux."""
    try:
        uml.find()
    except UmlError as error:
        do_without("uml", str(error))


def require_docker() -> None:
    """The same of a Docker engine that we may use."""
    try:
        Engine.connect().close()
        require_root()
    except DockerError as error:
        do_without("docker", str(error))


def require_tlc() -> None:
    """The same of TLC, and of the Java that it needs."""
    try:
        _tlc.command()
    except _tlc.NoCheckerError as error:
        do_without("tlc", str(error))


def require_tshark() -> str:
    """The same of Wireshark's program for terminals; its path."""
    return shutil.which("tshark") or do_without("tshark", "no tshark on PATH (Debian package `tshark`)")


def do_without(what: str, reason: str) -> NoReturn:
    """Skip the test, for `what` is missing; or fail it if UCP_REQUIRE names that."""
    if what in os.environ.get("UCP_REQUIRE", "").split(","):
        pytest.fail(f"UCP_REQUIRE={os.environ['UCP_REQUIRE']}, but: {reason}")
    pytest.skip(reason)
