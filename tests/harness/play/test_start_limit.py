"""Test that a run starts a limited number of programs at the same time."""

import asyncio
from types import SimpleNamespace
from typing import Any

import pytest

from harness.play.process._fleet import Fleet
from harness.play.process._program_run import ProgramRun

LIMIT, PROGRAMS = 3, 10


class CountedStart:
    """A function that imitates the start of a program, and counts the simultaneous starts."""

    def __init__(self) -> None:
        self.running = self.most = self.started = 0

    async def __call__(self, program: Any, lab: Any) -> None:
        self.running += 1
        self.most = max(self.most, self.running)
        await asyncio.sleep(0.001)
        self.running -= 1
        self.started += 1


@pytest.mark.parametrize(("remote", "most"), [(frozenset[int](), LIMIT), (frozenset(range(PROGRAMS)), PROGRAMS)])
def test_agents_of_this_machine_start_a_few_at_a_time(remote: frozenset[int], most: int) -> None:
    run, start = object.__new__(ProgramRun), CountedStart()
    vars(run).update(
        agents=[SimpleNamespace(agent_id=number) for number in range(PROGRAMS)],
        _remote=remote,
        _start_limit=asyncio.Semaphore(LIMIT),
        _rogue=None,
        _show=lambda text: None,
        _start_agent=start,
    )
    asyncio.run(run._start_agents(None))  # type: ignore[arg-type]
    assert (start.most, start.started) == (most, PROGRAMS)


def test_vehicles_start_a_few_at_a_time() -> None:
    fleet, start = object.__new__(Fleet), CountedStart()

    async def supervise(vehicle: Any, lab: Any) -> None:
        assert start.started == PROGRAMS

    async def get_ready() -> None:
        """The vehicle is ready immediately."""

    vehicles = {number: SimpleNamespace(get_ready=get_ready) for number in range(PROGRAMS)}
    vars(fleet).update(
        _vehicles=vehicles,
        _boot=start,
        _scenario=SimpleNamespace(gcs=None),
        _supervise=supervise,
        _watchers=SimpleNamespace(create_task=asyncio.ensure_future),
    )
    asyncio.run(fleet.start(None, asyncio.Semaphore(LIMIT), lambda text: None))  # type: ignore[arg-type]
    assert (start.most, start.started) == (LIMIT, PROGRAMS)
