"""Define scenarios: short YAML files that describe runs. The package pydantic validates them.

An error names the key, the value and the allowed values. Each module contains one part of a scenario.
"""

from harness.scenario._channel import Preset
from harness.scenario.load import explain, load_scenario, read_yaml
from harness.scenario.scenario import Scenario

__all__ = ["Preset", "Scenario", "explain", "load_scenario", "read_yaml"]
