"""One run of a hunt: its document, its verdict, and the timers that ended in it.

In the liveness phase all conditions are cleared and no more events are logged; the swarm must become idle. Where it
then has several chains, whoever plays it may play it again with a final reconcile, after which there must be one.

A livelock is such a way that never ends. Those that end are near it.
"""

import json
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import NamedTuple

from harness.checker import Evidence, Result
from harness.checker.evidence import Watch
from harness.checker.recurring_cycles import cycle_of
from harness.checker.uniform_chain import common_prefix
from harness.errors import AgentFailedError
from harness.gc_pause import gc_paused
from harness.proof.coverage import Reached, Watcher
from harness.proof.coverage.reached import simulate_watched
from harness.run.simulate import ended_by
from harness.scenario import Scenario
from harness.sweep.explore._recording import Logged, record
from harness.sweep.explore._scenario_document import Document, at, cut_after, document_of, timeline, with_key
from harness.sweep.explore.guided._finding_identity import Identity, identities
from harness.sweep.explore.guided._mutation import AFTER_LAST_S, FEW_BLOCKS, Limits, with_events
from ucp.agent import ON_TIMER
from ucp.events import EVENT_HEADER_BYTES
from ucp.settings import Settings
from ucp.trigger import TimerTrigger

APPROVED = (ON_TIMER["voting"].name, "approved")
MOST = 16
"""Of a longer way only so many timers, the last, tell it from others."""

Ways = tuple[tuple[str, ...], ...]
"""Of each agent which timers ended, in order."""


class Ended(NamedTuple):
    """A timer ended, and its handler took this branch."""

    at_s: float
    agent_id: int
    timer: str
    handler: str
    branch: str


def timers_ended(evidence: Evidence) -> list[Ended]:
    """Of all agents, in order."""
    return sorted(
        Ended(run.t, agent_id, run.trigger.timer, run.handler, run.branch)
        for agent_id, trace in evidence.traces.items()
        for run in trace.runs
        if isinstance(run.trigger, TimerTrigger)
    )


def in_vain(ended: Iterable[Ended]) -> Ways:
    """The longest that agents went on without a vote that was approved; none if not at least two votes failed on it."""
    longest: Sequence[Ended] = ()
    for approved, stretch in groupby(ended, lambda each: (each.handler, each.branch) == APPROVED):
        if not approved:
            longest = max(longest, [*stretch], key=len)
    if sum(each.timer == "voting" for each in longest) < 2:
        return ()
    ways = defaultdict[int, list[str]](list)
    for each in longest[-MOST:]:
        ways[each.agent_id].append(each.timer)
    return tuple(sorted(map(tuple, ways.values())))


MOST_BLOCKS = 12
"""Runs have no more: states of many blocks are new in every run, and tell nothing."""
LAST_S = 240.0
"""Up to when blocks are completed, at least."""
CLEARED_S = 0.001
"""So long before the end of a mission the conditions are cleared."""
LONGEST_GAP_S = 40.0
"""Between two events: a round of votes and reconciles is over."""


Apart = tuple[tuple[int, int], ...]
"""Of each chain how many agents hold it, and how many of its blocks are not in all chains; in order."""


@dataclass(frozen=True)
class Tried:
    """What a run reached, and which findings it is evidence of."""

    reached: Reached
    found: tuple[Identity, ...]
    apart: Apart | None = None
    """How chains differ at rest, where nobody has been told to reconcile finally."""
    timers_ended_s: tuple[float, ...] = ()
    """When timers of agents ended, up to when conditions were cleared; in order."""
    in_vain: Ways = ()
    """How agents went on in the liveness phase while votes failed, and none was approved."""


@gc_paused()
def tried(scenario: Scenario, seed: int) -> Tried:
    """Play it. Raises HarnessError if it cannot be played."""
    watcher = Watcher()
    result, evidence = _played(scenario, seed, watcher.step)
    apart = None if scenario.final_reconcile or result.bad else _apart(result)
    found = identities(result, evidence.once(cycle_of) if evidence else None, scenario)
    if evidence is None:
        return Tried(watcher.reached, found)
    ended = timers_ended(evidence)
    moments = tuple(sorted({round(each.at_s, 3) for each in ended if each.at_s <= scenario.duration_s}))
    ways = in_vain([each for each in ended if each.at_s > scenario.duration_s])
    return Tried(watcher.reached, found, apart, moments, ways)


