"""Test tasks that run during a mission: they end with the mission, and the first error of a task is reported."""

import asyncio
import gc
import warnings

import pytest

from harness.errors import HarnessError
from harness.play.process._watchers import MissionTasks


class LostError(HarnessError):
    """The error of a task that runs during a mission."""


async def fail() -> None:
    raise LostError("agent 2 ended by itself")


async def wait() -> None:
    await asyncio.sleep(3600)


def test_task_started_while_a_mission_fails_causes_no_warning() -> None:
    async def mission() -> None:
        watchers = MissionTasks()
        async with watchers.guard(fail()):
            try:
                await asyncio.sleep(3600)
            finally:
                watchers.start(wait())

    gc.collect()  # objects of other tests may raise warnings when they are deleted
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        with pytest.raises(LostError, match="agent 2 ended by itself"):
            asyncio.run(mission())
        gc.collect()
    assert not warned, [str(warning.message) for warning in warned]
