"""Expand one state, with Python's cycle collector switched off."""

import gc
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import chain
from typing import NamedTuple

from harness.proof.model._global_states import State, Swarm
from harness.proof.model._instant import Actions

NumberOf = Callable[[State], int]
_Following = dict[Actions, dict[int, None]]
"""The states that may follow, in order, by what happens."""


class Expansion(NamedTuple):
    """What may follow one state, in `ways`; the rest by numbers of states: nobody loses anything, no block comes.

    `by_timer` has for each timer that may end next what may follow if it does: it ends alone, or others that have to
    end at that very moment end before it or with it. `crossing` has what may follow if any that may end at once do.
    """

    ways: int
    by_timer: tuple[tuple[int, ...], ...]
    crossing: tuple[int, ...]


def expanded(swarm: Swarm, state: State, number_of: NumberOf) -> Expansion:
    """All that can follow this state; `number_of` is asked for all of it, in order."""
    lossy = swarm.bounds.network == "lossy"
    ways = 0
    losing_nothing: _Following = {}
    ending = [*swarm.ending(state)]
    for actions in swarm.actions(state, ending):
        numbers = [number_of(after) for after in swarm.after(state, actions, lossy)]
        ways += len(numbers)
        if not lossy:
            losing_nothing[actions] = dict.fromkeys(numbers)
    return _quiet(swarm, state, number_of, ending, losing_nothing)._replace(ways=ways)


def quiet(swarm: Swarm, state: State, number_of: NumberOf) -> Expansion:
    """Where the state goes on when nothing is lost and no new block comes."""
    return _quiet(swarm, state, number_of, [*swarm.ending(state)], {})


def _quiet(swarm: Swarm, state: State, number_of: NumberOf, ending: Sequence[Actions], known: _Following) -> Expansion:
    """The same; `known` may have some of it."""
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
    return Expansion(0, tuple(by_timer), tuple(crossing))


@contextmanager
def cycles_left_alone() -> Iterator[None]:
    """Python's collector rests; in processes that are forked meanwhile, for good."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()
