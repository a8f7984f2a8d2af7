"""Find timers of an agent that expired later than the measured delays of the machine can explain.

A correct agent runs a timer late only if the machine wakes it late, or if its process is busy or waits for a processor.
The harness measures both delays during a run (`lag.jsonl`). The measured delay is an upper bound, so a single timer
reveals only a large error. If the duration of a timer is wrong, all expiries of this timer are late. Their mean
lateness over the run then reveals smaller errors, too.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from statistics import mean

from harness.archive.traces import Trace
from harness.checker.evidence import Evidence
from harness.checker.records.contradiction import in_virtual_time
from harness.checker.steps.deviation import StepDeviation
from harness.checker.steps.follower import RecordedTimerExpiry
from harness.checker.steps.trace_header import ROUNDING_S

SINGLE_WALL_S = 0.03
"""Maximum lateness of a single timer in addition to the measured delay, in seconds of wall time."""
MEAN_WALL_S = 0.01
"""Tolerance for the mean lateness of a timer, in seconds of wall time. The mean lateness may exceed the mean measured
delay by this time.
"""
ENOUGH = 8
"""Minimum number of expiries for which a mean is computed."""


@dataclass
class JudgedTimers:
    """Two numbers for the expired timers of all agents: `expiries`, the number of examined expiries, and `unmeasured`,
    the number of examined expiries for which the delay of the machine was not measured. Expiries in virtual time are
    not counted.
    """

    expiries: int = 0
    unmeasured: int = 0

    @property
    def remark(self) -> str:
        """A remark for the verdict if some timers could not be judged. Empty if all timers were judged."""
        if not self.unmeasured:
            return ""
        which = "timers" if self.unmeasured == self.expiries else f"{self.unmeasured} of {self.expiries} timers"
        return f"; the lag of the machine is not recorded for {which}, so they may be up to 1 s of wall time late"

    def judge(
        self, evidence: Evidence, trace: Trace, expiries: Sequence[RecordedTimerExpiry]
    ) -> Iterator[StepDeviation]:
        """Yield the expiries of an agent's timers that were too late. The measured delays of the machine do not explain
        how late these expiries were.
        """
        agent_id, speedup = trace.header.agent_id, trace.header.clock.get("speedup")
        if in_virtual_time(trace):
            yield from _in_virtual_time(evidence, agent_id, expiries)
            return
        if not isinstance(speedup, int | float) or speedup <= 0:
            return
        explained: dict[str, list[tuple[RecordedTimerExpiry, float]]] = defaultdict(list)
        for expiry in expiries:
            due_s = expiry.t - max(0.0, expiry.late_s)
            lag_s = evidence.lag.explains(agent_id, due_s, expiry.t) if evidence.lag else None
            self.expiries += 1
            if lag_s is None:
                self.unmeasured += 1
            elif not evidence.was_paused(agent_id, due_s, expiry.t):
                explained[expiry.timer].append((expiry, lag_s * speedup))
        for timer, of_kind in explained.items():
            yield from _of_kind(agent_id, timer, of_kind, speedup)


def _in_virtual_time(
    evidence: Evidence, agent_id: int, expiries: Sequence[RecordedTimerExpiry]
) -> Iterator[StepDeviation]:
    """Yield each expiry that came too late. In virtual time, only delays of the scenario, such as pauses, may make an
    expiry late.
    """
    for expiry in expiries:
        due_s = expiry.t - max(0.0, expiry.late_s)
        if expiry.late_s > ROUNDING_S and not evidence.was_delayed(agent_id, due_s, expiry.t):
            what = f"it ran {expiry.late_s:.3g} s after the {expiry.timer} timer expired, and virtual time has no lag"
            yield StepDeviation(agent_id, expiry.line, expiry.t, expiry.handler, what)


def _of_kind(
    agent_id: int, timer: str, expiries: list[tuple[RecordedTimerExpiry, float]], speedup: float
) -> Iterator[StepDeviation]:
    """Yield each expiry of this timer that was too late. If each single delay is acceptable but their mean is too high,
    yield the last expiry.
    """
    late = [(expiry, lag_s) for expiry, lag_s in expiries if expiry.late_s > lag_s + SINGLE_WALL_S * speedup]
    for expiry, lag_s in late:
        what = (
            f"it ran {expiry.late_s:.3g} s after the {timer} timer expired, but the measured lag explains only "
            f"{lag_s:.2g} s"
        )
        yield StepDeviation(agent_id, expiry.line, expiry.t, expiry.handler, what)
    if late or len(expiries) < ENOUGH:
        return
    late_s, lag_s = mean(expiry.late_s for expiry, _ in expiries), mean(lag_s for _, lag_s in expiries)
    if late_s > lag_s + MEAN_WALL_S * speedup:
        last, _ = expiries[-1]
        what = (
            f"{len(expiries)} {timer} timers ran {late_s:.3g} s after they expired on average, but the measured lag "
            f"explains only {lag_s:.2g} s"
        )
        yield StepDeviation(agent_id, last.line, last.t, last.handler, what)
