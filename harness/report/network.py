"""What the network was set to, what it did, and what happened to it, as it is on record."""

from collections.abc import Sequence

from markupsafe import Markup

from harness.archive.connectivity import Connectivity, Losses
from harness.archive.record import FaultRecord, NetworkState
from harness.present import words
from harness.report import network_strip
from harness.report.map_parts import divisions


def strip(network: Connectivity, faults: Sequence[FaultRecord], end_s: float) -> Markup | None:
    """What the network did up to `end_s`, as it is on record; None if it is not."""
    if not network.states:
        return None
    partitions = [
        (division.at_s, *(("", 0.0) if division.together else (division.in_words(), 1.0)))
        for division in divisions(network.states)
    ]
    losses = [(losses.at_s, _in_words(losses), losses.mean) for losses in network.losses]
    lanes = [
        ("partition", network_strip.steps(partitions, end_s)),
        ("loss", network_strip.steps(losses, end_s)),
    ]
    ticks = [(fault.at_s, f"{words.duration(fault.at_s)}: {fault.what}") for fault in faults]
    return network_strip.draw(lanes, ticks, end_s)


def _in_words(losses: Losses) -> str:
    mean, worst = words.percent(losses.mean), words.percent(losses.worst)
    return mean if mean == worst else f"{mean}, the worst link {worst}"


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
