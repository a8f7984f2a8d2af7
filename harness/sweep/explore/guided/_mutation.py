"""A scenario changed by chance into another: what happens when, to whom, on which network, by which settings.

A change takes a document as it is and gives another, which need not be a scenario that can be played; who tries it
finds out. All chance is drawn from the lots that are given: equal lots make equal changes.
"""

from collections.abc import Callable, Sequence
from random import Random
from typing import NamedTuple, get_args

from harness.scenario.fates import MessageName
from harness.scenario.strict_model import in_text, numbered
from harness.sweep.explore._scenario_document import Document, at, script, timeline, with_agents, with_key
from ucp.settings import CHOICES, Settings

MOST_FATES = 12
MOST_ENTRIES = 6
"""Of its timeline."""
LINED_UP = 0.6
AFTER_LAST_S = 30.0
"""So long after its last event a changed scenario goes on: a vote and a reconcile are over."""
FEW_BLOCKS = 4
MESSAGES = get_args(MessageName)
READINGS = {name: choice.values[1:] for name, choice in CHOICES.items() if choice.is_reading}
"""Settings that choose a reading of the thesis -> their values except the default."""
TIMERS_S = tuple(
    getattr(Settings(), name) for name in ("vote_timeout_s", "phase1_timeout_s", "phase2_timeout_s", "phase3_timeout_s")
)
NEAR_S = 0.03
"""Maximum distance between two moments at which a message of the first can arrive after the second."""
DELAYS_S = (0.0, 0.06, 0.2, 1.0, 4.99, 5.02, 9.99, 10.02, 15.0, 20.0)
"""Of single messages: later than the next one, than a timer, than a round."""
LATE_S = (0.001, 0.01, 0.03, 0.06, 0.2, 0.5)
"""Of timers: later than a message, or than another timer; as late as a machine that is right may be."""

Change = Callable[[Document, Random], Document]


class Limits(NamedTuple):
    """Who may be there, how many blocks may be completed, and up to when."""

    roster: Sequence[int]
    blocks: int
    last_s: float


def changed(
    document: Document, other: Document, limits: Limits, lots: Random, timers_ended_s: Sequence[float] = ()
) -> Document:
    """One to eight changes; now and then some of another document before them, or other agents of the roster.

    `timers_ended_s` is when timers ended in the document's run.
    """
    if timers_ended_s and lots.random() < LINED_UP:
        document = _lined_up(document, timers_ended_s, lots)
    if lots.random() < 0.1:
        document = _spliced(document, other, lots)
    if lots.random() < 0.05:
        document = _others_there(document, limits.roster, lots)
    for _ in range(min(8, 1 + int(lots.expovariate(0.5)))):
        document = lots.choices(_CHANGES, _WEIGHTS)[0](document, lots)
    few = lots.random() < 0.1
    return _within(document, limits._replace(blocks=min(FEW_BLOCKS, limits.blocks)) if few else limits)


def _within(document: Document, limits: Limits) -> Document:
    """Only what the limits allow, and no longer than it takes."""
    events = [event for event in script(document) if event["at_s"] <= limits.last_s][: limits.blocks]
    last_s = max((event["at_s"] for event in events), default=0.0)
    document = with_events(document, events)
    ends_s = min(float(document["duration_s"]), last_s + AFTER_LAST_S)
    entries = [entry for entry in timeline(document) if entry["at_s"] < ends_s]
    return {**with_key(document, "timeline", entries), "duration_s": ends_s}


# Events


def _another_event(document: Document, lots: Random) -> Document:
    event = {"at_s": _moment(document, lots), "agent": lots.choice(document["agents"])}
    return with_events(document, [*script(document), event])


def _event_gone(document: Document, lots: Random) -> Document:
    events = list(script(document))
    if len(events) > 1:
        events.pop(lots.randrange(len(events)))
    return with_events(document, events)


def _event_moved(document: Document, lots: Random) -> Document:
    events = list(script(document))
    if not events:
        return document
    index = lots.randrange(len(events))
    events[index] = {**events[index], "at_s": _moment(document, lots)}
    return with_events(document, events)


def _event_of_another(document: Document, lots: Random) -> Document:
    events = list(script(document))
    if not events:
        return document
    index = lots.randrange(len(events))
    events[index] = {**events[index], "agent": lots.choice(document["agents"])}
    return with_events(document, events)


def _in_step(document: Document, lots: Random) -> Document:
    """Two agents complete a block in the same instant."""
    events = list(script(document))
    if len(events) < 2:
        return _another_event(document, lots)
    index, other = lots.sample(range(len(events)), 2)
    events[index] = {**events[index], "at_s": events[other]["at_s"]}
    if events[index]["agent"] == events[other]["agent"] and len(document["agents"]) > 1:
        others = [agent for agent in document["agents"] if agent != events[other]["agent"]]
        events[index]["agent"] = lots.choice(others)
    return with_events(document, events)


