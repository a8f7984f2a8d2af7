"""From which states a goal is come to, whichever timer is the next to end."""

from array import array
from collections.abc import Callable, Iterable, Sequence
from itertools import accumulate

ByTimer = tuple[tuple[int, ...], ...]
"""For each timer of a state that may be the next to end the numbers of the states that may follow if it does."""

Check = Callable[[], object]
"""Is called again and again, and raises GivenUpError when memory or time have come to an end."""


class Attractor:
    """States, by number, of which some are in: the goals, and all from which some way leads to them.

    The durations decide which timer is next, and a zone does not tell: so all that it leaves open have to lead there,
    unless timers end in `any_order`. Of timers that have to end at the same moment only how long messages take decides
    which is first: any may be.
    """

    def __init__(self, by_timer: Sequence[ByTimer], any_order: bool, check: Check = lambda: None) -> None:
        self._check = check
        self._any_order = any_order
        self._inside = bytearray(len(by_timer))
        self._open = array("q", map(len, by_timer))
        """Of each state how many of its timers do not lead to the goals yet."""
        self._whose = array("q", (number for number, choices in enumerate(by_timer) for _ in choices))
        """Of each timer, all counted one after the other, whose it is."""
        self._leads = bytearray(len(self._whose))
        self._ends = _ends(by_timer, check)
        """The timers that may lead to state n are in `_before`, from `_ends[n]` up to `_ends[n + 1]`."""
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
        """How many states are not in."""
        return self._inside.count(0)

    @property
    def first_left(self) -> int:
        """The first that is not; -1 if all are."""
        return self._inside.find(0)

    def add(self, goals: Iterable[int]) -> None:
        """These are goals, too."""
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
    """How many timers may lead to states before each, and in the end, to all."""
    count = array("q", bytes(8 * (len(by_timer) + 1)))
    for choices in by_timer:
        check()
        for after in choices:
            for number in after:
                count[number + 1] += 1
    return array("q", accumulate(count))
