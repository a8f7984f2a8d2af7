"""Change a scenario at random: times, agents, network, single messages and settings.

A change takes a document and returns a new document. The result may be an invalid scenario, which the caller detects
when it plays the scenario. All random numbers come from `rng`, so equal generators make equal changes.
"""

from collections.abc import Callable, Sequence
from random import Random
from typing import NamedTuple, get_args

from harness.scenario.fates import MessageName
from harness.scenario.strict_model import format_pairs, parse_pairs
from harness.sweep.explore._scenario_document import Document, at, keep_agents, script, timeline, with_key
from ucp.settings import CHOICES, Settings

MOST_FATES = 12
MOST_ENTRIES = 6
"""Maximum number of entries in the timeline of a changed scenario."""
ALIGN_PROBABILITY = 0.6
AFTER_LAST_S = 30.0
"""Seconds between the last event and the end of a changed scenario, enough for a vote and a reconcile."""
FEW_BLOCKS = 4
MESSAGES = get_args(MessageName)
READINGS = {name: choice.values[1:] for name, choice in CHOICES.items() if choice.is_reading}
"""Name of a setting that chooses an interpretation of the thesis -> all values except the default."""
TIMERS_S = tuple(
    getattr(Settings(), name) for name in ("vote_timeout_s", "phase1_timeout_s", "phase2_timeout_s", "phase3_timeout_s")
)
NEAR_S = 0.03
"""Maximum number of seconds between a timer expiry and an event that a change places close to it. The messages that the
event causes may arrive before or after the timer expires.
"""
DELAYS_S = (0.0, 0.06, 0.2, 1.0, 4.99, 5.02, 9.99, 10.02, 15.0, 20.0)
"""Delays for single messages in seconds. Depending on the delay, the message arrives at once, after the next message,
after a timer expiry, or after a whole round.
"""
LATE_S = (0.001, 0.01, 0.03, 0.06, 0.2, 0.5)
"""Delays for timers in seconds. With such a delay, a timer may expire after a message or another timer that it would
otherwise precede. Even on a correct machine, timers can be late by the longest of these delays.
"""

Change = Callable[[Document, Random], Document]


class MutationLimits(NamedTuple):
    """The limits for random changes: the agents that may take part, the maximum number of blocks, and the latest time
    of a block.
    """

    roster: Sequence[int]
    blocks: int
    last_s: float


def mutate(
    document: Document, other: Document, limits: MutationLimits, rng: Random, timers_ended_s: Sequence[float] = ()
) -> Document:
    """Return the document with one to eight random changes.

    Some changes copy parts of the document `other`. `timers_ended_s` contains the times at which timers expired in the
    document's run.
    """
    if timers_ended_s and rng.random() < ALIGN_PROBABILITY:
        document = _align_with_timer(document, timers_ended_s, rng)
    if rng.random() < 0.1:
        document = _splice(document, other, rng)
    if rng.random() < 0.05:
        document = _change_agents(document, limits.roster, rng)
    for _ in range(min(8, 1 + int(rng.expovariate(0.5)))):
        document = rng.choices(_CHANGES, _WEIGHTS)[0](document, rng)
    few = rng.random() < 0.1
    return _limited(document, limits._replace(blocks=min(FEW_BLOCKS, limits.blocks)) if few else limits)


def _limited(document: Document, limits: MutationLimits) -> Document:
    """Return the document without the parts that exceed the limits. The mission ends soon after the last event."""
    events = [event for event in script(document) if event["at_s"] <= limits.last_s][: limits.blocks]
    last_s = max((event["at_s"] for event in events), default=0.0)
    document = with_events(document, events)
    ends_s = min(float(document["duration_s"]), last_s + AFTER_LAST_S)
    entries = [entry for entry in timeline(document) if entry["at_s"] < ends_s]
    return {**with_key(document, "timeline", entries), "duration_s": ends_s}


# Events


def _add_event(document: Document, rng: Random) -> Document:
    event = {"at_s": _moment(document, rng), "agent": rng.choice(document["agents"])}
    return with_events(document, [*script(document), event])


