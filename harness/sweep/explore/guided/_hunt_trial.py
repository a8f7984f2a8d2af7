"""Play one run of a search, and return its coverage, its findings and the timers that expired in it.

In the liveness phase at the end of the run, all network conditions are removed and agents log no more events. The swarm
must then become idle. If it has several different chains, the run may be played again with a final reconcile, after
which all chains must be equal.

In a livelock, agents repeat a pattern of failed votes forever. The hunt prefers runs with long patterns of failed
votes, because they are close to a livelock.

The identity of a finding does not depend on the run. It consists of the verdict, the handler, and the form of the
endless cycle.
"""

import dataclasses
import json
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import NamedTuple

from harness.archive.run_record import Cycle
from harness.checker import Evidence, Result
from harness.checker.judgement import Judgement
from harness.checker.recurring_cycles import cycle_of
from harness.checker.uniform_chain import common_prefix
from harness.errors import INCOMPLETE
from harness.gc_pause import gc_paused
from harness.proof.coverage import CoverageWatcher, ReachedStates
from harness.proof.coverage.reached import simulate_watched
from harness.scenario import Scenario
from harness.scenario.verdict_names import CHARACTERISTICS, ENDED
from harness.sweep.explore._recording import RecordedEvent, record
from harness.sweep.explore._scenario_document import Document, at, cut_after, document_of, timeline, with_key
from harness.sweep.explore.guided._mutation import AFTER_LAST_S, FEW_BLOCKS, MutationLimits, with_events
from ucp.agent import ON_TIMER
from ucp.events import EVENT_HEADER_BYTES
from ucp.settings import Settings
from ucp.trigger import TimerTrigger

CAUSED_BY_LIVELOCK = frozenset(("5", "6"))
"""Characteristics that every livelock violates, because agents in a livelock commit no further blocks."""
TIMERS = {ON_TIMER[timer].name: timer for timer in ("voting", "phase one", "phase two", "phase three")}
"""Name of the handler of a timer expiry -> name of the timer."""
ORDER = [*TIMERS.values()]
MAX_FORM = 250
"""Maximum number of characters in the description of a cycle. A longer description is omitted."""
SIZE_SETTINGS = frozenset(("max_block_bytes", "max_event_bytes"))


@dataclass(frozen=True, order=True)
class FindingIdentity:
    """The properties that identify a finding. If two runs give findings with equal properties, both are the same
    finding.
    """

    key: str
    """The key of the check with a bad verdict."""
    verdict: str
    handler: str = ""
    """The handler that the evidence names. Empty if the evidence names no handler."""
    shape: str = ""

    def __str__(self) -> str:
        name = f"characteristic {self.key}" if self.key in CHARACTERISTICS else self.key
        return ", ".join(part for part in (f"{name} {self.verdict}", self.handler, self.shape) if part)


def identities(result: Result, cycle: Cycle | None, scenario: Scenario) -> tuple[FindingIdentity, ...]:
    """Return the identity of the finding for each bad verdict. An identity also contains the settings that differ from
    the thesis. If the run has an endless cycle, the verdicts in `CAUSED_BY_LIVELOCK` are no separate findings.
    """
    settings = _changed_settings(scenario.settings)
    return tuple(
        FindingIdentity(
            key,
            judgement.verdict,
            next((finding.handler for finding in judgement.evidence if finding.handler), ""),
            ", ".join(part for part in (_shape(key, judgement, result, cycle), settings) if part),
        )
        for key, judgement in ((key, result.judgements[key]) for key in result.wrong)
        if cycle is None or key not in CAUSED_BY_LIVELOCK
    )


def _changed_settings(settings: Settings) -> str:
    default = Settings()
    values = {field.name: getattr(settings, field.name) for field in dataclasses.fields(settings)}
    changed = {name: value for name, value in values.items() if value != getattr(default, name)}
    return ", ".join(f"{name} {value}" for name, value in changed.items() if name not in SIZE_SETTINGS)


