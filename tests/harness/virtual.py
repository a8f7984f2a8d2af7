"""Create short scenarios in virtual time for tests."""

from typing import Any

from harness.scenario import Scenario


def scenario(**keys: Any) -> Scenario:
    return Scenario.model_validate({"name": "test", **keys})