def _lined_up(document: Document, timers_ended_s: Sequence[float], lots: Random) -> Document:
    """Blocks are completed when a timer ended: those of some agents, or one that there is, or all from one on."""
    moment = lots.choice(timers_ended_s)

    def near() -> float:
        return round(max(0.5, moment + lots.choice((0.0, lots.uniform(-NEAR_S, NEAR_S)))), 3)

    events = list(script(document))
    index = lots.randrange(len(events) + 1)
    if index == len(events):
        agents = lots.sample(document["agents"], lots.randint(1, len(document["agents"])))
        return with_events(document, [*events, *({"at_s": near(), "agent": agent} for agent in agents)])
    later_s = near() - events[index]["at_s"]
    until = len(events) if lots.random() < 0.5 else index + 1
    moved = [{**event, "at_s": round(event["at_s"] + later_s, 3)} for event in events[index:until]]
    return with_events(document, [*events[:index], *moved, *events[until:]])


def with_events(document: Document, events: Sequence[Document]) -> Document:
    """With these events, in the order of time, and as long as they take."""
    ordered = sorted(events, key=lambda event: (event["at_s"], event["agent"]))
    document = {**document, "events": {"source": "scripted", **({"script": ordered} if ordered else {})}}
    last = max((event["at_s"] for event in ordered), default=0.0)
    return {**document, "duration_s": max(float(document.get("duration_s", 0.0)), last + AFTER_LAST_S)}


# Single messages, and timers


def _message_lost(document: Document, lots: Random) -> Document:
    return _with_fate(document, {**_which(document, lots), "drop": True}, lots)


def _message_late(document: Document, lots: Random) -> Document:
    return _with_fate(document, {**_which(document, lots), "delay_s": lots.choice(DELAYS_S)}, lots)


def _silence(document: Document, lots: Random) -> Document:
    """All that one agent says, or hears, is lost for a while."""
    from_s = _moment(document, lots)
    whom = {lots.choice(("sender", "receiver")): lots.choice(document["agents"])}
    until_s = round(from_s + lots.choice((1.0, 6.0, 12.0, 30.0)), 3)
    return _with_fate(document, {**whom, "from_s": from_s, "until_s": until_s, "drop": True}, lots)


def _fate_gone(document: Document, lots: Random) -> Document:
    fates = list(document.get("fates", []))
    if fates:
        fates.pop(lots.randrange(len(fates)))
    return with_key(document, "fates", fates)


def _fate_changed(document: Document, lots: Random) -> Document:
    fates = list(document.get("fates", []))
    if not fates:
        return _message_lost(document, lots)
    index = lots.randrange(len(fates))
    fates[index] = _as(fates[index], _which(document, lots))
    return with_key(document, "fates", fates)


def _as(fate: Document, which: Document) -> Document:
    """The same becomes of other messages."""
    return {**which, **{key: fate[key] for key in ("drop", "delay_s") if key in fate}}


def _with_fate(document: Document, fate: Document, lots: Random) -> Document:
    fates = list(document.get("fates", []))
    if len(fates) >= MOST_FATES:
        fates.pop(lots.randrange(len(fates)))
    fates.insert(lots.randint(0, len(fates)), fate)
    return {**document, "fates": fates}


def _which(document: Document, lots: Random) -> Document:
    """One message, to one of those who hear it or to all."""
    which: Document = {
        "message": lots.choice(MESSAGES),
        "sender": lots.choice(document["agents"]),
    }
    if lots.random() < 0.5:
        which["count"] = 1 + min(7, int(lots.expovariate(0.7)))
    else:
        which["from_s"] = _moment(document, lots)
        which["until_s"] = round(which["from_s"] + lots.choice((0.06, 0.3, 6.0)), 3)
    if lots.random() < 0.7:
        which["receiver"] = lots.choice(document["agents"])
    return which


def _timer_late(document: Document, lots: Random) -> Document:
    if document.get("agent_command"):  # only our own agents' timers can be late
        return _message_late(document, lots)
    agent = str(lots.choice(document["agents"]))
    lateness: Document = dict(document.get("lateness", {}))
    late = dict(numbered(lateness.get(agent, "")))
    late[lots.randrange(12)] = lots.choice(LATE_S)
    lateness[agent] = in_text(sorted(late.items()), "+")
    return {**document, "lateness": lateness}


def _punctual(document: Document, lots: Random) -> Document:
    lateness = dict(document.get("lateness", {}))
    if lateness:
        del lateness[lots.choice(list(lateness))]
    return with_key(document, "lateness", lateness)


# The network, and who is there


def _partition(document: Document, lots: Random) -> Document:
    agents = list(document["agents"])
    if len(agents) < 2:
        return document
    lots.shuffle(agents)
    cut = lots.randint(1, len(agents) - 1)
    groups = [sorted(agents[:cut]), sorted(agents[cut:])]
    return _with_entry(document, {"partition": groups, "for_s": lots.choice((3.0, 8.0, 12.0, 20.0, 40.0))}, lots)


def _loss_for_a_while(document: Document, lots: Random) -> Document:
    loss = lots.choice((0.2, 0.5, 0.8, 1.0))
    return _with_entry(document, {"loss": loss, "for_s": lots.choice((2.0, 6.0, 12.0, 30.0))}, lots)


