"""Find the cycle that agents repeat forever. In virtual time, the simulation can prove the cycle. In other runs, the
traces are the evidence.

A trace shows a cycle if it ends with several repetitions of the same sequence of handler runs. In each repetition, the
chain and the numbers of blocks in deque and stack are the same. A trace shows a standstill if the agent is not idle,
but ran no handler for longer than its longest timer. The trace of an agent that makes progress shows neither a cycle
nor a standstill, because the agent changes its chain.
"""

from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

from harness.archive.run_record import Cycle, CycleStep, CycleWait
from harness.archive.traces import Trace
from harness.checker._waiting import ALL_TIMERS, longest
from harness.checker.evidence import Evidence
from harness.checker.judgement import MAX_EVIDENCE, Finding, agents
from ucp.trace import HandlerRun
from ucp.trigger import MessageTrigger

SEVERAL = 5
"""A sequence of handler runs counts as a cycle if agents repeat it at least this number of times in a row."""
LAST_RUNS = 20_000
"""Number of handler runs at the end of a trace in which the checker searches for a cycle. The limit bounds the time of
the search.
"""
COUNTED = {
    "receive_phase_1_response": ("yes", "no"),
    "receive_response_next_in_sequence": ("new candidate", "counted"),
}
"""Handlers that receive answers during a reconcile -> the branches in which the handler counts the answer."""
ALREADY = "already in progress"
"""Branch (result) of Algorithm 7, Reconcile Begin, if the agent already reconciles."""
REFUSED = ("receive_vote_add_block", "no")
ASKS = ("reconcile_phase_1", "reconcile_phase_2")
MAX_NAMED = 10
PERIOD_TOLERANCE_S = 0.01
SHORTEST_PAUSE_S = 0.05
"""Shortest pause between two handler runs that the description of a cycle mentions, in mission seconds.
"""


def cycle_of(evidence: Evidence) -> Cycle | None:
    """Return the cycle that agents repeat at the end of the run. Return None if the records show no cycle."""
    busy = evidence.busy
    if not busy:
        return None
    recorded = evidence.record.cycle if evidence.record else None
    if recorded is not None and not recorded.proven:
        recorded = None  # it came from the traces, which are searched again
    if recorded is not None and recorded.period_s is None:
        return recorded.model_copy(update={"since_s": _last_ran_s(evidence, recorded)})
    traced = _in_traces(evidence, busy, times=2 if recorded else SEVERAL)
    if recorded is None or traced is None or recorded.period_s is None or traced.period_s is None:
        return recorded or traced
    if abs(traced.period_s - recorded.period_s) > PERIOD_TOLERANCE_S:
        return recorded
    return recorded.model_copy(
        update={"since_s": traced.since_s, "periods": traced.periods, "steps": traced.steps, "waits": traced.waits}
    )


def _last_ran_s(evidence: Evidence, standstill: Cycle) -> float:
    """Return the mission second after which no agent of a standstill ran a handler. A handler run for a message that
    changed nothing does not count.
    """
    traces = [evidence.traces.get(agent_id) for agent_id in standstill.agents]
    ran_at = [runs[-1].t for trace in traces if trace is not None and (runs := _own_runs(trace))]
    return max(ran_at) if len(ran_at) == len(traces) else standstill.since_s


@dataclass(frozen=True, slots=True)
class _CyclePart:
    """The handler runs that one agent repeats in an endless cycle."""

    runs: list[HandlerRun]
    """The handler runs of one period."""
    since_s: float
    """Mission second at which the cycle began."""
    period_s: float
    """Length of one period in mission seconds."""
    times: int
    """Number of recorded repetitions."""


