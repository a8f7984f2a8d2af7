"""Compute the states from which the swarm reaches a goal, regardless of which timer expires next."""

from array import array
from collections.abc import Callable, Iterable, Sequence
from itertools import accumulate

ByTimer = tuple[tuple[int, ...], ...]
"""The numbers of the possible successors of a state: one group for each timer that may expire next."""

Check = Callable[[], object]
"""A function that is called repeatedly during the computation. It raises LimitReachedError when the limit of memory or
time is reached.
"""


class BackwardReachableStates:
    """A growing set of states: goals, and all states from which the swarm reaches a goal.

    In most states, several timers may expire next. Each of these timers must lead to a goal, unless timers expire in
    `any_order`. If timers must expire at the same moment, only the transit times of messages determine their order, so
    one order that leads to a goal is enough.
    """

    def __init__(self, by_timer: Sequence[ByTimer], any_order: bool, check: Check = lambda: None) -> None:
        self._check = check
        self._any_order = any_order
        self._inside = bytearray(len(by_timer))
        self._open = array("q", map(len, by_timer))
        """State -> the number of its timers that are not yet known to lead to a goal."""
        self._whose = array("q", (number for number, choices in enumerate(by_timer) for _ in choices))
        """The state to which each timer belongs. The timers of all states are numbered consecutively."""
        self._leads = bytearray(len(self._whose))
        self._ends = _ends(by_timer, check)
        """The predecessors of state n are in `_before`, from `_ends[n]` up to `_ends[n + 1]`. Each is stored as the
        number of the timer whose expiry leads to state n.
        """
        self._before = array("q", bytes(8 * self._ends[-1]))
        filled = self._ends[:]
        timers = (after for choices in by_timer for after in choices)
        for timer, after in enumerate(timers):
            for number in after:
                self._before[filled[number]] = timer
                filled[number] += 1

    def __contains__(self, number: int) -> bool:
        return bool(self._inside[number])

    @property
    def left(self) -> int:
        """The number of states that are not in the set."""
        return self._inside.count(0)

    @property
    def first_left(self) -> int:
        """The first state outside the set. It is -1 if all states are in the set."""
        return self._inside.find(0)

    def add(self, goals: Iterable[int]) -> None:
        """Add goals, and then all states that lead to a goal."""
        waiting = [number for number in goals if not self._inside[number]]
        for number in waiting:
            self._inside[number] = 1
        while waiting:
            self._check()
            number = waiting.pop()
            for timer in self._before[self._ends[number] : self._ends[number + 1]]:
                if self._leads[timer]:
                    continue
                self._leads[timer] = 1
                whose = self._whose[timer]
                self._open[whose] -= 1
                if not self._inside[whose] and (self._any_order or not self._open[whose]):
                    self._inside[whose] = 1
                    waiting.append(whose)


def _ends(by_timer: Sequence[ByTimer], check: Check) -> "array[int]":
    """Return, for each state, the index at which the list of its predecessors begins in one flat array.

    The last entry is the number of all transitions.
    """
    count = array("q", bytes(8 * (len(by_timer) + 1)))
    for choices in by_timer:
        check()
        for after in choices:
            for number in after:
                count[number + 1] += 1
    return array("q", accumulate(count))
