"""Check that each trace is consistent, and that each export equals the state at the end of its trace.

An export contains the time at which it was written. The agent's state at this time follows from the trace. The top
chain hash of the state covers all blocks of the chain and their order.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Iterator
from dataclasses import astuple

from harness.archive.exports import Export
from harness.archive.traces import Trace
from harness.checker._trace_replay import ReplayedIncarnation, TraceObservation
from harness.checker.evidence import Evidence
from harness.checker.judgement import Finding
from harness.checker.records.contradiction import ROUNDED_S, Contradiction, mission_s, of_agent, slack_s
from ucp.trace import StateSummary

FIELDS = {
    "chain": "blocks in the chain",
    "deque": "blocks to be committed",
    "stack": "blocks on the reconcile stack",
    "reconciling": "reconciling",
    "idle": "idle",
    "top": "top chain hash",
}


def compare_export(evidence: Evidence) -> Iterator[Contradiction]:
    """Yield each export whose blocks, or their order, differ from the state at the end of the agent's trace."""
    for agent_id, export in evidence.exports.items():
        trace = evidence.traces.get(agent_id)
        if trace is None or trace.problem:
            continue
        state, incarnations = _state(export), evidence.incarnations[agent_id]
        if incarnations[-1].runs and state == incarnations[-1].runs[-1].state:
            yield from _contents(agent_id, export, incarnations[-1])
        elif state not in _states_when(export, trace):
            yield _difference(agent_id, "its export", state, _last_state(incarnations, export), short=True)
    for agent_id, export in evidence.before_final_reconcile.items():
        yield from _before_final_reconcile(evidence, agent_id, export)


def _before_final_reconcile(evidence: Evidence, agent_id: int, export: Export) -> Iterator[Contradiction]:
    what = "its export before the final reconcile"
    if evidence.roster is not None and agent_id not in evidence.roster:
        yield of_agent(agent_id, f"{what} belongs to no agent of this run")
    trace = evidence.traces.get(agent_id)
    if trace is None or trace.problem:
        return
    states = _states_when(export, trace)
    if states and _state(export) not in states:
        yield _difference(agent_id, what, _state(export), states[-1])
    elif any(incarnation.unknown for incarnation in evidence.incarnations[agent_id]):
        return
    elif export.completed not in _completed_when(export, evidence.incarnations[agent_id]):
        yield of_agent(agent_id, f"{what} and its trace list different completed blocks", "5")


def _state(export: Export) -> StateSummary:
    return StateSummary(
        len(export.chain),
        len(export.blocks_to_be_committed),
        len(export.reconcile_stack),
        export.reconcile_in_progress,
        export.idle,
        export.top_chain_hash,
    )


def _states_when(export: Export, trace: Trace) -> list[StateSummary]:
    """Return all states in which the agent may have been when it wrote its export. Several states are possible if
    handlers ran at this time.
    """
    at_s = mission_s(export.exported_at_us, trace.header)
    if at_s is None:
        return []
    first = bisect_left(trace.runs, at_s - ROUNDED_S, key=lambda run: run.t)
    behind = bisect_right(trace.runs, at_s + ROUNDED_S, key=lambda run: run.t)
    states = [run.state for run in trace.runs[max(0, first - 1) : behind]]
    if first == 0 or any(first <= start <= behind for start in trace.starts):
        states.insert(0, StateSummary(0, 0, 0, reconciling=False, idle=True, top=export.inception.chain_hash))
    return states


def _completed_when(export: Export, incarnations: list[ReplayedIncarnation]) -> list[list[str]]:
    """Return the blocks that the agent had completed when it wrote its export, as one list for each incarnation (the
    time between two restarts).
    """
    at_s = mission_s(export.exported_at_us, incarnations[0].trace.header)
    if at_s is None:
        return [export.completed]
    by_then = [
        [run for run in incarnation.runs if run.changes and run.t <= at_s + ROUNDED_S] for incarnation in incarnations
    ]
    return [[block for run in runs for operation, block in run.changes if operation == "complete"] for runs in by_then]


