"""Tests marked `lab` need private network namespaces: skipped where the machine has none, saying why."""

import pytest

from tests.machine import require


@pytest.fixture(autouse=True)
def _machine_can(request: pytest.FixtureRequest) -> None:
    if request.node.get_closest_marker("lab"):
        require(None)