def _shape(key: str, judgement: Judgement, result: Result, cycle: Cycle | None) -> str:
    if key == ENDED:
        return ", ".join(sorted({finding.detail.partition(":")[0] for finding in judgement.evidence}))
    if key == "6":
        holders = sorted(Counter(result.chains.values()).values(), reverse=True)
        return f"chains of {', '.join(map(str, holders))} agents"
    if key != "liveness" or cycle is None:
        return ""
    going = f"{len(cycle.agents)} agent{'s' if len(cycle.agents) > 1 else ''}"
    if cycle.period_s is None:
        return f"{going} standing still"
    form = "; ".join(_form(cycle))
    return f"{going} going round every {cycle.period_s:.0f} s" + (f" ({form})" if len(form) <= MAX_FORM else "")


def _form(cycle: Cycle) -> list[str]:
    """Return the sequences of timers that agents repeat in an endless cycle, without duplicates. The command `prove`
    uses the same form to compare livelocks.
    """
    patterns = defaultdict[int, list[str]](list)
    for step in cycle.steps:
        if step.handler in TIMERS:
            patterns[step.agent_id].append(TIMERS[step.handler])
    return sorted({", ".join(_one_repetition(pattern)) for pattern in patterns.values()})


def _one_repetition(pattern: Sequence[str]) -> Sequence[str]:
    """Return one period of a repeating sequence of timers. The period starts with the vote timer if it contains one."""
    length = len(pattern)
    divisors = (part for part in range(1, length + 1) if length % part == 0)
    once = next(part for part in divisors if [*pattern[:part]] * (length // part) == pattern)
    rotations = ([*pattern[start:once], *pattern[:start]] for start in range(once))
    return min(rotations, key=lambda rotation: [*map(ORDER.index, rotation)])


APPROVED = (ON_TIMER["voting"].name, "approved")
MOST = 16
"""Maximum number of timers in a pattern. If a pattern is longer, only its last timers are kept."""

TimerPatterns = tuple[tuple[str, ...], ...]
"""The timers that expired in each agent, in order of time."""


class TimerEnd(NamedTuple):
    """The expiry of a timer, with the branch that the handler of this expiry took."""

    at_s: float
    agent_id: int
    timer: str
    handler: str
    branch: str


def timers_ended(evidence: Evidence) -> list[TimerEnd]:
    """Return the timer expiries of all agents, in order of time."""
    return sorted(
        TimerEnd(run.t, agent_id, run.trigger.timer, run.handler, run.branch)
        for agent_id, trace in evidence.traces.items()
        for run in trace.runs
        if isinstance(run.trigger, TimerTrigger)
    )


def failed_votes(timer_ends: Iterable[TimerEnd]) -> TimerPatterns:
    """Return the longest sequence of timer expiries in which no vote was approved, as one list for each agent. The
    result is empty if fewer than two votes failed in the sequence.
    """
    longest: Sequence[TimerEnd] = ()
    for approved, stretch in groupby(timer_ends, lambda each: (each.handler, each.branch) == APPROVED):
        if not approved:
            longest = max(longest, [*stretch], key=len)
    if sum(each.timer == "voting" for each in longest) < 2:
        return ()
    patterns = defaultdict[int, list[str]](list)
    for each in longest[-MOST:]:
        patterns[each.agent_id].append(each.timer)
    return tuple(sorted(map(tuple, patterns.values())))


MOST_BLOCKS = 12
"""Maximum number of blocks of a run. With more blocks, nearly every run reaches new states, so new states would say
nothing about the value of a run.
"""
LAST_S = 240.0
"""Latest mission second at which a changed scenario may complete a block. If an initial document lasts longer, its
duration is the limit instead.
"""
CLEARED_S = 0.001
"""Seconds between the removal of all network conditions and the end of the mission."""
LONGEST_GAP_S = 40.0
"""Maximum number of seconds between two events. A vote or a reconcile takes less time than this."""


Divergence = tuple[tuple[int, int], ...]
"""The differences between the chains of a swarm: one pair for each different chain, sorted. A pair contains the number
of agents that hold the chain, and the number of its blocks that are not common to all chains.
"""


@dataclass(frozen=True)
class PlayedRun:
    """The coverage of a run, and the findings of the run."""

    reached: ReachedStates
    found: tuple[FindingIdentity, ...]
    divergence: Divergence | None = None
    """The differences between the chains of the idle swarm. None if the run has a final reconcile or a bad verdict, or
    if all chains are equal.
    """
    timers_ended_s: tuple[float, ...] = ()
    """The times of the timer expiries before the liveness phase, in order. The liveness phase is the end of the run, in
    which the swarm can become idle.
    """
    failed_votes: TimerPatterns = ()
    """The longest pattern of failed votes in the liveness phase (the end of the run, in which the swarm can become
    idle).
    """
    unfinished: bool = False
    """True if the run has no bad result, and the swarm only needed more time."""


@gc_paused()
def play_trial(scenario: Scenario, seed: int) -> PlayedRun:
    """Run a scenario, and return the result. Raises HarnessError if the scenario cannot be run."""
    watcher = CoverageWatcher()
    simulated = simulate_watched(scenario, seed, watcher.step)
    result, evidence = simulated.result, simulated.evidence
    divergence = None if scenario.final_reconcile or result.bad else _known_divergences(result)
    found = identities(result, evidence.cached(cycle_of), scenario)
    timer_ends = timers_ended(evidence)
    moments = tuple(sorted({round(each.at_s, 3) for each in timer_ends if each.at_s <= scenario.duration_s}))
    patterns = failed_votes([each for each in timer_ends if each.at_s > scenario.duration_s])
    unfinished = result.exit_status == INCOMPLETE
    return PlayedRun(watcher.reached, found, divergence, moments, patterns, unfinished)


def _known_divergences(result: Result) -> Divergence | None:
    holders = Counter(result.chains.values())
    if len(holders) < 2:
        return None
    mutual = common_prefix([*holders])
    return tuple(sorted((agents, len(chain) - mutual) for chain, agents in holders.items()))


def findings_of(scenario: Scenario, seed: int) -> tuple[FindingIdentity, ...]:
    """Return the findings of a run. Raises HarnessError if the scenario cannot be played."""
    simulated = simulate_watched(scenario, seed, lambda state, run: None)
    return identities(simulated.result, simulated.evidence.cached(cycle_of), scenario)


def with_liveness_phase(document: Document) -> Document:
    """Return the document with additional timeline entries, which remove all network conditions at the end of the
    mission. The swarm can then become idle.
    """
    ends_s = float(document.get("duration_s", 1200.0))
    fates = [_ending_at(fate, ends_s) for fate in document.get("fates", []) if fate.get("from_s", 0.0) < ends_s]
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
    """Return the document without the timeline entries that `with_liveness_phase` added."""
    last_s = float(document.get("duration_s", 1200.0)) - 3 * CLEARED_S
    return with_key(document, "timeline", [entry for entry in timeline(document) if entry["at_s"] < last_s])


def _loses(entries: Sequence[Document]) -> bool:
    return any("loss" in entry or "network" in entry for entry in entries)


def _over_by(entry: Document, last_s: float) -> Document:
    if "for_s" in entry and entry["at_s"] + entry["for_s"] > last_s:
        return {**entry, "for_s": max(CLEARED_S, round(last_s - entry["at_s"], 6))}
    return entry


def _ending_at(fate: Document, ends_s: float) -> Document:
    if "arrivals" in fate:
        return fate
    return {**fate, "until_s": min(ends_s, fate.get("until_s", ends_s))}


def initial_documents(scenario: Scenario, seeds: Iterable[int]) -> tuple[MutationLimits, list[tuple[Document, int]]]:
    """Return two results: the limits for random changes, and short documents with which the search begins."""
    initial, last_s = [], LAST_S
    for seed in seeds:
        completing = [event for event in record(scenario, seed).logged if event.completes]
        documents = [_as_json(_initial_document(scenario, completing[:blocks])) for blocks in (FEW_BLOCKS, MOST_BLOCKS)]
        initial += [(document, seed) for document in documents]
        last_s = max(last_s, documents[-1]["duration_s"])
    return MutationLimits(scenario.roster, MOST_BLOCKS, last_s), initial


def _as_json(document: Document) -> Document:
    """Return the document as it would be after it was written to a JSON file and read again. Keys that are numbers
    become texts.
    """
    copy: Document = json.loads(json.dumps(document))
    return copy


def _initial_document(scenario: Scenario, completing: Sequence[RecordedEvent]) -> Document:
    """Return a document that completes these blocks, each with a single event. All other parts come from the scenario,
    so message losses and latencies stay random.
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
