"""Scenarios: what is asked of a run, as short YAML files validated by pydantic.

An error names the key, the value and what is allowed. One file for each part of a scenario.
"""

from harness.scenario.load import explain, load_scenario, read_yaml
from harness.scenario.scenario import Scenario

__all__ = ["Scenario", "explain", "load_scenario", "read_yaml"]
