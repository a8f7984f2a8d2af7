"""Part of characteristic 1: nothing waits for anybody. A vote ends with its timer, as does each step of a reconcile.

An agent that waits longer than its own timers say, waits for what will never happen.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from harness.checker.characteristic import Finding
from harness.checker.evidence import Evidence
from harness.traces import Trace
from ucp.trace import HandlerRun

SLACK_WALL_S = 1.0
"""How late a loaded machine may run a timer before it counts as not run, in wall seconds."""

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
"""Branches of these handlers with which a reconcile does not go on."""


def _goes_on(run: HandlerRun) -> bool:
    return run.handler in RECONCILE_STEPS and run.branch not in NO_STEP


@dataclass(frozen=True)
class _Wait:
    """What begins and ends with which handler run, and must not last longer than the settings of that name."""

    what: str
    begins: Callable[[HandlerRun], bool]
    ends: Callable[[HandlerRun], bool]
    timers: tuple[str, ...]


WAITS = (
    _Wait(
        "a vote began and did not end",
        lambda run: run.handler == "process_next_deque_block" and run.branch == "proposed",
        lambda run: run.handler == "vote_timer_expiration",
        ("vote_timeout_s",),
    ),
    _Wait(
        "a reconcile did not go on",
        lambda run: _goes_on(run) and run.state.reconciling,
        _goes_on,
        ("phase1_timeout_s", "phase2_timeout_s", "phase3_timeout_s", "finalize_gap_s"),
    ),
)


def waited_too_long(evidence: Evidence) -> Iterator[Finding]:
    """Every wait that lasted longer than the agent's own timers, while it was not paused."""
    for agent_id, trace in evidence.traces.items():
        for wait in WAITS:
            longest = _longest(trace, wait.timers)
            if longest is not None:
                yield from _of_one_kind(evidence, agent_id, trace, wait, longest)


def _of_one_kind(evidence: Evidence, agent_id: int, trace: Trace, wait: _Wait, longest: float) -> Iterator[Finding]:
    since: tuple[int, float] | None = None

    def too_long(now: float) -> Iterator[Finding]:
        nonlocal since
        if since is not None and now > since[1] + longest and not evidence.was_paused(agent_id, since[1], now):
            where = f"trace line {since[0]}, t={since[1]:g} s"
            yield Finding(agent_id, f"{where}: {wait.what} within {longest:g} s")
            since = None

    for life in trace.lives():
        since = None
        for line, run in life:
            if wait.ends(run):
                since = None
            yield from too_long(run.t)
            if wait.begins(run):
                since = line, run.t
    if agent_id in evidence.exports and evidence.ended_at_s is not None:
        yield from too_long(evidence.ended_at_s)


def _longest(trace: Trace, timers: tuple[str, ...]) -> float | None:
    """The longest of these timers in mission seconds, with slack for the machine; None if the settings do not tell."""
    settings: list[Any] = [trace.header.settings.get(timer) for timer in timers]
    if not all(isinstance(setting, int | float) for setting in settings):
        return None
    speedup, drift = trace.header.clock.get("speedup", 1), trace.header.clock.get("drift", 0)
    if not isinstance(speedup, int | float) or not isinstance(drift, int | float) or drift <= -1:
        return None
    return float(max(settings)) / (1 + drift) + SLACK_WALL_S * speedup
