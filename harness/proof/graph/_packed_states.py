"""What is kept of each of millions of states, in less room than tuples take."""

from array import array
from collections.abc import Sequence
from itertools import islice
from struct import Struct
from typing import overload

from harness.proof.model._global_states import AGENTS, State
from harness.proof.questions._attractor import ByTimer


class States(Sequence[State]):
    """Different states of so many agents by number, in the order in which they were added; each as a row of bytes."""

    def __init__(self, agents: int) -> None:
        self._form = Struct(f"={AGENTS + agents}i")
        self._rows: list[bytes] = []
        self._numbers: dict[bytes, int] = {}

    def add(self, state: State) -> int:
        """Its number; the next one if there is no such state yet."""
        row = self._form.pack(*state)
        number = self._numbers.setdefault(row, len(self._rows))
        if number == len(self._rows):
            self._rows.append(row)
        return number

    def __len__(self) -> int:
        return len(self._rows)

    @overload
    def __getitem__(self, number: int) -> State: ...
    @overload
    def __getitem__(self, number: slice) -> list[State]: ...
    def __getitem__(self, number: int | slice) -> State | list[State]:
        if isinstance(number, slice):
            return [self._form.unpack(row) for row in self._rows[number]]
        return self._form.unpack(self._rows[number])


class Followers(Sequence[ByTimer]):
    """What follows each state, by timer: the numbers of one after the other, each timer's behind how many they are."""

    def __init__(self) -> None:
        self._flat = array("i")
        self._ends = array("q", [0])
        """What follows state n is in `_flat`, from `_ends[n]` up to `_ends[n + 1]`."""

    def append(self, by_timer: ByTimer) -> None:
        for after in by_timer:
            self._flat.append(len(after))
            self._flat.extend(after)
        self._ends.append(len(self._flat))

    def __len__(self) -> int:
        return len(self._ends) - 1

    @overload
    def __getitem__(self, number: int) -> ByTimer: ...
    @overload
    def __getitem__(self, number: slice) -> list[ByTimer]: ...
    def __getitem__(self, number: int | slice) -> ByTimer | list[ByTimer]:
        if isinstance(number, slice):
            return [self[at] for at in range(*number.indices(len(self)))]
        if not 0 <= number < len(self):
            raise IndexError(number)
        numbers = iter(self._flat[self._ends[number] : self._ends[number + 1]])
        return tuple(tuple(islice(numbers, count)) for count in numbers)
