"""Create scenarios in virtual time with few words."""

from typing import Any

from harness.scenario import Scenario


def scenario(**keys: Any) -> Scenario:
    return Scenario.model_validate({"name": "test", **keys})
