"""Mission seconds of each instant on a path, and the order in which its blocks were made.

Every instant is a variable, every duration a bound on a difference of two; the shortest paths over the bounds are a
solution (Bellman and Ford), if there is one.

Where any block may be the older (`Bounds.clocks_any`) a scenario says what the clocks showed.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from math import inf
from typing import Any

from harness.proof.model._block_renaming import Ordinals
from ucp.clock import MICROSECONDS

APART_S = (5.0, 2.0, 1.0, 0.5, 0.2, 0.0)
"""How far from each other two instants should be: as far as can be."""
BEGINS_S = 1.0


@dataclass(frozen=True, slots=True)
class Run:
    """A timer that ran from one instant until another, or at least until then if it did not `end`."""

    started: int
    duration_s: float
    until: int
    ended: bool


def instants_s(count: int, runs: Sequence[Run]) -> list[float]:
    """When each of `count` instants is; timers may have to be late only if they were let end in any order."""
    for apart_s in APART_S:
        solution = _solved(count, runs, apart_s, punctual=True)
        if solution is not None:
            return solution
    solution = _solved(count, runs, APART_S[0], punctual=False)
    assert solution is not None, "every timer may be late"
    return solution


def windows_s(count: int, runs: Sequence[Run]) -> list[tuple[float, float]]:
    """How long after the first instant each of `count` can be, at the earliest and at the latest."""
    later = _later(count, runs, 0.0, punctual=True)
    begin = [0.0, *[-inf] * (count - 1)]
    earliest = _longest(begin, later)
    latest = _longest(begin, [(after, before, least) for before, after, least in later])
    assert earliest is not None, "the path was found"
    assert latest is not None, "the path was found"
    return [(first + 0.0, 0.0 - last) for first, last in zip(earliest, latest, strict=True)]


def _solved(count: int, runs: Sequence[Run], apart_s: float, *, punctual: bool) -> list[float] | None:
    """The earliest times: each is the longest way over what has to lie between."""
    later = _later(count, runs, apart_s, punctual=punctual)
    return _longest([BEGINS_S] * count, later)


def _longest(at_least: Sequence[float], later: Sequence[tuple[int, int, float]]) -> list[float] | None:
    """The longest way to each instant over what has to lie between; None if there is none."""
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


def _later(count: int, runs: Sequence[Run], apart_s: float, *, punctual: bool) -> list[tuple[int, int, float]]:
    """(instant, another, how many seconds at least the other is later)."""
    later: list[tuple[int, int, float]] = [(number - 1, number, apart_s) for number in range(1, count)]
    for run in runs:
        if run.ended:
            later.append((run.started, run.until, run.duration_s))
            if punctual:
                later.append((run.until, run.started, -run.duration_s))
        elif punctual:
            later.append((run.until, run.started, apart_s - run.duration_s))
    return later


class Ages:
    """Takes down what the way asks for. Blocks are told by the numbers that they have in its states, which change."""

    def __init__(self) -> None:
        self._events: list[int] = []
        """For each block which of the events completes it."""
        self._older: dict[int, set[int]] = {}
        """For each event those with older blocks."""

    def completed(self, ordinal: int) -> None:
        """The next event completes this block."""
        assert ordinal == len(self._events) + 1, "blocks are numbered as they are completed"
        self._older[len(self._events)] = set()
        self._events.append(len(self._events))

    def renumber(self, blocks: Ordinals) -> None:
        """From now on these blocks are the first, the second, and so on; those that nobody has come after them."""
        if blocks:
            rest = [ordinal for ordinal in range(1, len(self._events) + 1) if ordinal not in blocks]
            self._events = [self._events[ordinal - 1] for ordinal in (*blocks, *rest)]

    def asked(self, oldest: int, others: Collection[int]) -> None:
        """One block has to be older than others; the inception block is, anyway."""
        for other in others if oldest else ():
            self._older[self._events[other - 1]].add(self._events[oldest - 1])

    def date(self, events: list[dict[str, Any]]) -> bool:
        """Let the events have timestamps of which that is true, if it is not true as they are.

        False if no timestamps make it true: a tie goes one way now and another way then, or an agent's clock goes back.
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
