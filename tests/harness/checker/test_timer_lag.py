"""Test the lateness of vote timers with artificial traces."""

import pytest

from harness.archive.lag import LagLine, MeasuredLag
from harness.archive.traces import Trace, TraceHeader
from harness.checker.timer_lag import ENOUGH, timer_lag
from ucp.trace import HandlerRun, StateSummary
from ucp.trigger import UnknownTrigger


def _run(t: float, handler: str, branch: str, reconciling: bool = False) -> HandlerRun:
    state = StateSummary(chain=0, deque=0, stack=0, reconciling=reconciling, idle=False, top="")
    return HandlerRun(t, handler, 1, UnknownTrigger({}), branch, [], [], state)


def _votes(*late_s: float, reconciling: bool = False) -> Trace:
    """Return the trace of an agent whose vote timers of 10 s expired late by these numbers of seconds."""
    header = TraceHeader(agent_id=1, roster=[1], settings={"vote_timeout_s": 10.0}, clock={})
    runs = [
        run
        for number, late in enumerate(late_s)
        for run in (
            _run(100.0 * number, "process_next_deque_block", "proposed"),
            _run(100.0 * number + 1, "receive_vote", "counted", reconciling),
            _run(100.0 * number + 10 + late, "vote_timer_expiration", "committed"),
        )
    ]
    return Trace(header, runs)


@pytest.mark.parametrize(("late_s", "tolerable"), [(0.2, True), (0.6, False)])
def test_lateness_is_that_of_the_latest_twentieth(late_s: float, tolerable: bool) -> None:
    found = timer_lag([_votes(*[0.01] * 36), _votes(*[late_s] * 4)])
    assert found is not None
    assert found.late_s == pytest.approx(late_s)
    assert found.asked_s == 10.0
    assert found.tolerable is tolerable


def test_one_late_timer_of_many_is_tolerable() -> None:
    found = timer_lag([_votes(*[0.01] * 99, 5.0)])
    assert found is not None
    assert found.tolerable


@pytest.mark.parametrize(("machine_s", "tolerable"), [(0.001, True), (1.0, False)])
def test_lateness_beyond_the_measured_lag_is_not_attributed_to_the_machine(machine_s: float, tolerable: bool) -> None:
    votes = _votes(*[5.0] * 40)
    votes.header.clock["speedup"] = 20
    line = {"from_s": 0, "until_s": 10_000, "machine_s": machine_s, "busy_s": {"1": 0.0}}
    found = timer_lag([votes], MeasuredLag([LagLine.model_validate(line)]))
    assert found is not None
    assert found.tolerable is tolerable


def test_too_few_votes_give_no_result() -> None:
    assert timer_lag([_votes(*[5.0] * (ENOUGH - 1))]) is None


def test_vote_paused_by_a_reconcile_does_not_count() -> None:
    assert timer_lag([_votes(*[50.0] * 100, reconciling=True)]) is None
