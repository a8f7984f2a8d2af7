"""A contradiction between two records, and the tolerance for their clocks."""

from dataclasses import dataclass

from harness.archive.traces import Trace, TraceHeader
from harness.checker._waiting import SLACK_WALL_S
from harness.checker.evidence import Evidence
from harness.checker.judgement import Finding
from ucp.clock import MICROSECONDS


@dataclass(frozen=True, slots=True)
class Contradiction:
    """A contradiction between two records of the same run, for example between a trace and an export."""

    finding: Finding
    touches: str | None = None
    """Number of the characteristic whose verdict uses these records. None if no characteristic uses them."""
    short: bool = False
    """True if the contradiction shows that lines are missing in the trace of the agent."""


def of_agent(agent_id: int, detail: str, touches: str | None = None, *, short: bool = False) -> Contradiction:
    """Return a contradiction about an agent that concerns no particular block."""
    return Contradiction(Finding(agent_id, detail), touches, short)


ROUNDED_S = 2e-6
"""Maximum rounding error in seconds of two compared times in traces, which are rounded to microseconds."""


def in_virtual_time(trace: Trace) -> bool:
    """Return true if the clock of the trace starts at the Unix epoch, which shows that the run was simulated."""
    return trace.header.clock.get("epoch_us") == 0


def slack_s(evidence: Evidence, trace: Trace) -> float:
    """Return the tolerance for differences between clocks, in mission seconds. A simulated run has only one clock, so
    its tolerance covers only rounding. The tolerance for a clock of another computer includes the measured error of the
    clock.
    """
    speedup = trace.header.clock.get("speedup")
    if in_virtual_time(trace) or not isinstance(speedup, int | float):
        return ROUNDED_S
    return (SLACK_WALL_S + evidence.clock_error_s(trace.header.agent_id)) * speedup


def mission_s(timestamp_us: int, header: TraceHeader) -> float | None:
    """Return the mission second at which the agent's clock showed this timestamp. Return None if the header does not
    describe the clock.
    """
    clock = header.clock
    values = [clock.get("epoch_us"), clock.get("offset_s", 0), clock.get("drift", 0)]
    epoch_us, offset_s, drift = (float(part) if isinstance(part, int | float) else None for part in values)
    if epoch_us is None or offset_s is None or drift is None or drift <= -1:
        return None
    return ((timestamp_us - epoch_us) / MICROSECONDS - offset_s) / (1 + drift)
