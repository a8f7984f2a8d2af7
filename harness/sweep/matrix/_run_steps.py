"""Compute fingerprints of runs, and use them to find the first handler run at which a run differs from the same run of
an earlier night.

The fingerprint of a run has two bytes for each handler run, in the order of mission time. The first two bytes that
differ between two nights give the position of the first changed handler run. To find its name, the run is played again
with the current code. The code of the earlier night is therefore not needed.

Handler runs that only received a message are omitted. If the agent core is edited, the simulation delivers more
messages that have no effect. The handler runs of these messages would hide the first real change.
"""

import base64
import zlib
from collections.abc import Mapping
from operator import attrgetter
from typing import NamedTuple

from pydantic import BaseModel

from harness.archive.traces import Trace, only_receives
from harness.scenario import Scenario
from ucp.trace import HandlerRun

MAX_STEPS = 4000
"""Maximum number of handler runs in a fingerprint."""
_BYTES = 2


class HandlerStep(NamedTuple):
    """A handler run, with the ID of the agent that ran the handler."""

    t: float
    agent_id: int
    run: HandlerRun


class FirstChange(BaseModel):
    """The first handler run at which the run with this seed differs from the same run of the earlier night.

    `handler` is null in two cases: the fingerprint does not include this handler run, or the new run ended before it.
    """

    seed: int
    at_s: float | None = None
    agent_id: int | None = None
    handler: str | None = None
    branch: str | None = None


def fingerprint(traces: Mapping[int, Trace]) -> str:
    """Return the fingerprint of a run in base64. The result is empty without traces."""
    digests = [_digest(step).to_bytes(_BYTES) for step in _steps(traces)[:MAX_STEPS]]
    return base64.b64encode(b"".join(digests)).decode("ascii")


def first_changed(before: str, now: str) -> int | None:
    """Return the position of the first handler run that differs between the two fingerprints. Return None if the
    fingerprints are equal.
    """
    if before == now:
        return None
    was, is_now = base64.b64decode(before), base64.b64decode(now)
    shared = min(len(was), len(is_now))
    byte = next((place for place in range(shared) if was[place] != is_now[place]), shared)
    return byte // _BYTES


def name_change(scenario: Scenario, seed: int, position: int) -> FirstChange:
    """Play the run again, and return the handler run at this position."""
    from harness.run.simulate import simulate

    steps = _steps(simulate(scenario, seed, tracing=True).evidence.traces)
    if position >= len(steps):
        return FirstChange(seed=seed)
    step = steps[position]
    return FirstChange(
        seed=seed, at_s=round(step.t, 3), agent_id=step.agent_id, handler=step.run.handler, branch=step.run.branch
    )


def _steps(traces: Mapping[int, Trace]) -> list[HandlerStep]:
    """Return the handler runs that had an effect, of all agents, in the order of mission time."""
    steps = [
        HandlerStep(run.t, agent_id, run)
        for agent_id, trace in sorted(traces.items())
        for run in trace.runs
        if run.sent or not only_receives(run)
    ]
    return sorted(steps, key=attrgetter("t"))


def _digest(step: HandlerStep) -> int:
    run = step.run
    sent = [(message.message, message.seq, message.block) for message in run.sent]
    facts = (round(step.t, 6), step.agent_id, run.handler, run.branch, [*map(tuple, run.changes)], sent)
    return zlib.crc32(repr(facts).encode()) % (1 << 8 * _BYTES)
