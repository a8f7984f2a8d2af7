"""Compute the mission second of each step of a path, and the timestamps of its blocks.

The time of each step is a variable, and each timer duration is a constraint on the difference of two variables. If a
solution exists, the lengths of the longest paths in the graph of these constraints are a solution (Bellman and Ford).

With `Bounds.clocks_any`, either of two blocks may be the older one. The scenario then contains the timestamps of the
events.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from math import inf
from typing import Any

from harness.proof.model._block_renaming import Ordinals
from ucp.clock import MICROSECONDS

DISTANCES_S = (5.0, 2.0, 1.0, 0.5, 0.2, 0.0)
"""Minimum numbers of seconds between two steps of a path. They are tried in this order, until one permits all timer
durations.
"""
FIRST_INSTANT_S = 1.0


@dataclass(frozen=True, slots=True)
class TimerRun:
    """A timer that ran from one step of a path to a later step. If `ended` is false, the timer ran at least until the
    later step.
    """

    started: int
    duration_s: float
    until: int
    ended: bool


def instants_s(count: int, runs: Sequence[TimerRun]) -> list[float]:
    """Return the mission second of each of the `count` steps of a path.

    If timers may expire in any order, a solution with punctual timers may not exist. Timers are then late.
    """
    for apart_s in DISTANCES_S:
        solution = _solve(count, runs, apart_s, punctual=True)
        if solution is not None:
            return solution
    solution = _solve(count, runs, DISTANCES_S[0], punctual=False)
    assert solution is not None, "every timer may be late"
    return solution


def windows_s(count: int, runs: Sequence[TimerRun]) -> list[tuple[float, float]]:
    """Return the earliest and the latest possible second of each of the `count` steps of a path, measured from the
    first step.
    """
    later = _bounds(count, runs, 0.0, punctual=True)
    begin = [0.0, *[-inf] * (count - 1)]
    earliest = _longest_paths(begin, later)
    latest = _longest_paths(begin, [(after, before, least) for before, after, least in later])
    assert earliest is not None, "the path was found"
    assert latest is not None, "the path was found"
    return [(first + 0.0, 0.0 - last) for first, last in zip(earliest, latest, strict=True)]


def _solve(count: int, runs: Sequence[TimerRun], apart_s: float, *, punctual: bool) -> list[float] | None:
    """Return the earliest times that satisfy the constraints of all timers. Return None if the constraints have no
    solution.
    """
    later = _bounds(count, runs, apart_s, punctual=punctual)
    return _longest_paths([FIRST_INSTANT_S] * count, later)


def _longest_paths(at_least: Sequence[float], later: Sequence[tuple[int, int, float]]) -> list[float] | None:
    """Return the length of the longest path to each step in the constraint graph `later`. Return None if the graph has
    a cycle, so that a length would be infinite.
    """
    longest = [*at_least]
    for _ in range(len(longest) + 1):
        changed = False
        for before, after, least in later:
            if longest[before] + least > longest[after] + 1e-9:
                longest[after] = longest[before] + least
                changed = True
        if not changed:
            return longest
    return None


def _bounds(count: int, runs: Sequence[TimerRun], apart_s: float, *, punctual: bool) -> list[tuple[int, int, float]]:
    """Return the constraints on the times of steps, each as (first step, second step, minimum number of seconds between
    these steps).
    """
    later: list[tuple[int, int, float]] = [(number - 1, number, apart_s) for number in range(1, count)]
    for run in runs:
        if run.ended:
            later.append((run.started, run.until, run.duration_s))
            if punctual:
                later.append((run.until, run.started, -run.duration_s))
        elif punctual:
            later.append((run.until, run.started, apart_s - run.duration_s))
    return later


class BlockAges:
    """The required order of the ages of all blocks on a path. The method `date` chooses timestamps that satisfy this
    order.

    Blocks are identified by their ordinals in the states of the path. These ordinals change along the path.
    """

    def __init__(self) -> None:
        self._events: list[int] = []
        """Ordinal of a block minus 1 -> index of the event that completes it."""
        self._older: dict[int, set[int]] = {}
        """Index of an event -> indices of the events whose blocks are older than the block of this event."""

    def completed(self, ordinal: int) -> None:
        """Record that the next event completes the block with this ordinal."""
        assert ordinal == len(self._events) + 1, "blocks are numbered as they are completed"
        self._older[len(self._events)] = set()
        self._events.append(len(self._events))

    def renumber(self, blocks: Ordinals) -> None:
        """Change the numbers of the blocks after a step. The given blocks receive the numbers 1, 2 and so on. All other
        blocks, which no agent holds, receive the following numbers.
        """
        if blocks:
            rest = [ordinal for ordinal in range(1, len(self._events) + 1) if ordinal not in blocks]
            self._events = [self._events[ordinal - 1] for ordinal in (*blocks, *rest)]

    def require_older(self, oldest: int, others: Collection[int]) -> None:
        """Require that the block `oldest` is older than the blocks `others`. Block 0 is the inception block, which is
        always the oldest.
        """
        for other in others if oldest else ():
            self._older[self._events[other - 1]].add(self._events[oldest - 1])

    def date(self, events: list[dict[str, Any]]) -> bool:
        """Choose timestamps for the events that satisfy the required order, and return true.

        Return false if no timestamps satisfy it, because the requirements contradict each other or an agent's clock
        would go back.
        """
        for index, event in enumerate(events):
            own = [earlier for earlier in range(index) if events[earlier]["agent"] == event["agent"]]
            self._older[index].update(own)  # an agent's clock does not go back
        if all(older < younger for younger, all_older in self._older.items() for older in all_older):
            return True
        try:
            in_order = [*TopologicalSorter(self._older).static_order()]
        except CycleError:
            return False
        moments = sorted(round(event["at_s"] * MICROSECONDS) for event in events)
        for index, timestamp_us in zip(in_order, moments, strict=True):
            events[index]["timestamp_us"] = timestamp_us
        return True
