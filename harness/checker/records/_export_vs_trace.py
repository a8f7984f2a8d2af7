"""Compare a trace with itself, and an export with the trace that must have led to it.

An export contains its time. The trace until this time ends in a state. The top chain hash of this state covers all
blocks of the chain and their order.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Iterator
from dataclasses import astuple

from harness.archive.exports import Export
from harness.archive.traces import Trace
from harness.checker._trace_replay import Life, Sight
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
    """Yield each export that differs from the state at the end of its trace, in its blocks or their order."""
    for agent_id, export in evidence.exports.items():
        trace = evidence.traces.get(agent_id)
        if trace is None or trace.problem:
            continue
        state, lives = _state(export), evidence.lives[agent_id]
        if lives[-1].runs and state == lives[-1].runs[-1].state:
            yield from _contents(agent_id, export, lives[-1])
        elif state not in _states_when(export, trace):
            yield _otherwise(agent_id, "its export", state, _last_state(lives, export), short=True)
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
        yield _otherwise(agent_id, what, _state(export), states[-1])
    elif any(life.unknown for life in evidence.lives[agent_id]):
        return
    elif export.completed not in _completed_when(export, evidence.lives[agent_id]):
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
    """Return the possible states of the agent at its export: several if handlers ran at the same instant."""
    at_s = mission_s(export.exported_at_us, trace.header)
    if at_s is None:
        return []
    first = bisect_left(trace.runs, at_s - ROUNDED_S, key=lambda run: run.t)
    behind = bisect_right(trace.runs, at_s + ROUNDED_S, key=lambda run: run.t)
    states = [run.state for run in trace.runs[max(0, first - 1) : behind]]
    if first == 0 or any(first <= start <= behind for start in trace.starts):
        states.insert(0, StateSummary(0, 0, 0, reconciling=False, idle=True, top=export.inception.chain_hash))
    return states


def _completed_when(export: Export, lives: list[Life]) -> list[list[str]]:
    """Return the blocks that each incarnation of the agent had completed at the export."""
    at_s = mission_s(export.exported_at_us, lives[0].trace.header)
    if at_s is None:
        return [export.completed]
    by_then = [[run for run in life.runs if run.changes and run.t <= at_s + ROUNDED_S] for life in lives]
    return [[block for run in runs for operation, block in run.changes if operation == "complete"] for runs in by_then]


def _last_state(lives: list[Life], export: Export) -> StateSummary:
    runs = lives[-1].runs
    return (
        runs[-1].state if runs else StateSummary(0, 0, 0, reconciling=False, idle=True, top=export.inception.chain_hash)
    )


def _otherwise(
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


def _contents(agent_id: int, export: Export, life: Life) -> Iterator[Contradiction]:
    """Compare the blocks of an export with those of the trace, whose lengths and top chain hash agree."""
    if life.otherwise or life.another_top or life.impossible or life.unknown:
        return
    for place, exported, traced, touches in (
        ("chain", export.chain, life.chain, "6"),
        ("deque", export.blocks_to_be_committed, life.deque, "2"),
        ("reconcile stack", export.reconcile_stack, life.stack, "2"),
    ):
        if [block.block_hash for block in exported] != traced:
            yield of_agent(
                agent_id,
                f"its export and its trace have different blocks in the {place}, or in different order",
                touches,
            )


def compare_with_itself(evidence: Evidence) -> Iterator[Contradiction]:
    """Yield contradictions within each incarnation of an agent, and between incarnations."""
    for agent_id, lives in evidence.lives.items():
        for life in lives:
            yield from _in_life(evidence, agent_id, life)
        yield from _between_lives(evidence, agent_id, lives)


def _in_life(evidence: Evidence, agent_id: int, life: Life) -> Iterator[Contradiction]:
    for sights, touches in (
        (life.impossible, "3"),
        (life.otherwise, "3"),
        (life.another_top, "4"),
        (life.flags, None),
        (life.back_in_time, None),
        (life.out_of_sequence, "1"),
    ):
        for sight in sights:
            yield Contradiction(finding(evidence, agent_id, sight), touches)


def finding(evidence: Evidence, agent_id: int, sight: Sight) -> Finding:
    """Return the observation as evidence, with the name of the block."""
    block = sight.block_hash
    return Finding(agent_id, f"{sight.where}: {sight.what}", evidence.name(block) if block else None, block)


def _between_lives(evidence: Evidence, agent_id: int, lives: list[Life]) -> Iterator[Contradiction]:
    slack = slack_s(evidence.traces[agent_id])
    now = 0.0
    for life in lives:
        if life.runs and life.runs[0].t < now - slack:
            what = f"an incarnation starts at {life.runs[0].t:g} s, before the previous one ends at {now:g} s"
            line, run = next(life.numbered())
            sight = Sight(line, run, what)
            yield Contradiction(finding(evidence, agent_id, sight))
        now = life.runs[-1].t if life.runs else now
