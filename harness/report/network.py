"""What the network was set to and what happened to it, from the scenario and the recorded faults."""

from operator import itemgetter
from typing import Any

from markupsafe import Markup

from harness.archive.result import agent_ids, listing, mapping, number
from harness.present import words
from harness.report import network_strip
from harness.report.chain_tree import ranges

Change = tuple[float, float, tuple[str, float]]
"""From when to when something is so, and what, in words and as a level."""


def strip(result: dict[str, Any]) -> Markup | None:
    """The network along mission time, if the scenario says how long that was."""
    scenario = mapping(result, "scenario")
    end_s = number(scenario, "duration_s")
    if not end_s or end_s <= 0:
        return None
    text, loss = _loss(mapping(scenario, "network")) or ("", 0.0)
    losses, partitions = [(0.0, end_s, (text, loss))], [(0.0, end_s, ("", 0.0))]
    entries = [(at_s, entry) for entry in listing(scenario, "timeline") if (at_s := number(entry, "at_s")) is not None]
    for at_s, entry in sorted(entries, key=itemgetter(0)):
        until_s = end_s if (for_s := number(entry, "for_s")) is None else at_s + for_s
        loss_then = _loss(mapping(entry)) or _loss(mapping(entry, "network"))
        if loss_then is not None:
            losses.append((at_s, until_s, loss_then))
        elif groups := [group for group in listing(entry, "partition") if isinstance(group, list)]:
            text = " | ".join(", ".join(ranges(agent_ids(group))) for group in groups)
            partitions.append((at_s, until_s, (text, 1.0)))
        elif mapping(entry).get("heal"):
            partitions.append((at_s, until_s, ("", 0.0)))
    lanes = [
        ("partition", network_strip.steps(_one_after_another(partitions, end_s), end_s)),
        ("loss", network_strip.steps(_one_after_another(losses, end_s), end_s)),
    ]
    ticks = [
        (at_s, f"{words.duration(at_s)}: {words.value(mapping(fault).get('what'))}")
        for fault in listing(result, "faults")
        if (at_s := number(fault, "at_s")) is not None
    ]
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


def _loss(conditions: dict[str, Any]) -> tuple[str, float] | None:
    """A loss in words, and its share of all messages in the long run."""
    loss = number(conditions, "loss")
    if loss is not None:
        return words.percent(loss), loss
    p, r = number(conditions, "loss", "p"), number(conditions, "loss", "r")
    bad, good = number(conditions, "loss", "loss_bad"), number(conditions, "loss", "loss_good")
    if p is None or r is None or bad is None or good is None or p + r <= 0:
        return None
    mean = (p * bad + r * good) / (p + r)
    return f"{words.percent(mean)} in bursts", mean


def start(result: dict[str, Any]) -> str | None:
    """What the network was set to at the start, in words; None if that is not on record."""
    states = listing(result, "network")
    detail = mapping(states[0]).get("detail") if states else None
    return words.value(detail) if detail else None


def faults(result: dict[str, Any]) -> list[tuple[str, str, str]]:
    """When, what, and everything else that is known of each fault."""
    rows = []
    for fault in listing(result, "faults"):
        at_s = number(fault, "at_s")
        known = mapping(fault) or {"what": fault}
        rest = {
            key: value
            for key, value in known.items()
            if key not in ("at_s", "what", "detail", "agents", "disk") and value is not None
        }
        details = [words.value(known["detail"])] if known.get("detail") else []
        details += [f"{words.label(key)}: {words.value(value)}" for key, value in rest.items()]
        rows.append(
            ("\u2013" if at_s is None else words.duration(at_s), words.value(known.get("what")), "; ".join(details))
        )
    return rows
