"""A scenario as a document that can be cut to pieces: what its YAML says, without what is as by default.

Every function makes a new document and leaves the old one as it is. The result need not be a scenario that can be
played; who tries it finds out.
"""

from collections.abc import Callable, Collection
from typing import Any

from harness.scenario import Scenario
from harness.scenario.faults import ASKED_FOR
from harness.scenario.injection import INJECTIONS
from harness.scenario.strict_model import in_text, numbered
from harness.sweep.explore._recording import Logged, Lost

Document = dict[str, Any]

UNPLAYED = ("about", "speedup", "expect")
"""Keys that change nothing in virtual time, or that are of a run that is not smaller."""
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
    entries = [_silent_change(entry) for entry in document.get("timeline", [])]
    document = with_key(
        with_key(document, "network", network), "timeline", [entry for entry in entries if len(entry) > 1]
    )
    document = with_key(document, "schedule", [_silent_schedule(schedule) for schedule in document.get("schedule", [])])
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
        silent["receivers"] = {
            name: {**receiver, **_silent(receiver)} for name, receiver in network["receivers"].items()
        }
    if "links" in network:
        silent["links"] = [{**link, **_silent(link)} for link in network["links"]]
    return silent


def _silent(layer: Document) -> Document:
    if "loss" not in layer:
        return {}
    return {"loss": dict(NEVER_IN_BURSTS) if isinstance(layer["loss"], dict) else 0.0}


def _silent_change(change: Document) -> Document:
    """Of a timeline entry, or what a schedule repeats."""
    silent = {**change, **_silent(change)}
    return {**silent, "network": _without_loss(change["network"])} if "network" in change else silent


def _silent_schedule(schedule: Document) -> Document:
    if "repeat" in schedule:
        return {**schedule, "repeat": _silent_change(schedule["repeat"])}
    if "ramp" not in schedule:
        return schedule
    ramp = {**schedule["ramp"], **({"loss": [0.0, 0.0]} if "loss" in schedule["ramp"] else {})}
    return {**schedule, "ramp": _with_networks(ramp, _without_loss)}


def _with_networks(ramp: Document, change: Callable[[Document], Document]) -> Document:
    return {**ramp, "network": [change(network) for network in ramp["network"]]} if "network" in ramp else ramp


def with_agents(document: Document, kept: Collection[int]) -> Document:
    """Without the other agents, and all that is said of them."""
    document = {**document, "agents": sorted(kept)}
    document = with_key(document, "events.script", [event for event in script(document) if event["agent"] in kept])
    document = with_key(document, "fates", [fate for fate in document.get("fates", []) if _named_in(fate) <= {*kept}])
    document = with_key(document, "timeline", [*filter(None, (_entry(entry, kept) for entry in timeline(document)))])
    schedules = [_schedule(schedule, kept) for schedule in document.get("schedule", [])]
    document = with_key(document, "schedule", [schedule for schedule in schedules if schedule])
    flights = [_of(flight, ("vehicles",), kept) for flight in document.get("flight", [])]
    document = with_key(document, "flight", [flight for flight in flights if flight["vehicles"]])
    quirks = {name: _of_kept(value, kept) for name, value in document.get("quirks", {}).items()}
    document = with_key(document, "quirks", {name: value for name, value in quirks.items() if value is not None})
    datagrams = [_datagram(datagram, kept) for datagram in document.get("datagrams", [])]
    document = with_key(document, "datagrams", [datagram for datagram in datagrams if datagram["reaches"]])
    for key in ("clocks", "lateness", "vehicles.types", "agent_command"):
        named = at(document, key) or {}
        if isinstance(named, list):  # of all agents
            continue
        document = with_key(document, key, {name: value for name, value in named.items() if int(name) in kept})
    return with_key(document, "network", _network(document.get("network", {}), kept))


def _network(network: Document, kept: Collection[int]) -> Document:
    """What it says of all, and of these agents."""
    receivers = {name: value for name, value in network.get("receivers", {}).items() if int(name) in kept}
    links = [_of(link, ("from", "to"), kept) for link in network.get("links", [])]
    network = with_key(network, "receivers", receivers)
    return with_key(network, "links", [link for link in links if link["from"] and link["to"]])


def _schedule(schedule: Document, kept: Collection[int]) -> Document | None:
    """A schedule that speaks of these agents only; None if nothing is left of it."""
    if "repeat" in schedule:
        repeat = _disturbance(schedule["repeat"], kept)
        return {**schedule, "repeat": repeat} if repeat else None
    if "network" not in schedule.get("ramp", {}):
        return schedule
    ramp = _with_networks(schedule["ramp"], lambda network: _network(network, kept))
    ramp = with_key(ramp, "network", None) if {} in ramp["network"] else ramp
    return {**schedule, "ramp": ramp} if ramp else None


