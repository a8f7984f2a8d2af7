"""Measure how late the vote timers of agents expired. A warning can then report that the machine is too slow."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from statistics import quantiles

from harness.archive.run_journals import MeasuredLag
from harness.archive.traces import Trace

ENOUGH = 20
"""Minimum number of vote timers for an estimate."""
TOLERATED = 0.05


@dataclass(frozen=True)
class TimerLag:
    """The lateness of vote timers."""

    late_s: float
    """Lateness in mission seconds that 19 of 20 vote timers did not exceed."""
    asked_s: float
    """Duration of a vote timer according to the settings, in mission seconds."""

    @property
    def tolerable(self) -> bool:
        """True if the lateness is at most one twentieth of the duration of the timer."""
        return self.late_s <= TOLERATED * self.asked_s


def timer_lag(traces: Iterable[Trace], lag: MeasuredLag | None = None) -> TimerLag | None:
    """Return the lateness of the vote timers of all agents. Votes that a reconcile interrupted are ignored. Return None
    for fewer than `ENOUGH` votes. `lag` contains the measured delays of the machine. If `lag` is given, the result
    contains only the lateness that these delays explain.
    """
    late: list[float] = []
    asked_s = 0.0
    for trace in traces:
        setting = trace.header.settings.get("vote_timeout_s")
        if isinstance(setting, int | float):
            asked_s = float(setting)
            late += [_of_machine(trace, ended_s, lasted_s - asked_s, lag) for ended_s, lasted_s in _votes(trace)]
    return TimerLag(quantiles(late, n=20)[-1], asked_s) if len(late) >= ENOUGH else None


def _of_machine(trace: Trace, ended_s: float, late_s: float, lag: MeasuredLag | None) -> float:
    """Return the part of the lateness, in mission seconds, that the measured delays of the machine cause."""
    speedup = trace.header.clock.get("speedup")
    explained_s = lag.explains(trace.header.agent_id, ended_s - max(0.0, late_s), ended_s) if lag else None
    return late_s if explained_s is None or not speedup else min(late_s, explained_s * speedup)


def _votes(trace: Trace) -> Iterator[tuple[float, float]]:
    """Yield the end and the duration of each vote in mission seconds. Votes that a reconcile interrupted are
    omitted.
    """
    for life in trace.incarnations():
        began: float | None = None
        for _, run in life:
            if run.handler == "vote_timer_expiration" and began is not None:
                yield run.t, run.t - began
                began = None
            if run.branch == "proposed":
                began = run.t
            elif run.state.reconciling:
                began = None
