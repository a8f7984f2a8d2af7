"""What the network was set to and what happened to it, from the scenario and the recorded faults."""

from collections.abc import Sequence

from markupsafe import Markup

from harness.archive.record import FaultRecord, NetworkState
from harness.present import words
from harness.report import network_strip
from harness.report.chain_tree import ranges
from harness.scenario import Scenario
from harness.scenario.network import Bursts, Loss

Change = tuple[float, float, tuple[str, float]]
"""From when to when something is so, and what, in words and as a level."""


def strip(scenario: Scenario | None, faults: Sequence[FaultRecord]) -> Markup | None:
    """The network along mission time, as the scenario asked for it; None if that is not on record."""
    if scenario is None:
        return None
    end_s = scenario.duration_s
    losses, partitions = [(0.0, end_s, _loss(scenario.network.loss))], [(0.0, end_s, ("", 0.0))]
    for entry in scenario.timeline_in_order():
        until_s = end_s if entry.for_s is None else entry.at_s + entry.for_s
        loss = entry.loss if entry.loss is not None or entry.network is None else entry.network.loss
        if loss is not None:
            losses.append((entry.at_s, until_s, _loss(loss)))
        elif entry.partition:
            text = " | ".join(", ".join(ranges(sorted(group))) for group in entry.partition)
            partitions.append((entry.at_s, until_s, (text, 1.0)))
        elif entry.heal:
            partitions.append((entry.at_s, until_s, ("", 0.0)))
    lanes = [
        ("partition", network_strip.steps(_one_after_another(partitions, end_s), end_s)),
        ("loss", network_strip.steps(_one_after_another(losses, end_s), end_s)),
    ]
    ticks = [(fault.at_s, f"{words.duration(fault.at_s)}: {fault.what}") for fault in faults]
    return network_strip.draw(lanes, ticks, end_s)


def _one_after_another(changes: list[Change], end_s: float) -> list[tuple[float, str, float]]:
    """When which of them stands; after one that passes the one that stood before."""
    steps = []
    for place, (at_s, until_s, state) in enumerate(changes):
        steps.append((at_s, *state))
        if until_s < end_s:
            beneath = (
                other_state for _, other_until_s, other_state in reversed(changes[:place]) if other_until_s > until_s
            )
            steps.append((until_s, *next(beneath, ("", 0.0))))
    return steps


def _loss(loss: Loss) -> tuple[str, float]:
    """In words, and its share of all messages in the long run."""
    if not isinstance(loss, Bursts):
        return words.percent(loss), loss
    mean = loss.loss_good if loss.p == 0 else (loss.p * loss.loss_bad + loss.r * loss.loss_good) / (loss.p + loss.r)
    return f"{words.percent(mean)} in bursts", mean


def start(states: Sequence[NetworkState]) -> str | None:
    """What the network was set to at the start, in words; None if that is not on record."""
    return states[0].detail if states else None


def faults(faults: Sequence[FaultRecord]) -> list[tuple[str, str, str]]:
    """When, what, and everything else that is known of each fault."""
    rows = []
    for fault in faults:
        details = [fault.detail] if fault.detail else []
        if fault.fully_connected is not None:
            details.append(f"fully connected: {words.value(fault.fully_connected)}")
        rows.append((words.duration(fault.at_s), fault.what, "; ".join(details)))
    return rows