def _disturbance(change: Document, kept: Collection[int]) -> Document:
    """What a timeline entry or a schedule makes of the network, among these agents."""
    groups = [[agent for agent in group if agent in kept] for group in change.get("partition", [])]
    change = with_key(change, "partition", [group for group in groups if group])
    return with_key(change, "network", _network(change.get("network", {}), kept))


def _named_in(fate: Document) -> set[int]:
    named = (fate.get("sender"), fate.get("receiver"), fate.get("block", "").partition(".")[0])
    return {int(agent) for agent in named if agent}


def _entry(entry: Document, kept: Collection[int]) -> Document | None:
    """A timeline entry that speaks of these agents only; None if nothing is left of it."""
    if "partition" in entry or "network" in entry:
        entry = _disturbance(entry, kept)
        return entry if "partition" in entry or "network" in entry else None
    named = {sender for name in INJECTIONS if (sender := at(entry, f"{name}.sender")) is not None}
    if not named.union(at(entry, "lie.receivers") or ()) <= {*kept}:
        return None
    faults = [kind.what for kind in ASKED_FOR]
    entry = _of(entry, faults, kept)
    return entry if all(entry.get(fault) != [] for fault in faults) else None


def _datagram(datagram: Document, kept: Collection[int]) -> Document:
    """One that reaches these agents only; nobody, if it is from another."""
    from_kept = datagram["source"] in kept
    reaches = {agent: at_s for agent, at_s in datagram["reaches"].items() if from_kept and int(agent) in kept}
    return {**datagram, "reaches": reaches}


def _of_kept(quirk: Any, kept: Collection[int]) -> Any:
    """A quirk of all agents, or of those that are left; None if none of its agents is."""
    if not isinstance(quirk, dict):
        return quirk
    quirk = _of(quirk, ("agents",), kept)
    return quirk if quirk["agents"] else None


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
    """When anything is logged or changed, or a change of the network passes, in order."""
    passes = {entry["at_s"] + entry["for_s"] for entry in timeline(document) if "for_s" in entry}
    return sorted({entry["at_s"] for entry in (*script(document), *timeline(document))} | passes)


def cut_after(document: Document, last_s: float) -> Document:
    """Over at `last_s`, and without what would come later."""
    document = {**document, "duration_s": max(1.0, last_s)}
    for key in ("events.script", "timeline"):
        before = [entry for entry in at(document, key) or [] if entry["at_s"] <= last_s]
        document = with_key(document, key, [_over_by(entry, last_s) for entry in before])
    schedules = [schedule for schedule in document.get("schedule", []) if schedule.get("from_s", 0.0) < last_s]
    clipped = [
        {**schedule, "until_s": min(schedule["until_s"], last_s)} if "until_s" in schedule else schedule
        for schedule in schedules
    ]
    return with_key(document, "schedule", clipped)


def _over_by(entry: Document, last_s: float) -> Document:
    """What would pass later stays to the end."""
    lasts = "for_s" in entry and entry["at_s"] + entry["for_s"] > last_s
    return with_key(entry, "for_s", None) if lasts else entry


def moved(document: Document, to: Callable[[float], float]) -> Document:
    """Everything that happens happens at another time."""
    for key in ("events.script", "timeline"):
        document = with_key(document, key, [_moved(entry, to) for entry in at(document, key) or []])
    document = with_key(document, "fates", [_moved_fate(fate, to) for fate in document.get("fates", [])])
    document = with_key(document, "datagrams", [_moved_datagram(heard, to) for heard in document.get("datagrams", [])])
    return {**document, "duration_s": max(1.0, to(document.get("duration_s", 1200.0)))}


def _moved_fate(fate: Document, to: Callable[[float], float]) -> Document:
    """Of fates those whose messages arrive at given times; the windows of others are as they are."""
    if "arrivals" not in fate:
        return fate
    return {**fate, "arrivals": in_text(((number, to(at_s)) for number, at_s in numbered(fate["arrivals"])), "@")}


def _moved_datagram(datagram: Document, to: Callable[[float], float]) -> Document:
    return {**datagram, "reaches": {agent: to(at_s) for agent, at_s in datagram["reaches"].items()}}


def _moved(entry: Document, to: Callable[[float], float]) -> Document:
    lasts = {"for_s": round(to(entry["at_s"] + entry["for_s"]) - to(entry["at_s"]), 6)} if "for_s" in entry else {}
    return {**entry, "at_s": to(entry["at_s"]), **lasts}
