"""When the instants of a way through the graph were: mission seconds that the timers' durations allow.

Every instant is a variable, every duration a bound on a difference of two; the shortest paths over the bounds are a
solution (Bellman and Ford), if there is one.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf

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
    assert earliest is not None, "the way was found"
    assert latest is not None, "the way was found"
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
