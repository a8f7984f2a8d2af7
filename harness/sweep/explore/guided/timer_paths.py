"""When which timers ended in a run, and the ways that agents went from one vote that failed to the next.

A livelock is such a way that never ends. Those that end are near it.
"""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from itertools import groupby
from typing import NamedTuple

from harness.checker import Evidence
from ucp.agent import ON_TIMER

APPROVED = (ON_TIMER["voting"].name, "approved")
MOST = 16
"""Of a longer way only so many timers, the last, tell it from others."""

Ways = tuple[tuple[str, ...], ...]
"""Of each agent which timers ended, in order."""


class Ended(NamedTuple):
    """A timer ended, and its handler took this branch."""

    at_s: float
    agent_id: int
    timer: str
    handler: str
    branch: str


def timers_ended(evidence: Evidence) -> list[Ended]:
    """Of all agents, in order."""
    return sorted(
        Ended(run.t, agent_id, str(run.trigger["timer"]), run.handler, run.branch)
        for agent_id, trace in evidence.traces.items()
        for run in trace.runs
        if "timer" in run.trigger
    )


def in_vain(ended: Iterable[Ended]) -> Ways:
    """The longest that agents went on without a vote that was approved; none if not at least two votes failed on it."""
    longest: Sequence[Ended] = ()
    for approved, stretch in groupby(ended, lambda each: (each.handler, each.branch) == APPROVED):
        if not approved:
            longest = max(longest, [*stretch], key=len)
    if sum(each.timer == "voting" for each in longest) < 2:
        return ()
    ways = defaultdict[int, list[str]](list)
    for each in longest[-MOST:]:
        ways[each.agent_id].append(each.timer)
    return tuple(sorted(map(tuple, ways.values())))