def _remove_event(document: Document, rng: Random) -> Document:
    events = list(script(document))
    if len(events) > 1:
        events.pop(rng.randrange(len(events)))
    return with_events(document, events)


def _move_event(document: Document, rng: Random) -> Document:
    events = list(script(document))
    if not events:
        return document
    index = rng.randrange(len(events))
    events[index] = {**events[index], "at_s": _moment(document, rng)}
    return with_events(document, events)


def _reassign_event(document: Document, rng: Random) -> Document:
    events = list(script(document))
    if not events:
        return document
    index = rng.randrange(len(events))
    events[index] = {**events[index], "agent": rng.choice(document["agents"])}
    return with_events(document, events)


def _align_two_events(document: Document, rng: Random) -> Document:
    """Change the document so that two agents complete a block at the same time."""
    events = list(script(document))
    if len(events) < 2:
        return _add_event(document, rng)
    index, other = rng.sample(range(len(events)), 2)
    events[index] = {**events[index], "at_s": events[other]["at_s"]}
    if events[index]["agent"] == events[other]["agent"] and len(document["agents"]) > 1:
        others = [agent for agent in document["agents"] if agent != events[other]["agent"]]
        events[index]["agent"] = rng.choice(others)
    return with_events(document, events)


def _align_with_timer(document: Document, timers_ended_s: Sequence[float], rng: Random) -> Document:
    """Change the document so that events occur at about the time of a timer expiry. The moved events are one existing
    event, or one existing event and all later events. Alternatively, the function adds new events of some agents.
    """
    moment = rng.choice(timers_ended_s)

    def near() -> float:
        return round(max(0.5, moment + rng.choice((0.0, rng.uniform(-NEAR_S, NEAR_S)))), 3)

    events = list(script(document))
    index = rng.randrange(len(events) + 1)
    if index == len(events):
        agents = rng.sample(document["agents"], rng.randint(1, len(document["agents"])))
        return with_events(document, [*events, *({"at_s": near(), "agent": agent} for agent in agents)])
    later_s = near() - events[index]["at_s"]
    until = len(events) if rng.random() < 0.5 else index + 1
    move_times = [{**event, "at_s": round(event["at_s"] + later_s, 3)} for event in events[index:until]]
    return with_events(document, [*events[:index], *move_times, *events[until:]])


def with_events(document: Document, events: Sequence[Document]) -> Document:
    """Return the document with these events in order of time. Make the mission longer if the events need it."""
    ordered = sorted(events, key=lambda event: (event["at_s"], event["agent"]))
    document = {**document, "events": {"source": "scripted", **({"script": ordered} if ordered else {})}}
    last = max((event["at_s"] for event in ordered), default=0.0)
    return {**document, "duration_s": max(float(document.get("duration_s", 0.0)), last + AFTER_LAST_S)}


# Single messages and timers


def _lose_message(document: Document, rng: Random) -> Document:
    return _with_fate(document, {**_choose_messages(document, rng), "drop": True}, rng)


def _delay_message(document: Document, rng: Random) -> Document:
    return _with_fate(document, {**_choose_messages(document, rng), "delay_s": rng.choice(DELAYS_S)}, rng)


def _silence_agent(document: Document, rng: Random) -> Document:
    """Change the document so that all messages to one agent, or from one agent, are lost for some time."""
    from_s = _moment(document, rng)
    whom = {rng.choice(("sender", "receiver")): rng.choice(document["agents"])}
    until_s = round(from_s + rng.choice((1.0, 6.0, 12.0, 30.0)), 3)
    return _with_fate(document, {**whom, "from_s": from_s, "until_s": until_s, "drop": True}, rng)


def _remove_fate(document: Document, rng: Random) -> Document:
    fates = list(document.get("fates", []))
    if fates:
        fates.pop(rng.randrange(len(fates)))
    return with_key(document, "fates", fates)


def _retarget_fate(document: Document, rng: Random) -> Document:
    fates = list(document.get("fates", []))
    if not fates:
        return _lose_message(document, rng)
    index = rng.randrange(len(fates))
    fates[index] = _with_target(fates[index], _choose_messages(document, rng))
    return with_key(document, "fates", fates)


