"""A scenario as a document that can be cut to pieces: what its YAML says, without what is as by default.

Every function makes a new document and leaves the old one as it is. The result need not be a scenario that can be
played; who tries it finds out.
"""

from collections.abc import Callable, Collection
from typing import Any

from harness.explore.tape import Logged, Lost
from harness.scenario import Scenario
from harness.scenario.faults import ASKED_FOR
from harness.scenario.injection import INJECTIONS

Document = dict[str, Any]

UNPLAYED = ("about", "speedup")
"""Keys that change nothing in virtual time."""
FLIGHT = ("vehicles", "flight", "network.radio")
"""Keys that say which messages are lost to distance, and nothing else in virtual time."""
NEVER_IN_BURSTS = {"p": 0.0, "r": 1.0}
"""Loss in bursts that never come: nothing is lost, and lots are drawn as with bursts that do."""


def document_of(scenario: Scenario) -> Document:
    document = scenario.model_dump(mode="json", exclude_defaults=True)
    document = {key: value for key, value in document.items() if key not in UNPLAYED}
    if scenario.network.radio is None:
        document = _without_flight(document)
    return {**document, "agents": list(scenario.roster)}


def with_key(document: Document, key: str, value: Any) -> Document:
    """`key` is a path with dots; a value that is empty, or None, takes the key out."""
    first, _, rest = key.partition(".")
    if rest:
        value = with_key(document.get(first, {}), rest, value)
    kept = {name: old for name, old in document.items() if name != first}
    return kept if value is None or value in ({}, []) else {**kept, first: value}


def at(document: Document, key: str) -> Any:
    """What stands at the path; None if nothing does."""
    value: Any = document
    for part in key.split("."):
        value = value.get(part) if isinstance(value, dict) else None
    return value


def scripted(document: Document, logged: list[Logged], drops: list[Document]) -> Document:
    """With these events and no others, and nothing lost but by these drops."""
    script = [event_of(event) for event in logged]
    document = _without_flight(document)
    network = _without_loss(document.get("network", {}))
    entries = [{**entry, **_silent(entry)} for entry in document.get("timeline", [])]
    document = with_key(with_key(document, "network", network), "timeline", [one for one in entries if len(one) > 1])
    document = with_key(document, "schedule", [_silent_schedule(one) for one in document.get("schedule", [])])
    document["events"] = {"source": "scripted", **({"script": script} if script else {})}
    return with_drops(document, drops)


def with_drops(document: Document, drops: list[Document]) -> Document:
    """With these drops instead of its own; what else it scripts stays."""
    others = [fate for fate in document.get("fates", []) if "drop" not in fate]
    return with_key(document, "fates", [*drops, *others])


def event_of(event: Logged) -> Document:
    size = {} if event.bytes == 256 else {"bytes": event.bytes}
    return {"at_s": event.at_s, "agent": event.agent, **size}


def fate_by_count(lost: Lost) -> Document:
    return {
        "message": lost.message,
        "sender": lost.sender,
        "receiver": lost.receiver,
        "count": lost.count,
        "drop": True,
    }


def fate_by_time(lost: Lost, slack_s: float) -> Document:
    """Whatever the sender says of this type at about that time: it stays the same when other messages go."""
    window = {"from_s": max(0.0, round(lost.at_s - slack_s, 3)), "until_s": round(lost.at_s + slack_s, 3)}
    return {"message": lost.message, "sender": lost.sender, "receiver": lost.receiver, **window, "drop": True}


def _without_flight(document: Document) -> Document:
    for key in FLIGHT:
        document = with_key(document, key, None)
    return document


def _without_loss(network: Document) -> Document:
    silent = {**network, **_silent(network)}
    if "receivers" in network:
        silent["receivers"] = {name: {**one, **_silent(one)} for name, one in network["receivers"].items()}
    if "links" in network:
        silent["links"] = [{**one, **_silent(one)} for one in network["links"]]
    return silent


def _silent(layer: Document) -> Document:
    if "loss" not in layer:
        return {}
    return {"loss": dict(NEVER_IN_BURSTS) if isinstance(layer["loss"], dict) else 0.0}