def _gone(document: Document, lots: Random) -> Document:
    """An agent is lost, or its computer browns out, or it stands still for a while."""
    agent = lots.choice(document["agents"])
    what = lots.randrange(4)
    if what == 0:
        return _with_entry(document, {"kill": [agent]}, lots)
    down_s = lots.choice((0.001, 0.5, 6.0, 12.0))
    if what < 3:
        disk = "kept" if lots.random() < 0.8 else "lost"
        return _with_entry(document, {"reboot": [agent], "down_s": down_s, "disk": disk}, lots)
    paused = _with_entry(document, {"pause": [agent]}, lots)
    began_s = next((entry["at_s"] for entry in timeline(paused) if entry.get("pause") == [agent]), 0.0)
    entry = {"at_s": round(began_s + down_s, 3), "resume": [agent]}
    return {**paused, "timeline": [*timeline(paused), entry]}


def _entry_gone(document: Document, lots: Random) -> Document:
    entries = list(timeline(document))
    if entries:
        entries.pop(lots.randrange(len(entries)))
    return with_key(document, "timeline", entries)


def _entry_moved(document: Document, lots: Random) -> Document:
    entries = list(timeline(document))
    if not entries:
        return _partition(document, lots)
    index = lots.randrange(len(entries))
    entries[index] = {**entries[index], "at_s": _moment(document, lots)}
    return {**document, "timeline": entries}


def _with_entry(document: Document, entry: Document, lots: Random) -> Document:
    entries = list(timeline(document))
    if len(entries) >= MOST_ENTRIES:
        entries.pop(lots.randrange(len(entries)))
    return {**document, "timeline": [*entries, {"at_s": _moment(document, lots), **entry}]}


def _loss(document: Document, lots: Random) -> Document:
    return with_key(document, "network.loss", lots.choice((None, None, 0.1, 0.25, 0.5)))


def _latency(document: Document, lots: Random) -> Document:
    return with_key(document, "network.delay", lots.choice((None, 0.02, 0.02, {"mean_s": 0.3, "jitter_s": 0.3})))


def _twice(document: Document, lots: Random) -> Document:
    return with_key(document, "network.duplicate", lots.choice((None, 0.1, 0.5)))


def _clock(document: Document, lots: Random) -> Document:
    """An agent's clock is apart from the others', so that its blocks are older, or younger, than they are."""
    clocks = dict(document.get("clocks", {}))
    agent = str(lots.choice(document["agents"]))
    clocks.pop(agent, None)
    if lots.random() < 0.7:
        clocks[agent] = {"offset_s": lots.choice((0.5, 5.0, 30.0, 300.0))}
    return with_key(document, "clocks", clocks)


def _reading(document: Document, lots: Random) -> Document:
    name = lots.choice(list(READINGS))
    now = at(document, f"settings.{name}")
    return with_key(document, f"settings.{name}", lots.choice(READINGS[name]) if now is None else None)


def _others_there(document: Document, roster: Sequence[int], lots: Random) -> Document:
    if isinstance(document.get("agent_command"), dict) or document.get("quirks"):
        return document  # who is whose is the scenario's affair
    agents = sorted(lots.sample(list(roster), lots.randint(min(2, len(roster)), len(roster))))
    kept = [agent for agent in document["agents"] if agent in agents]
    return {**with_agents(document, kept), "agents": agents}


def _spliced(document: Document, other: Document, lots: Random) -> Document:
    """What happens in one, under the conditions of the other."""
    if document["agents"] != other["agents"]:
        return document
    for key in ("fates", "timeline", "lateness", "network", "clocks", "settings"):
        if lots.random() < 0.5:
            document = with_key(document, key, other.get(key))
    return with_events(document, script(other)) if lots.random() < 0.5 and script(other) else document


def _moment(document: Document, lots: Random) -> float:
    """When something happens, or a timer that then began ends, or somewhen between."""
    known = [event["at_s"] for event in script(document)]
    known += [entry["at_s"] for entry in timeline(document)]
    last = max(known, default=20.0)
    if not known or lots.random() < 0.25:
        return round(lots.uniform(1.0, last + 15.0), 3)
    moment = float(lots.choice(known))
    for _ in range(lots.randrange(4)):
        moment += lots.choice(TIMERS_S)
    moment += lots.choice((0.0, 0.0, 0.001, 0.01, 0.025, 0.05, 0.1, 1.0, -0.001, -0.025))
    return round(max(moment, 0.5), 3)


_CHANGES: tuple[Change, ...]
_CHANGES, _WEIGHTS = zip(
    *{
        _another_event: 8,
        _event_gone: 3,
        _event_moved: 8,
        _event_of_another: 5,
        _in_step: 8,
        _message_lost: 6,
        _message_late: 4,
        _silence: 4,
        _fate_gone: 2,
        _fate_changed: 3,
        _timer_late: 3,
        _punctual: 2,
        _partition: 5,
        _loss_for_a_while: 4,
        _gone: 3,
        _entry_gone: 1,
        _entry_moved: 3,
        _loss: 3,
        _latency: 2,
        _twice: 1,
        _clock: 4,
        _reading: 1,
    }.items(),
    strict=True,
)
