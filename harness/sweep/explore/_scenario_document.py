"""Represent a scenario as a document that can be reduced: its YAML keys without default values.

Each function returns a new document, and leaves the old one unchanged. The result may be an invalid scenario. The
caller detects this when it plays the scenario.
"""

from collections.abc import Callable, Collection
from typing import Any

from harness.scenario import Scenario
from harness.scenario.faults import TIMELINE_FAULTS
from harness.scenario.injection import INJECTIONS
from harness.scenario.strict_model import format_pairs, parse_pairs
from harness.sweep.explore._recording import LostMessage, RecordedEvent

Document = dict[str, Any]

UNPLAYED = ("about", "speedup", "expect")
"""Scenario keys that have no effect in virtual time, or that only make sense for the original run."""
FLIGHT = ("vehicles", "flight", "network.radio")
"""Keys about the flight of vehicles. In virtual time, their only effect is that messages are lost because of
distance.
"""
NEVER_IN_BURSTS = {"p": 0.0, "r": 1.0}
"""Parameters for the model of burst losses. A model with these parameters never loses a message, but still draws the
same random numbers as before.
"""


def document_of(scenario: Scenario) -> Document:
    document = scenario.model_dump(mode="json", exclude_defaults=True)
    document = {key: value for key, value in document.items() if key not in UNPLAYED}
    if scenario.network.radio is None:
        document = _without_flight(document)
    return {**document, "agents": list(scenario.roster)}


def with_key(document: Document, key: str, value: Any) -> Document:
    """Return the document with a new value for a key. The key is a path with dots, such as `network.loss`. If the new
    value is empty, the key is removed.
    """
    first, _, rest = key.partition(".")
    if rest:
        value = with_key(document.get(first, {}), rest, value)
    kept = {name: old for name, old in document.items() if name != first}
    return kept if value is None or value in ({}, []) else {**kept, first: value}


def at(document: Document, key: str) -> Any:
    """Return the value of a key, which is a path with dots, such as `network.loss`. Return None if the document does
    not contain the key.
    """
    value: Any = document
    for part in key.split("."):
        value = value.get(part) if isinstance(value, dict) else None
    return value


def with_script(document: Document, logged: list[RecordedEvent], drops: list[Document]) -> Document:
    """Return a document without random parts. In this document, agents log exactly the events in `logged`, and the
    network loses exactly the messages that match the rules in `drops`.
    """
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
    """Replace all delivery rules of the document that lose messages. Keep the rules with other effects."""
    others = [fate for fate in document.get("fates", []) if "drop" not in fate]
    return with_key(document, "fates", [*drops, *others])


def event_of(event: RecordedEvent) -> Document:
    size = {} if event.bytes == 256 else {"bytes": event.bytes}
    return {"at_s": event.at_s, "agent": event.agent, **size}


def fate_by_count(lost: LostMessage) -> Document:
    return {
        "message": lost.message,
        "sender": lost.sender,
        "receiver": lost.receiver,
        "count": lost.count,
        "drop": True,
    }


def fate_by_time(lost: LostMessage, slack_s: float) -> Document:
    """Return a rule that lets the network lose all messages of this type from this sender to this receiver at about
    this time. The rule contains no number of a message, so it still matches the intended message if earlier messages
    disappear from the run.
    """
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
    """Return a copy of a network change, with all message losses in the change set to zero. The change is a timeline
    entry or the repeated part of a schedule.
    """
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


def keep_agents(document: Document, kept: Collection[int]) -> Document:
    """Return the document with only these agents. All parts that mention other agents are removed."""
    document = {**document, "agents": sorted(kept)}
    document = with_key(document, "events.script", [event for event in script(document) if event["agent"] in kept])
    document = with_key(document, "fates", [fate for fate in document.get("fates", []) if _agents_in(fate) <= {*kept}])
    document = with_key(document, "timeline", [*filter(None, (_entry(entry, kept) for entry in timeline(document)))])
    schedules = [_schedule(schedule, kept) for schedule in document.get("schedule", [])]
    document = with_key(document, "schedule", [schedule for schedule in schedules if schedule])
    flights = [_filter_lists(flight, ("vehicles",), kept) for flight in document.get("flight", [])]
    document = with_key(document, "flight", [flight for flight in flights if flight["vehicles"]])
    quirks = {name: _of_kept(value, kept) for name, value in document.get("quirks", {}).items()}
    document = with_key(document, "quirks", {name: value for name, value in quirks.items() if value is not None})
    datagrams = [_datagram(datagram, kept) for datagram in document.get("datagrams", [])]
    document = with_key(document, "datagrams", [datagram for datagram in datagrams if datagram["reaches"]])
    for key in ("clocks", "lateness", "vehicles.types", "agent_command"):
        named = at(document, key) or {}
        if isinstance(named, list):  # the list applies to all agents
            continue
        document = with_key(document, key, {name: value for name, value in named.items() if int(name) in kept})
    return with_key(document, "network", _network(document.get("network", {}), kept))


def _network(network: Document, kept: Collection[int]) -> Document:
    """Return a network section with only two kinds of conditions: those of kept receivers, and those of links between
    kept agents.
    """
    receivers = {name: value for name, value in network.get("receivers", {}).items() if int(name) in kept}
    links = [_filter_lists(link, ("from", "to"), kept) for link in network.get("links", [])]
    network = with_key(network, "receivers", receivers)
    return with_key(network, "links", [link for link in links if link["from"] and link["to"]])