def _last_state(incarnations: list[ReplayedIncarnation], export: Export) -> StateSummary:
    runs = incarnations[-1].runs
    return (
        runs[-1].state if runs else StateSummary(0, 0, 0, reconciling=False, idle=True, top=export.inception.chain_hash)
    )


def _difference(
    agent_id: int, what: str, exported: StateSummary, traced: StateSummary, *, short: bool = False
) -> Contradiction:
    differing = [
        (name, f"{FIELDS[name]} {_value(ours)}, not {_value(theirs)}")
        for name, ours, theirs in zip(FIELDS, astuple(exported), astuple(traced), strict=True)
        if ours != theirs
    ]
    touches = "6" if {"chain", "top"} & {name for name, _ in differing} else "2"
    detail = f"{what} differs from its trace: {', '.join(text for _, text in differing)}"
    return of_agent(agent_id, detail, touches, short=short)


def _value(value: object) -> str:
    return value[:12] if isinstance(value, str) else str(value).lower()


def _contents(agent_id: int, export: Export, incarnation: ReplayedIncarnation) -> Iterator[Contradiction]:
    """Yield the differences between the blocks of an export and the blocks of the trace. Call this function only if the
    export and the trace have equal lengths and equal top chain hashes.
    """
    if incarnation.wrong_lengths or incarnation.wrong_tops or incarnation.impossible or incarnation.unknown:
        return
    for place, exported, traced, touches in (
        ("chain", export.chain, incarnation.chain, "6"),
        ("deque", export.blocks_to_be_committed, incarnation.deque, "2"),
        ("reconcile stack", export.reconcile_stack, incarnation.stack, "2"),
    ):
        if [block.block_hash for block in exported] != traced:
            yield of_agent(
                agent_id,
                f"its export and its trace have different blocks in the {place}, or in different order",
                touches,
            )


def compare_with_itself(evidence: Evidence) -> Iterator[Contradiction]:
    """Yield each contradiction in a trace itself: inside an incarnation, or between the end of an incarnation and the
    start of the next one.
    """
    for agent_id, incarnations in evidence.incarnations.items():
        for incarnation in incarnations:
            yield from _in_incarnation(evidence, agent_id, incarnation)
        yield from _between_incarnations(evidence, agent_id, incarnations)


def _in_incarnation(evidence: Evidence, agent_id: int, incarnation: ReplayedIncarnation) -> Iterator[Contradiction]:
    for observations, touches in (
        (incarnation.impossible, "3"),
        (incarnation.wrong_lengths, "3"),
        (incarnation.wrong_tops, "4"),
        (incarnation.flags, None),
        (incarnation.back_in_time, None),
        (incarnation.out_of_sequence, "1"),
    ):
        for observation in observations:
            yield Contradiction(finding(evidence, agent_id, observation), touches)


def finding(evidence: Evidence, agent_id: int, observation: TraceObservation) -> Finding:
    """Return the observation as a piece of evidence that names the block."""
    block = observation.block_hash
    return Finding(agent_id, f"{observation.where}: {observation.what}", evidence.name(block) if block else None, block)


def _between_incarnations(
    evidence: Evidence, agent_id: int, incarnations: list[ReplayedIncarnation]
) -> Iterator[Contradiction]:
    slack = slack_s(evidence, evidence.traces[agent_id])
    now = 0.0
    for incarnation in incarnations:
        if incarnation.runs and incarnation.runs[0].t < now - slack:
            what = f"an incarnation starts at {incarnation.runs[0].t:g} s, before the previous one ends at {now:g} s"
            line, run = next(incarnation.numbered_runs())
            observation = TraceObservation(line, run, what)
            yield Contradiction(finding(evidence, agent_id, observation))
        now = incarnation.runs[-1].t if incarnation.runs else now