def _with_target(fate: Document, which: Document) -> Document:
    """Return a delivery rule that has the effect of `fate` and applies to randomly chosen messages."""
    return {**which, **{key: fate[key] for key in ("drop", "delay_s") if key in fate}}


def _with_fate(document: Document, fate: Document, rng: Random) -> Document:
    fates = list(document.get("fates", []))
    if len(fates) >= MOST_FATES:
        fates.pop(rng.randrange(len(fates)))
    fates.insert(rng.randint(0, len(fates)), fate)
    return {**document, "fates": fates}


def _choose_messages(document: Document, rng: Random) -> Document:
    """Choose messages at random, and return the keys of a delivery rule for these messages. The keys select a message
    type, a sender, and a number or a time of the message. In some cases, they also select one receiver.
    """
    which: Document = {
        "message": rng.choice(MESSAGES),
        "sender": rng.choice(document["agents"]),
    }
    if rng.random() < 0.5:
        which["count"] = 1 + min(7, int(rng.expovariate(0.7)))
    else:
        which["from_s"] = _moment(document, rng)
        which["until_s"] = round(which["from_s"] + rng.choice((0.06, 0.3, 6.0)), 3)
    if rng.random() < 0.7:
        which["receiver"] = rng.choice(document["agents"])
    return which


def _delay_timer(document: Document, rng: Random) -> Document:
    if document.get("agent_command"):  # only timers of the harness's own agents can be late
        return _delay_message(document, rng)
    agent = str(rng.choice(document["agents"]))
    lateness: Document = dict(document.get("lateness", {}))
    late = dict(parse_pairs(lateness.get(agent, "")))
    late[rng.randrange(12)] = rng.choice(LATE_S)
    lateness[agent] = format_pairs(sorted(late.items()), "+")
    return {**document, "lateness": lateness}


def _undo_delay(document: Document, rng: Random) -> Document:
    lateness = dict(document.get("lateness", {}))
    if lateness:
        del lateness[rng.choice(list(lateness))]
    return with_key(document, "lateness", lateness)


# Network and agents


def _add_partition(document: Document, rng: Random) -> Document:
    agents = list(document["agents"])
    if len(agents) < 2:
        return document
    rng.shuffle(agents)
    cut = rng.randint(1, len(agents) - 1)
    groups = [sorted(agents[:cut]), sorted(agents[cut:])]
    return _with_entry(document, {"partition": groups, "for_s": rng.choice((3.0, 8.0, 12.0, 20.0, 40.0))}, rng)


def _add_temporary_loss(document: Document, rng: Random) -> Document:
    loss = rng.choice((0.2, 0.5, 0.8, 1.0))
    return _with_entry(document, {"loss": loss, "for_s": rng.choice((2.0, 6.0, 12.0, 30.0))}, rng)


def _add_agent_fault(document: Document, rng: Random) -> Document:
    """Add a fault that kills, reboots or pauses an agent."""
    agent = rng.choice(document["agents"])
    what = rng.randrange(4)
    if what == 0:
        return _with_entry(document, {"kill": [agent]}, rng)
    down_s = rng.choice((0.001, 0.5, 6.0, 12.0))
    if what < 3:
        disk = "kept" if rng.random() < 0.8 else "lost"
        return _with_entry(document, {"reboot": [agent], "down_s": down_s, "disk": disk}, rng)
    paused = _with_entry(document, {"pause": [agent]}, rng)
    began_s = next((entry["at_s"] for entry in timeline(paused) if entry.get("pause") == [agent]), 0.0)
    entry = {"at_s": round(began_s + down_s, 3), "resume": [agent]}
    return {**paused, "timeline": [*timeline(paused), entry]}


def _remove_entry(document: Document, rng: Random) -> Document:
    entries = list(timeline(document))
    if entries:
        entries.pop(rng.randrange(len(entries)))
    return with_key(document, "timeline", entries)


def _move_entry(document: Document, rng: Random) -> Document:
    entries = list(timeline(document))
    if not entries:
        return _add_partition(document, rng)
    index = rng.randrange(len(entries))
    entries[index] = {**entries[index], "at_s": _moment(document, rng)}
    return {**document, "timeline": entries}