def _schedule(schedule: Document, kept: Collection[int]) -> Document | None:
    """Remove from a schedule all agents that are not kept, and return the result. Return None if the schedule then has
    no effect.
    """
    if "repeat" in schedule:
        repeat = _keep_network_change(schedule["repeat"], kept)
        return {**schedule, "repeat": repeat} if repeat else None
    if "network" not in schedule.get("ramp", {}):
        return schedule
    ramp = _with_networks(schedule["ramp"], lambda network: _network(network, kept))
    ramp = with_key(ramp, "network", None) if {} in ramp["network"] else ramp
    return {**schedule, "ramp": ramp} if ramp else None


def _keep_network_change(change: Document, kept: Collection[int]) -> Document:
    """Remove from a network change all agents that are not kept, and return the result. The network change belongs to a
    timeline entry or a schedule.
    """
    groups = [[agent for agent in group if agent in kept] for group in change.get("partition", [])]
    change = with_key(change, "partition", [group for group in groups if group])
    return with_key(change, "network", _network(change.get("network", {}), kept))


def _agents_in(fate: Document) -> set[int]:
    named = (fate.get("sender"), fate.get("receiver"), fate.get("block", "").partition(".")[0])
    return {int(agent) for agent in named if agent}


def _entry(entry: Document, kept: Collection[int]) -> Document | None:
    """Remove from a timeline entry all agents that are not kept, and return the result. Return None if the entry then
    has no effect.
    """
    if "partition" in entry or "network" in entry:
        entry = _keep_network_change(entry, kept)
        return entry if "partition" in entry or "network" in entry else None
    named = {sender for name in INJECTIONS if (sender := at(entry, f"{name}.sender")) is not None}
    if not named.union(at(entry, "lie.receivers") or ()) <= {*kept}:
        return None
    faults = [kind.what for kind in TIMELINE_FAULTS]
    entry = _filter_lists(entry, faults, kept)
    return entry if all(entry.get(fault) != [] for fault in faults) else None


def _datagram(datagram: Document, kept: Collection[int]) -> Document:
    """Return an injected datagram, and remove receivers that are not in `kept`. If the source of the datagram is not in
    `kept`, remove all receivers.
    """
    from_kept = datagram["source"] in kept
    reaches = {agent: at_s for agent, at_s in datagram["reaches"].items() if from_kept and int(agent) in kept}
    return {**datagram, "reaches": reaches}


def _of_kept(quirk: Any, kept: Collection[int]) -> Any:
    """Return a quirk for the kept agents only. Return None if none of its agents is kept."""
    if not isinstance(quirk, dict):
        return quirk
    quirk = _filter_lists(quirk, ("agents",), kept)
    return quirk if quirk["agents"] else None


def _filter_lists(entry: Document, keys: Collection[str], kept: Collection[int]) -> Document:
    lists = {key: [agent for agent in entry[key] if agent in kept] for key in keys if entry.get(key)}
    return {**entry, **lists}


def script(document: Document) -> list[Document]:
    events: list[Document] = at(document, "events.script") or []
    return events


def timeline(document: Document) -> list[Document]:
    entries: list[Document] = document.get("timeline", [])
    return entries


def event_times(document: Document) -> list[float]:
    """Return a sorted list of times: of all events, of all timeline entries, and of the ends of temporary changes."""
    passes = {entry["at_s"] + entry["for_s"] for entry in timeline(document) if "for_s" in entry}
    return sorted({entry["at_s"] for entry in (*script(document), *timeline(document))} | passes)


def cut_after(document: Document, last_s: float) -> Document:
    """Return the document with a mission that ends at `last_s`. Everything after this time is removed."""
    document = {**document, "duration_s": max(1.0, last_s)}
    for key in ("events.script", "timeline"):
        before = [entry for entry in at(document, key) or [] if entry["at_s"] <= last_s]
        document = with_key(document, key, [_limit_duration(entry, last_s) for entry in before])
    schedules = [schedule for schedule in document.get("schedule", []) if schedule.get("from_s", 0.0) < last_s]
    clipped = [
        {**schedule, "until_s": min(schedule["until_s"], last_s)} if "until_s" in schedule else schedule
        for schedule in schedules
    ]
    return with_key(document, "schedule", clipped)


def _limit_duration(entry: Document, last_s: float) -> Document:
    """Make a temporary change permanent if it would end after the mission second `last_s`."""
    lasts = "for_s" in entry and entry["at_s"] + entry["for_s"] > last_s
    return with_key(entry, "for_s", None) if lasts else entry


def move_times(document: Document, to: Callable[[float], float]) -> Document:
    """Return the document with other times. The function `to` returns the new time for each time in the document."""
    for key in ("events.script", "timeline"):
        document = with_key(document, key, [_move_entry_times(entry, to) for entry in at(document, key) or []])
    document = with_key(document, "fates", [_move_fate_times(fate, to) for fate in document.get("fates", [])])
    document = with_key(
        document, "datagrams", [_move_datagram_times(datagram, to) for datagram in document.get("datagrams", [])]
    )
    return {**document, "duration_s": max(1.0, to(document.get("duration_s", 1200.0)))}


def _move_fate_times(fate: Document, to: Callable[[float], float]) -> Document:
    """Change the arrival times in a delivery rule. A rule without arrival times is not changed."""
    if "arrivals" not in fate:
        return fate
    return {
        **fate,
        "arrivals": format_pairs(((number, to(at_s)) for number, at_s in parse_pairs(fate["arrivals"])), "@"),
    }


def _move_datagram_times(datagram: Document, to: Callable[[float], float]) -> Document:
    return {**datagram, "reaches": {agent: to(at_s) for agent, at_s in datagram["reaches"].items()}}


def _move_entry_times(entry: Document, to: Callable[[float], float]) -> Document:
    lasts = {"for_s": round(to(entry["at_s"] + entry["for_s"]) - to(entry["at_s"]), 6)} if "for_s" in entry else {}
    return {**entry, "at_s": to(entry["at_s"]), **lasts}