def _silent_schedule(schedule: Document) -> Document:
    if "ramp" in schedule and "loss" in schedule["ramp"]:
        return {**schedule, "ramp": {**schedule["ramp"], "loss": [0.0, 0.0]}}
    return (
        {**schedule, "repeat": {**schedule["repeat"], **_silent(schedule["repeat"])}}
        if "repeat" in schedule
        else schedule
    )


def with_agents(document: Document, kept: Collection[int]) -> Document:
    """Without the other agents, and all that is said of them."""
    document = {**document, "agents": sorted(kept)}
    document = with_key(document, "events.script", [one for one in script(document) if one["agent"] in kept])
    document = with_key(document, "fates", [one for one in document.get("fates", []) if _named_in(one) <= {*kept}])
    document = with_key(document, "timeline", [*filter(None, (_entry(one, kept) for one in timeline(document)))])
    document = with_key(document, "schedule", [_schedule(one, kept) for one in document.get("schedule", [])])
    flights = [_of(flight, ("vehicles",), kept) for flight in document.get("flight", [])]
    document = with_key(document, "flight", [flight for flight in flights if flight["vehicles"]])
    for key in ("clocks", "network.receivers", "vehicles.types"):
        named = at(document, key) or {}
        document = with_key(document, key, {name: value for name, value in named.items() if int(name) in kept})
    links = [_of(link, ("from", "to"), kept) for link in at(document, "network.links") or []]
    return with_key(document, "network.links", [link for link in links if link["from"] and link["to"]])


def _schedule(schedule: Document, kept: Collection[int]) -> Document:
    if "partition" not in schedule.get("repeat", {}):
        return schedule
    groups = [[agent for agent in group if agent in kept] for group in schedule["repeat"]["partition"]]
    return {**schedule, "repeat": {**schedule["repeat"], "partition": [group for group in groups if group]}}


def _named_in(fate: Document) -> set[int]:
    named = (fate.get("sender"), fate.get("receiver"), fate.get("block", "").partition(".")[0])
    return {int(agent) for agent in named if agent}


def _entry(entry: Document, kept: Collection[int]) -> Document | None:
    """A timeline entry that speaks of these agents only; None if nothing is left of it."""
    if "partition" in entry:
        groups = [[agent for agent in group if agent in kept] for group in entry["partition"]]
        groups = [group for group in groups if group]
        return {**entry, "partition": groups} if groups else None
    if not {sender for name in INJECTIONS if (sender := at(entry, f"{name}.sender")) is not None} <= {*kept}:
        return None
    faults = [kind.what for kind in ASKED_FOR]
    entry = _of(entry, faults, kept)
    return entry if all(entry.get(fault) != [] for fault in faults) else None


def _of(entry: Document, keys: Collection[str], kept: Collection[int]) -> Document:
    lists = {key: [agent for agent in entry[key] if agent in kept] for key in keys if entry.get(key)}
    return {**entry, **lists}


def script(document: Document) -> list[Document]:
    events: list[Document] = at(document, "events.script") or []
    return events


def timeline(document: Document) -> list[Document]:
    entries: list[Document] = document.get("timeline", [])
    return entries


def instants(document: Document) -> list[float]:
    """When anything is logged or changed, in order."""
    return sorted({one["at_s"] for one in (*script(document), *timeline(document))})


def cut_after(document: Document, last_s: float) -> Document:
    """Over at `last_s`, and without what would come later."""
    document = {**document, "duration_s": max(1.0, last_s)}
    for key in ("events.script", "timeline"):
        document = with_key(document, key, [one for one in at(document, key) or [] if one["at_s"] <= last_s])
    schedule = [one for one in document.get("schedule", []) if one.get("from_s", 0.0) < last_s]
    clipped = [{**one, "until_s": min(one["until_s"], last_s)} if "until_s" in one else one for one in schedule]
    return with_key(document, "schedule", clipped)


def moved(document: Document, to: Callable[[float], float]) -> Document:
    """Everything that happens happens at another time."""
    for key in ("events.script", "timeline"):
        document = with_key(document, key, [{**one, "at_s": to(one["at_s"])} for one in at(document, key) or []])
    return {**document, "duration_s": max(1.0, to(document.get("duration_s", 1200.0)))}
