"""What runs beside a mission ends with it, and what fails first is what is said."""

import asyncio
import gc
import warnings

import pytest

from harness.errors import HarnessError
from harness.play.process._watchers import Watchers


class LostError(HarnessError):
    """What is watched fails."""


async def fails() -> None:
    raise LostError("agent 2 ended by itself")


async def goes_on() -> None:
    await asyncio.sleep(3600)


def test_what_begins_to_be_watched_while_a_mission_fails_is_not_talked_of() -> None:
    async def mission() -> None:
        watchers = Watchers()
        async with watchers.guard(fails()):
            try:
                await asyncio.sleep(3600)
            finally:
                watchers.start(goes_on())

    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        with pytest.raises(LostError, match="agent 2 ended by itself"):
            asyncio.run(mission())
        gc.collect()
    assert not said, [str(warning.message) for warning in said]
