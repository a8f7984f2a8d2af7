"""Compute the successors of a state, and store states and successors compactly."""

import gc
from array import array
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import chain, islice
from struct import Struct
from typing import NamedTuple, overload

from harness.proof.model._global_states import AGENTS, ZONE, ModelSwarm, State
from harness.proof.model._instant import Actions
from harness.proof.questions._attractor import ByTimer

NumberOf = Callable[[State], int]
_Following = dict[Actions, dict[int, None]]
"""The actions at one moment -> the numbers of the possible successor states, in order."""


class StateExpansion(NamedTuple):
    """The successors of one state of the swarm. `transitions` is the number of transitions from this state.

    The other fields contain only successors without a lost message and without a new block. `by_timer` contains a group
    of successors for each timer that may expire next. In the successors of a group, this timer has expired, and in some
    of them also timers that must expire at the same moment. `crossing` contains the successors in which several timers
    expire at the same moment.
    """

    transitions: int
    by_timer: tuple[tuple[int, ...], ...]
    crossing: tuple[int, ...]


def expanded(swarm: ModelSwarm, state: State, number_of: NumberOf) -> StateExpansion:
    """Return the successors of a state. `number_of` is a function that stores a successor and returns its number."""
    lossy = swarm.bounds.network == "lossy"
    transitions = 0
    losing_nothing: _Following = {}
    ending = [*swarm.ending(state)]
    for actions in swarm.actions(state, ending):
        numbers = [number_of(after) for after in swarm.after(state, actions, lossy)]
        transitions += len(numbers)
        if not lossy:
            losing_nothing[actions] = dict.fromkeys(numbers)
    return _quiet(swarm, state, number_of, ending, losing_nothing)._replace(transitions=transitions)


def quiet(swarm: ModelSwarm, state: State, number_of: NumberOf) -> StateExpansion:
    """Return the successors of a state that are reached without a lost message and without a new block. In the result,
    `transitions` is 0.
    """
    return _quiet(swarm, state, number_of, [*swarm.ending(state)], {})


def _quiet(
    swarm: ModelSwarm, state: State, number_of: NumberOf, ending: Sequence[Actions], known: _Following
) -> StateExpansion:
    """Return the successors that are reached without a lost message and without a new block. `known` may already
    contain some of these successors.
    """
    after = {
        actions: known[actions]
        if actions in known
        else dict.fromkeys(map(number_of, swarm.after(state, actions, lossy=False)))
        for actions in ending
    }
    by_timer = []
    for action, tied in swarm.alternatives(state):
        if (action,) in after:
            choices = [after[actions] for actions in after if tied.issuperset(actions)]
            by_timer.append(tuple(dict.fromkeys(chain.from_iterable(choices))))
    crossing = dict.fromkeys(chain.from_iterable(after[actions] for actions in after if len(actions) > 1))
    return StateExpansion(0, tuple(by_timer), tuple(crossing))


@contextmanager
def cycles_left_alone() -> Iterator[None]:
    """Switch off Python's garbage collection of reference cycles inside the context. It also stays off in processes
    that are forked inside the context.
    """
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


class StateStore(Sequence[State]):
    """The states of a swarm as bytes, numbered in the order in which they were added.

    A state contains a zone, a set of possible remaining times of the timers. The function `contains` takes two zones,
    and returns true if the first one contains all times of the second one. Suppose that a stored and a new state differ
    only in their zones, and that the stored zone contains the new one. Each run from the new state is then also a run
    from the stored state, so the new state gets the number of the stored state. Without `contains`, only equal states
    have the same number.
    """

    def __init__(self, agents: int, contains: Callable[[int, int], bool] | None = None) -> None:
        self._form = Struct(f"={AGENTS + agents}i")
        self._contains = contains
        self._rows: list[bytes] = []
        self._zones = array("i")
        self._numbers: dict[bytes, tuple[int, ...]] = {}

    @property
    def exact(self) -> bool:
        """True if only equal states have the same number."""
        return self._contains is None

    def add(self, state: State) -> int:
        """Return the number of a state. If no stored state represents it, add it with the next free number."""
        zone, contains = state[ZONE], self._contains
        key = self._form.pack(*state if contains is None else (*state[:ZONE], 0, *state[AGENTS:]))
        alike = self._numbers.get(key, ())
        for number in alike:
            if self._zones[number] == zone or (contains is not None and contains(self._zones[number], zone)):
                return number
        number = self.append(state)
        self._numbers[key] = (*alike, number)
        return number

    def append(self, state: State) -> int:
        """Store a state even if a stored state represents it. Return its number."""
        self._rows.append(self._form.pack(*state))
        self._zones.append(state[ZONE])
        return len(self._rows) - 1

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


class SuccessorStore(Sequence[ByTimer]):
    """The successors of each state, grouped by the timer that expires. One flat array contains all groups. For each
    group, the array contains the number of successors and then the successors.
    """

    def __init__(self) -> None:
        self._flat = array("i")
        self._ends = array("q", [0])
        """Index of a state -> the index in `_flat` at which its successors begin. They end where the successors of the
        next state begin.
        """

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