def _in_traces(evidence: Evidence, busy: Sequence[int], times: int) -> Cycle | None:
    rounds: dict[int, _CyclePart] = {}
    since_s, ended_at_s, connected_s = 0.0, evidence.ended_at_s, evidence.connected_since_s
    if ended_at_s is None or connected_s is None:
        return None
    for agent_id, trace in evidence.traces.items():
        runs = _own_runs(trace)
        is_busy, going_round = agent_id in busy, _round(runs, times)
        quiet_s = ended_at_s - runs[-1].t if runs else 0.0
        if not runs or (not is_busy and (going_round is None or quiet_s > going_round.period_s)):
            since_s = max(since_s, trace.chain_changed_at())
        elif is_busy and quiet_s > longest(trace, ALL_TIMERS):
            since_s = max(since_s, runs[-1].t)
        elif going_round is not None:  # also one that happens to be idle at the end: others have it reconcile
            rounds[agent_id] = going_round
            since_s = max(since_s, going_round.since_s)
        else:
            return None
    if not set(busy) <= set(evidence.traces):
        return None
    if rounds.keys().isdisjoint(busy):
        return Cycle(since_s=since_s, agents=list(busy))
    period_s = max(each.period_s for each in rounds.values())
    from_s = max(since_s, connected_s)
    seen = min(min(each.times, int((each.runs[-1].t - from_s) / each.period_s) + 1) for each in rounds.values())
    if seen < times:
        return None
    begin_s = min(each.runs[0].t for each in rounds.values())
    return Cycle(
        since_s=round(since_s, 3),
        period_s=round(period_s, 3),
        periods=seen,
        agents=sorted({*busy, *rounds}),
        steps=sorted(
            (
                CycleStep(agent_id=agent_id, after_s=round(run.t - begin_s, 3), handler=run.handler, branch=run.branch)
                for agent_id, each in rounds.items()
                for run in each.runs
            ),
            key=lambda step: step.after_s,
        ),
        waits=list(_waits(evidence, rounds, period_s)),
    )


def _own_runs(trace: Trace) -> list[HandlerRun]:
    """Return the handler runs since the agent's last restart, at most the last `LAST_RUNS`.

    Two kinds of handler runs cannot be part of a cycle and are omitted: runs for messages that changed no blocks, and
    attempts to start a reconcile during a reconcile.
    """
    start = max(trace.starts[-1] if trace.starts else 0, len(trace.runs) - LAST_RUNS)
    runs = (run for run in trace.runs[start:] if run.changes or not isinstance(run.trigger, MessageTrigger))
    return [run for run in runs if run.branch != ALREADY]


