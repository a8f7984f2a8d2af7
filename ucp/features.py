"""List the optional parts of the agent contract (features) that some missions need.

A mission file lists the features that it needs. An agent that lacks one of these features ends with status 127, because
it would otherwise play a different mission.
"""

from base64 import b64decode
from collections.abc import Callable, Mapping
from typing import Any

from ucp.sealed import sealed_to
from ucp.settings import ALTERNATIVES, NUMBERS

CONTRACT = 2
"""The version of contract/CONTRACT.md that mission files follow."""

UNSUPPORTED = 127
"""Exit status of an agent that lacks a feature of its mission."""


def _has(name: str, value: bool | str) -> Callable[[Mapping[str, Any]], bool]:
    return lambda mission: mission["settings"].get(name) == value


def _is_not_zero(name: str) -> Callable[[Mapping[str, Any]], bool]:
    return lambda mission: mission["settings"].get(name, 0) != 0


FEATURES: dict[str, Callable[[Mapping[str, Any]], bool]] = {
    "store": lambda mission: mission.get("store") is not None,
    "telemetry": lambda mission: mission["events"]["source"] == "mavlink",
    "secured": lambda mission: mission.get("security") is not None,
    "sealed": lambda mission: sealed_to(b64decode(mission["initial_data"])) is not None,
    "quirks": lambda mission: any(mission["quirks"].values()),
    **{feature: _has(name, value) for feature, (name, value) in ALTERNATIVES.items()},
    **{name: _is_not_zero(name) for name, number in NUMBERS.items() if number.is_feature},
}
"""Feature -> function that returns true if a mission file needs this feature. The mission file must contain all keys.
Only the settings in `ucp.settings.ADDED` may be missing.
"""


def needed_features(mission: Mapping[str, Any]) -> list[str]:
    """Return the features that an agent needs for a mission. The mission file must contain all keys."""
    return [name for name, is_needed in FEATURES.items() if is_needed(mission)]
