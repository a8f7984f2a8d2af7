"""What the network was set to and what happened to it, from the scenario and the recorded faults."""

from typing import Any

from markupsafe import Markup

from harness.report import network_strip, words
from harness.report.chain_tree import ranges
from harness.report.result import agent_ids, listing, mapping, number


def strip(result: dict[str, Any]) -> Markup | None:
    """The network along mission time, if the scenario says how long that was."""
    scenario = mapping(result, "scenario")
    end_s = number(scenario, "duration_s")
    if not end_s or end_s <= 0:
        return None
    loss = number(scenario, "network", "loss") or 0.0
    losses, partitions = [(0.0, words.percent(loss), loss)], [(0.0, "", 0.0)]
    for entry in listing(scenario, "timeline"):
        at_s, loss_then = number(entry, "at_s"), number(entry, "loss")
        if at_s is None:
            continue
        if loss_then is not None:
            losses.append((at_s, words.percent(loss_then), loss_then))
        elif groups := [group for group in listing(entry, "partition") if isinstance(group, list)]:
            text = " | ".join(", ".join(ranges(agent_ids(group))) for group in groups)
            partitions.append((at_s, text, 1.0))
        elif mapping(entry).get("heal"):
            partitions.append((at_s, "", 0.0))
    lanes = [
        ("partition", network_strip.steps(partitions, end_s)),
        ("loss", network_strip.steps(losses, end_s)),
    ]
    ticks = [
        (at_s, f"{words.duration(at_s)}: {words.value(mapping(fault).get('what'))}")
        for fault in listing(result, "faults")
        if (at_s := number(fault, "at_s")) is not None
    ]
    return network_strip.draw(lanes, ticks, end_s)


def start(result: dict[str, Any]) -> list[str]:
    """What the network was set to at the start, in a few words each."""
    network = mapping(result, "scenario", "network")
    loss = number(network, "loss")
    facts = [] if loss is None else [f"{words.percent(loss)} loss at every receiver"]
    for receiver in mapping(network, "receivers"):
        conditions = mapping(network, "receivers", receiver).items()
        facts.append(f"receiver {receiver}: " + ", ".join(f"{words.label(k)} {words.value(v)}" for k, v in conditions))
    others = {key: value for key, value in network.items() if key not in ("loss", "receivers") and value is not None}
    return facts + [f"{words.label(key)} {words.value(value)}" for key, value in others.items()]


def faults(result: dict[str, Any]) -> list[tuple[str, str, str]]:
    """When, what, and everything else that is known of each fault."""
    rows = []
    for fault in listing(result, "faults"):
        at_s = number(fault, "at_s")
        known = mapping(fault) or {"what": fault}
        rest = {
            key: value for key, value in known.items() if key not in ("at_s", "what", "detail") and value is not None
        }
        details = [words.value(known["detail"])] if known.get("detail") else []
        details += [f"{words.label(key)}: {words.value(value)}" for key, value in rest.items()]
        rows.append(
            ("\u2013" if at_s is None else words.duration(at_s), words.value(known.get("what")), "; ".join(details))
        )
    return rows
