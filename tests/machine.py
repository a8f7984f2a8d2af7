"""What this machine can do, for tests that need more than Python.

`UCP_REQUIRE` is a list of "lab", "netem", "nftables", "uml", "browser" and "tshark" (comma between): what it names may
not be missing, a test that would be skipped for the lack of it fails instead.
"""

from __future__ import annotations

import asyncio
import functools
import os
import tempfile
from pathlib import Path

import pytest

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
    required = os.environ.get("UCP_REQUIRE", "").split(",")
    if ("lab" if error.stage != "engine" else engine) in required:
        pytest.fail(f"UCP_REQUIRE={os.environ['UCP_REQUIRE']}, but: {error}")
    elsewhere = "; `make test-netem` runs it in User Mode Linux" if engine == "netem" else ""
    pytest.skip(f"{error.reason}{elsewhere}")


def require_uml() -> None:
    """The same of User Mode Linux."""
    try:
        uml.find()
    except UmlError as error:
        if "uml" in os.environ.get("UCP_REQUIRE", "").split(","):
            pytest.fail(f"UCP_REQUIRE={os.environ['UCP_REQUIRE']}, but: {error}")
        pytest.skip(str(error))
