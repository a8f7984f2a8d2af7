"""Provide fixtures for tests of virtual networks: each engine in turn, and test programs in vehicles."""

from __future__ import annotations

import asyncio
import json
import math
import os
import sys
import time
from collections.abc import Coroutine
from pathlib import Path
from typing import Any

import pytest

from netem.lab import Lab, LabProcess
from tests.machine import require

AIR = Path(__file__).with_name("air.py")
PORT = 14600
DEADLINE_S = 30.0
PACKETS = int(os.environ.get("UCP_TEST_PACKETS", "4000"))


@pytest.fixture(params=["netem", "nftables"])
def engine(request: pytest.FixtureRequest) -> str:
    """Return the name of an engine. The test runs with each engine in turn."""
    require(request.param)
    return str(request.param)


@pytest.fixture
def netem() -> str:
    """Return the engine that supports all conditions."""
    require("netem")
    return "netem"


class Program:
    """A call of `air.py` that runs in a vehicle."""

    def __init__(self, process: LabProcess, output: Path) -> None:
        self.process = process
        self.output = output

    def said(self) -> list[Any]:
        return [json.loads(line) for line in self.output.read_text().splitlines()]

    async def finish(self) -> Any:
        """Stop the program with SIGTERM, and return its last line of output."""
        await self.process.send_signal(15)
        assert await asyncio.wait_for(self.process.wait(), DEADLINE_S) == 0, self.output.read_text()
        return self.said()[-1]


class Air:
    """Starts calls of `air.py` in the vehicles of a lab."""

    def __init__(self, lab: Lab, folder: Path) -> None:
        self.lab = lab
        self.folder = folder
        self._count = 0

    async def start(self, vehicle: int | None, *arguments: object) -> Program:
        self._count += 1
        output = self.folder / f"{vehicle}-{arguments[0]}-{self._count}.log"
        process = await self.lab.spawn(
            vehicle,
            [sys.executable, "-S", str(AIR), *map(str, arguments)],
            cwd=self.folder,
            env={"PATH": os.environ["PATH"], "PYTHONPATH": str(AIR.parents[2])},
            stdout=output,
            stderr=output,
        )
        return Program(process, output)

    async def start_ready(self, vehicle: int, *arguments: object) -> Program:
        """Start a listener and wait until it listens."""
        program = await self.start(vehicle, *arguments)
        await until(lambda: "ready" in program.output.read_text(), f"{arguments} on {vehicle} is ready")
        return program

    async def run(self, vehicle: int, *arguments: object) -> None:
        """Run a program that sends frames, and wait until it ends."""
        program = await self.start(vehicle, *arguments)
        assert await asyncio.wait_for(program.process.wait(), 4 * DEADLINE_S) == 0, program.output.read_text()

    async def broadcast(self, vehicle: int, count: int, first: int = 0, size: int = 12) -> None:
        await self.run(vehicle, "broadcast", PORT, count, first, self.lab.broadcast, size)


def play(story: Coroutine[Any, Any, None]) -> None:
    """Run the coroutine of a test. Fail the test if the coroutine makes no progress."""
    asyncio.run(asyncio.wait_for(story, 6 * DEADLINE_S))


async def until(condition: Any, what: str) -> None:
    """Wait until a condition is true, or fail after a time limit."""
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline, f"waited in vain until {what}"
        await asyncio.sleep(0.005)


def assert_binomial(found: int, count: int, probability: float) -> None:
    """Check that a count agrees with the probability. With a correct program, one of 100,000 checks fails."""
    deviation = 4.42 * math.sqrt(count * probability * (1 - probability))
    expected = count * probability
    assert abs(found - expected) <= deviation, f"{found} of {count}; expected {expected:.0f} ± {deviation:.0f}"