def _with_entry(document: Document, entry: Document, rng: Random) -> Document:
    entries = list(timeline(document))
    if len(entries) >= MOST_ENTRIES:
        entries.pop(rng.randrange(len(entries)))
    return {**document, "timeline": [*entries, {"at_s": _moment(document, rng), **entry}]}


def _change_loss(document: Document, rng: Random) -> Document:
    return with_key(document, "network.loss", rng.choice((None, None, 0.1, 0.25, 0.5)))


def _change_latency(document: Document, rng: Random) -> Document:
    return with_key(document, "network.delay", rng.choice((None, 0.02, 0.02, {"mean_s": 0.3, "jitter_s": 0.3})))


def _change_duplication(document: Document, rng: Random) -> Document:
    return with_key(document, "network.duplicate", rng.choice((None, 0.1, 0.5)))


def _change_clock(document: Document, rng: Random) -> Document:
    """Set the clock of an agent to a different time than the other clocks, so that the blocks of this agent seem older
    or younger than they are.
    """
    clocks = dict(document.get("clocks", {}))
    agent = str(rng.choice(document["agents"]))
    clocks.pop(agent, None)
    if rng.random() < 0.7:
        clocks[agent] = {"offset_s": rng.choice((0.5, 5.0, 30.0, 300.0))}
    return with_key(document, "clocks", clocks)


def _change_reading(document: Document, rng: Random) -> Document:
    name = rng.choice(list(READINGS))
    now = at(document, f"settings.{name}")
    return with_key(document, f"settings.{name}", rng.choice(READINGS[name]) if now is None else None)


def _change_agents(document: Document, roster: Sequence[int], rng: Random) -> Document:
    if isinstance(document.get("agent_command"), dict) or document.get("quirks"):
        return document  # the scenario assigns programs and quirks to agents
    agents = sorted(rng.sample(list(roster), rng.randint(min(2, len(roster)), len(roster))))
    kept = [agent for agent in document["agents"] if agent in agents]
    return {**keep_agents(document, kept), "agents": agents}


def _splice(document: Document, other: Document, rng: Random) -> Document:
    """Copy randomly chosen parts from another document: delivery rules, timeline, lateness of timers, network, clocks,
    settings or events.
    """
    if document["agents"] != other["agents"]:
        return document
    for key in ("fates", "timeline", "lateness", "network", "clocks", "settings"):
        if rng.random() < 0.5:
            document = with_key(document, key, other.get(key))
    return with_events(document, script(other)) if rng.random() < 0.5 and script(other) else document


def _moment(document: Document, rng: Random) -> float:
    """Choose a mission second at random. In some cases, it can be anywhere in the mission. In the other cases, it is
    close to an event or a timeline entry, or later by the duration of one to three timers.
    """
    known = [event["at_s"] for event in script(document)]
    known += [entry["at_s"] for entry in timeline(document)]
    last = max(known, default=20.0)
    if not known or rng.random() < 0.25:
        return round(rng.uniform(1.0, last + 15.0), 3)
    moment = float(rng.choice(known))
    for _ in range(rng.randrange(4)):
        moment += rng.choice(TIMERS_S)
    moment += rng.choice((0.0, 0.0, 0.001, 0.01, 0.025, 0.05, 0.1, 1.0, -0.001, -0.025))
    return round(max(moment, 0.5), 3)


_CHANGES: tuple[Change, ...]
_CHANGES, _WEIGHTS = zip(
    *{
        _add_event: 8,
        _remove_event: 3,
        _move_event: 8,
        _reassign_event: 5,
        _align_two_events: 8,
        _lose_message: 6,
        _delay_message: 4,
        _silence_agent: 4,
        _remove_fate: 2,
        _retarget_fate: 3,
        _delay_timer: 3,
        _undo_delay: 2,
        _add_partition: 5,
        _add_temporary_loss: 4,
        _add_agent_fault: 3,
        _remove_entry: 1,
        _move_entry: 3,
        _change_loss: 3,
        _change_latency: 2,
        _change_duplication: 1,
        _change_clock: 4,
        _change_reading: 1,
    }.items(),
    strict=True,
)
