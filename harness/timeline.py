"""The fault timeline: what changes when, as values. A backend plays them; the checker judges without them.

A timeline is computed before the run from the scenario alone, so every backend plays the same.
"""

from dataclasses import dataclass

from harness.scenario import Scenario
from netem.conditions import NetworkConditions


@dataclass(frozen=True)
class NetworkChange:
    """From `at_s` mission seconds on, these conditions hold. `what` is one word, `detail` says it to people."""

    at_s: float
    what: str
    detail: str
    conditions: NetworkConditions


def network_changes(scenario: Scenario) -> list[NetworkChange]:
    """Every state of the network, in order; the first is at 0 s, when the mission starts."""
    network = scenario.network
    partition: tuple[frozenset[int], ...] = ()
    changes = [_change(0.0, "start", network.conditions())]
    for entry in scenario.timeline_in_order():
        if entry.loss is not None:
            network, what = network.model_copy(update={"loss": entry.loss}), "loss"
        elif entry.partition is not None:
            partition, what = tuple(frozenset(group) for group in entry.partition), "partition"
        else:
            partition, what = (), "heal"
        change = _change(entry.at_s, what, network.conditions(partition))
        if entry.at_s == 0:
            changes[0] = change
        else:
            changes.append(change)
    return changes


def _change(at_s: float, what: str, conditions: NetworkConditions) -> NetworkChange:
    return NetworkChange(at_s, what, describe(conditions), conditions)


def describe(conditions: NetworkConditions) -> str:
    """Conditions in words: "loss 15 %, partition 1 2 | 3 4 5"."""
    words = [f"loss {_percent(conditions.default.loss)}"]
    words += [f"loss {_percent(link.loss)} to {vehicle}" for vehicle, link in sorted(conditions.receivers.items())]
    if conditions.partition:
        words.append("partition " + " | ".join(" ".join(map(str, sorted(group))) for group in conditions.partition))
    return ", ".join(words)


def _percent(probability: float) -> str:
    return f"{probability * 100:g} %"