def _apart(result: Result) -> Apart | None:
    holders = Counter(result.chains.values())
    if len(holders) < 2:
        return None
    mutual = common_prefix([*holders])
    return tuple(sorted((agents, len(chain) - mutual) for chain, agents in holders.items()))


def found_in(scenario: Scenario, seed: int) -> tuple[Identity, ...]:
    """What the very run of the scenario shows. Raises HarnessError if it cannot be played."""
    result, evidence = _played(scenario, seed, lambda state, run: None)
    return identities(result, evidence.once(cycle_of) if evidence else None, scenario)


def _played(scenario: Scenario, seed: int, watch: Watch) -> tuple[Result, Evidence | None]:
    try:
        simulated = simulate_watched(scenario, seed, watch)
    except AgentFailedError as error:
        return ended_by(error), None
    return simulated.result, simulated.evidence


def with_liveness_phase(document: Document) -> Document:
    """The same, with all conditions cleared when the last event may be logged."""
    ends_s = float(document.get("duration_s", 1200.0))
    fates = [_until(fate, ends_s) for fate in document.get("fates", []) if fate.get("from_s", 0.0) < ends_s]
    entries = [entry for entry in timeline(document) if entry["at_s"] < ends_s - 3 * CLEARED_S]
    clear: Document = {"loss": 0.0} if at(document, "network.loss") or _loses(entries) else {}
    clear |= {"duplicate": 0.0} if at(document, "network.duplicate") else {}
    clear |= {"delay": 0.02} if isinstance(at(document, "network.delay"), dict) else {}
    if any("partition" in entry for entry in entries):
        entries.append({"at_s": round(ends_s - 2 * CLEARED_S, 6), "heal": True})
    if clear:
        entries.append({"at_s": round(ends_s - CLEARED_S, 6), "network": clear})
    entries = [_over_by(entry, ends_s - 3 * CLEARED_S) for entry in entries]
    return with_key(with_key(document, "fates", fates), "timeline", entries)


def without_liveness_phase(document: Document) -> Document:
    """The same before it had one."""
    last_s = float(document.get("duration_s", 1200.0)) - 3 * CLEARED_S
    return with_key(document, "timeline", [entry for entry in timeline(document) if entry["at_s"] < last_s])


def _loses(entries: Sequence[Document]) -> bool:
    return any("loss" in entry or "network" in entry for entry in entries)


def _over_by(entry: Document, last_s: float) -> Document:
    if "for_s" in entry and entry["at_s"] + entry["for_s"] > last_s:
        return {**entry, "for_s": max(CLEARED_S, round(last_s - entry["at_s"], 6))}
    return entry


def _until(fate: Document, ends_s: float) -> Document:
    if "arrivals" in fate:
        return fate
    return {**fate, "until_s": min(ends_s, fate.get("until_s", ends_s))}


def beginnings(scenario: Scenario, seeds: Iterable[int]) -> tuple[Limits, list[tuple[Document, int]]]:
    """Short documents to begin with, and how far changes of them may go."""
    begun, last_s = [], LAST_S
    for seed in seeds:
        completing = [event for event in record(scenario, seed).logged if event.completes]
        documents = [_as_json(_beginning(scenario, completing[:blocks])) for blocks in (FEW_BLOCKS, MOST_BLOCKS)]
        begun += [(document, seed) for document in documents]
        last_s = max(last_s, documents[-1]["duration_s"])
    return Limits(scenario.roster, MOST_BLOCKS, last_s), begun


def _as_json(document: Document) -> Document:
    """As it is when it was written and read again: numbers that are keys are text."""
    copy: Document = json.loads(json.dumps(document))
    return copy


def _beginning(scenario: Scenario, completing: Sequence[Logged]) -> Document:
    """With these blocks, each completed by one event.

    All else is as the scenario says, up to then: what happens to messages is still left to chance.
    """
    document = document_of(scenario)
    largest = at(document, "settings.max_event_bytes") or Settings().max_event_bytes
    size = min(256, largest - EVENT_HEADER_BYTES)
    events: list[Document] = []
    now, before = 1.0, completing[0].at_s if completing else 0.0
    for event in completing:
        now += min(event.at_s - before, LONGEST_GAP_S)
        before = event.at_s
        events.append({"at_s": round(now, 3), "agent": event.agent, **({} if size == 256 else {"bytes": size})})
    document = with_key(cut_after(document, now), "settings.max_block_bytes", largest)
    return with_events({**document, "duration_s": now + AFTER_LAST_S}, events)
