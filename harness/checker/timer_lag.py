"""Whether the machine kept the agents' time: how late their vote timers fired, from their own traces."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from statistics import quantiles

from harness.archive.traces import Trace

ENOUGH = 20
"""Fewer timers than this say nothing of the latest twentieth."""
TOLERATED = 0.05


@dataclass(frozen=True)
class TimerLag:
    """Of twenty vote timers, set to `asked_s`, one fired more than `late_s` late. Mission seconds."""

    late_s: float
    asked_s: float

    @property
    def tolerable(self) -> bool:
        """Whether that is at most a twentieth of what was asked."""
        return self.late_s <= TOLERATED * self.asked_s


def timer_lag(traces: Iterable[Trace]) -> TimerLag | None:
    """Over all votes that no reconcile interrupted; None if too few tell."""
    late: list[float] = []
    asked_s = 0.0
    for trace in traces:
        setting = trace.header.settings.get("vote_timeout_s")
        if isinstance(setting, int | float):
            asked_s = float(setting)
            late += [lasted - asked_s for lasted in _votes(trace)]
    return TimerLag(quantiles(late, n=20)[-1], asked_s) if len(late) >= ENOUGH else None


def _votes(trace: Trace) -> Iterator[float]:
    """How long each vote lasted. A reconcile pauses the timer, and leaves its vote out."""
    for life in trace.lives():
        began: float | None = None
        for _, run in life:
            if run.handler == "vote_timer_expiration" and began is not None:
                yield run.t - began
                began = None
            if run.branch == "proposed":
                began = run.t
            elif run.state.reconciling:
                began = None
