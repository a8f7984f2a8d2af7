"""Short-hand for scenarios in virtual time."""

from typing import Any

from harness.scenario import Scenario


def scenario(**keys: Any) -> Scenario:
    return Scenario.model_validate({"name": "test", **keys})
