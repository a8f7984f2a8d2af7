"""Scenarios: the descriptions of runs, as short YAML files that pydantic validates.

An error names the key, the value and the allowed values. Each module contains one part of a scenario.
"""

from harness.scenario.load import explain, load_scenario, read_yaml
from harness.scenario.scenario import Scenario

__all__ = ["Scenario", "explain", "load_scenario", "read_yaml"]