def _round(runs: Sequence[HandlerRun], times: int) -> _CyclePart | None:
    """Return the shortest sequence of handler runs that is repeated at least `times` times at the end of `runs`. Return
    None if no sequence is repeated.
    """
    keys = [_key(run) for run in reversed(runs)]
    for length, matching in enumerate(_matches(keys)):
        if length and length + matching >= times * length:
            going_round = length + matching
            period_s = runs[-1].t - runs[-1 - length].t
            if period_s > 0:
                return _CyclePart(list(runs[-length:]), runs[-going_round].t, period_s, going_round // length)
    return None


def _key(run: HandlerRun) -> tuple[object, ...]:
    state = run.state
    return run.handler, run.branch, state.top, state.chain, state.deque, state.stack, state.reconciling


def _matches(keys: Sequence[object]) -> list[int]:
    """Return the Z-function of a sequence. For each position, the Z-function compares the sequence from this position
    on with the beginning of the sequence, and counts the equal elements before the first difference.
    """
    matching = [0] * len(keys)
    left = right = 0
    for place in range(1, len(keys)):
        length = min(right - place, matching[place - left]) if place < right else 0
        while place + length < len(keys) and keys[length] == keys[place + length]:
            length += 1
        matching[place] = length
        if place + length > right:
            left, right = place, place + length
    return matching


def _waits(evidence: Evidence, rounds: dict[int, _CyclePart], period_s: float) -> Iterator[CycleWait]:
    """Yield for each agent the peers for which it waits: peers that did not answer its questions in the last period,
    and peers that rejected its blocks.
    """
    for agent_id, each in rounds.items():
        heard, refused_by = set[int](), set[int]()
        for run in reversed(evidence.traces[agent_id].runs):
            if run.t < each.runs[-1].t - period_s:
                break
            if not isinstance(run.trigger, MessageTrigger):
                continue
            if run.branch in COUNTED.get(run.handler, ()):
                heard.add(run.trigger.sender)
            elif (run.handler, run.branch) == REFUSED:
                refused_by.add(run.trigger.sender)
        asks = any(run.handler in ASKS for run in each.runs)
        silent = set(evidence.exports) - heard - {agent_id} if asks else set()
        if silent or refused_by:
            yield CycleWait(agent_id=agent_id, for_agents=sorted(silent), refused_by=sorted(refused_by))


# In words


def in_short(cycle: Cycle) -> str:
    """Return a short phrase about a cycle, such as "agents 1 and 2 have repeated the same cycle since 300 s"."""
    many = len(cycle.agents) > 1
    goes = "repeated the same cycle" if cycle.period_s is not None else "hung"
    return f"{named(cycle.agents)} {'have' if many else 'has'} {goes} since {cycle.since_s:.0f} s"


def in_words(cycle: Cycle) -> str:
    """Return a text about the cycle: its agents, its start, the evidence, and the reason why each agent waits."""
    if cycle.period_s is None:
        return f"{in_short(cycle)}: not idle, and no running timer can change this"
    every = f"every {cycle.period_s:.4g} s"
    shown = (
        f"the global state recurs {every}, and no step depends on chance"
        if cycle.proven
        else f"the same handler runs follow each other {every}, {cycle.periods} times in a row"
    )
    return "; ".join([f"{in_short(cycle)}: {shown}", *_waits_in_words(cycle.waits)])


def _waits_in_words(waits: Sequence[CycleWait]) -> Iterator[str]:
    silent = {wait.agent_id: tuple(wait.for_agents) for wait in waits if wait.for_agents}
    refused_by = {wait.agent_id: tuple(wait.refused_by) for wait in waits if wait.refused_by}
    if _each_other(silent):
        yield f"{named(silent)} ask each other in vain, because an agent that reconciles does not answer"
    else:
        for peers, alike in _alike(silent):
            yield f"{named(alike)} ask{'s' if len(alike) == 1 else ''} {named(peers)} in vain"
    if _each_other(refused_by):
        yield f"{named(refused_by)} refuse each other's blocks"
    else:
        for peers, alike in _alike(refused_by):
            yield f"{named(peers)} refuse{'s' if len(peers) == 1 else ''} the blocks of {named(alike)}"


def _each_other(peers: Mapping[int, tuple[int, ...]]) -> bool:
    return len(peers) > 1 and all(set(whom) == set(peers) - {agent_id} for agent_id, whom in peers.items())


def _alike(peers: Mapping[int, tuple[int, ...]]) -> Iterator[tuple[tuple[int, ...], list[int]]]:
    """Yield each distinct set of peers, together with the agents that wait for this set."""
    alike: dict[tuple[int, ...], list[int]] = defaultdict(list)
    for agent_id, whom in peers.items():
        alike[whom].append(agent_id)
    yield from alike.items()


def named(ids: Collection[int]) -> str:
    """Return a phrase such as "agents 1 and 2". For more than `MAX_NAMED` agents, return only their number."""
    return agents(tuple(ids)) if len(ids) <= MAX_NAMED else f"{len(ids)} agents"


def findings(cycle: Cycle) -> list[Finding]:
    """Return the handler runs of one period of each agent as findings. Agents with equal handler runs have one common
    finding.
    """
    alike: dict[str, list[int]] = defaultdict(list)
    for agent_id in cycle.agents:
        alike[_round_in_words(cycle, agent_id)].append(agent_id)
    return [
        Finding(first, f"{f'as {named(others)}, ' if others else ''}{runs}")
        for runs, (first, *others) in list(alike.items())[:MAX_EVIDENCE]
    ]


def _round_in_words(cycle: Cycle, agent_id: int) -> str:
    """Return a text that lists the handler runs of one period of an agent. The list starts after the longest pause, so
    that agents with the same cycle get the same text.
    """
    steps = [step for step in cycle.steps if step.agent_id == agent_id]
    if not steps or cycle.period_s is None:
        return f"not idle, and inactive since {cycle.since_s:.0f} s"
    before = [steps[-1].after_s - cycle.period_s, *(step.after_s for step in steps[:-1])]
    pauses = [step.after_s - at_s for step, at_s in zip(steps, before, strict=True)]
    first = pauses.index(max(pauses))
    words = "runs "
    for number in range(first, first + len(steps)):
        step, pause_s = steps[number % len(steps)], pauses[number % len(steps)]
        if number > first:
            words += f", {_pause(pause_s)} later " if pause_s >= SHORTEST_PAUSE_S else ", "
        words += step.handler + (f" ({step.branch})" if step.branch else "")
    return f"{words}; {_pause(pauses[first])} later it starts again"


def _pause(pause_s: float) -> str:
    return f"{pause_s:.0f} s" if pause_s >= 2 else f"{pause_s:.1f} s"
