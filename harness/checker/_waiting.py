"""Check one part of characteristic 1: an agent continues when its own timer expires, and does not wait longer for other
agents.

Each vote and each step of a reconcile has a timer. If no next step follows within the duration of the timer, the agent
waits for something else, for example for an answer that may never arrive.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from harness.archive.traces import Trace
from harness.checker.evidence import Evidence
from harness.checker.judgement import Finding
from ucp.trace import HandlerRun

SLACK_WALL_S = 1.0
"""Tolerance in seconds of wall time for timers that a busy machine delays."""

RECONCILE_STEPS = frozenset(
    (
        "reconcile_begin",
        "reconcile_phase_1",
        "reconcile_phase_1_timer_expiration",
        "reconcile_phase_2",
        "reconcile_phase_2_timer_expiration",
        "reconcile_phase_3",
        "receive_response_block_for_hash",
        "reconcile_phase_3_timer_expiration",
        "reconcile_finalize",
    )
)
NO_STEP = frozenset(("already in progress", "not in phase 3", "another block"))
"""Branches (results) of reconcile handlers that do not count as the next step of a reconcile."""


def _continues_reconcile(run: HandlerRun) -> bool:
    return run.handler in RECONCILE_STEPS and run.branch not in NO_STEP


VOTE_STEPS = frozenset(("process_next_deque_block", "vote_timer_expiration"))
STEPS = RECONCILE_STEPS | VOTE_STEPS
VOTE_TIMERS = ("vote_timeout_s",)
RECONCILE_TIMERS = ("phase1_timeout_s", "phase2_timeout_s", "phase3_timeout_s", "finalize_gap_s")
ALL_TIMERS = (*VOTE_TIMERS, *RECONCILE_TIMERS)


@dataclass(slots=True)
class _UnfinishedOperation:
    """The current vote or reconcile of an agent. Each step of the trace updates it."""

    what: str
    longest: float
    """Maximum number of mission seconds between two steps of this vote or reconcile."""
    line: int = 0
    since: float = math.inf
    """Mission second of the last step. Infinity before the first vote or reconcile."""
    due_s: float = math.inf
    """Latest mission second at which the next step must happen. Infinity if no vote or reconcile is in progress."""
    was_late: bool = False
    """True if the next step was overdue, but the agent's computer may have been suspended. In this case, the check
    extends the time limit once.
    """

    def begin(self, line: int, now: float) -> None:
        self.line, self.since, self.due_s, self.was_late = line, now, now + self.longest, False

    def end(self) -> None:
        self.due_s = math.inf

    def finding(self, agent_id: int) -> Finding:
        where = f"trace line {self.line}, t={self.since:g} s"
        return Finding(agent_id, f"{where}: {self.what} within {self.longest:g} s")


def waited_too_long(evidence: Evidence) -> Iterator[Finding]:
    """Yield a finding for each vote or reconcile that did not continue within the duration of its timer, although the
    agent was neither paused nor delayed by a slow machine.
    """
    for agent_id, trace in evidence.traces.items():
        if evidence.describe_unknown_name("handler", "branch", agent_id=agent_id):
            continue  # only known names show the steps of votes and reconciles
        vote_s, reconcile_s = longest(trace, VOTE_TIMERS), longest(trace, RECONCILE_TIMERS)
        for incarnation in trace.incarnations():
            vote = _UnfinishedOperation("a vote began and did not end", vote_s)
            reconcile = _UnfinishedOperation("a reconcile did not continue", reconcile_s)
            yield from _find_in_incarnation(evidence, agent_id, incarnation, vote, reconcile)
        whole = agent_id in evidence.exports and not trace.problem
        if whole and (ended_at_s := evidence.end_of(agent_id)) is not None:
            yield from _find_overdue(evidence, agent_id, ended_at_s, vote, reconcile)


def _find_in_incarnation(
    evidence: Evidence,
    agent_id: int,
    incarnation: Iterator[tuple[int, HandlerRun]],
    vote: _UnfinishedOperation,
    reconcile: _UnfinishedOperation,
) -> Iterator[Finding]:
    for line, run in incarnation:
        step = run.handler in STEPS
        if run.handler == "vote_timer_expiration":
            vote.end()
        elif step and _continues_reconcile(run):
            reconcile.end()
        if run.t > vote.due_s or run.t > reconcile.due_s:
            yield from _find_overdue(evidence, agent_id, run.t, vote, reconcile)
        if run.branch == "proposed":
            vote.begin(line, run.t)
        elif step and _continues_reconcile(run) and run.state.reconciling:
            reconcile.begin(line, run.t)


def _find_overdue(evidence: Evidence, agent_id: int, now: float, *waits: _UnfinishedOperation) -> Iterator[Finding]:
    """Yield a finding for each overdue vote or reconcile.

    Records of a real flight do not show whether the computer was suspended, or whether its clock was set. In such
    records, the first late trace line is therefore no finding. The agent may still handle the overdue timer directly
    after this line.
    """
    for wait in waits:
        if now <= wait.due_s:
            continue
        if evidence.from_field and evidence.record is None and not wait.was_late:
            wait.was_late, wait.due_s = True, now + _slack_s(evidence.traces[agent_id])
            continue
        if not (evidence.was_paused(agent_id, wait.since, now) or evidence.was_delayed(agent_id, wait.due_s, now)):
            yield wait.finding(agent_id)
        wait.end()


def longest(trace: Trace, timers: tuple[str, ...]) -> float:
    """Return the longest duration of these timers in mission seconds, plus a tolerance. Return infinity if the duration
    of a timer is unknown.
    """
    settings: list[Any] = [trace.header.settings.get(timer) for timer in timers]
    if not all(isinstance(setting, int | float) for setting in settings):
        return math.inf
    drift = trace.header.clock.get("drift", 0)
    if not isinstance(drift, int | float) or drift <= -1:
        return math.inf
    return float(max(settings)) / (1 + drift) + _slack_s(trace)


def _slack_s(trace: Trace) -> float:
    """Return the tolerance for late timers in mission seconds. It is infinite if the speedup is unknown."""
    speedup = trace.header.clock.get("speedup", 1)
    return SLACK_WALL_S * speedup if isinstance(speedup, int | float) else math.inf
