"""What may follow one state."""

from collections.abc import Callable
from typing import NamedTuple

from harness.prove.swarm import State, Swarm

NumberOf = Callable[[State], int]


class Expansion(NamedTuple):
    """What may follow one state, in `ways`. The rest is by the numbers of states.

    `alone` has for each timer that may end next what may follow if it ends alone, nobody loses anything, and no new
    block comes; `crossing` what may follow if several end at once.
    """

    ways: int
    alone: tuple[tuple[int, ...], ...]
    crossing: tuple[int, ...]


def expanded(swarm: Swarm, state: State, number_of: NumberOf) -> Expansion:
    """All that can follow this state; `number_of` is asked for all of it, in order."""
    lossy = swarm.bounds.network == "lossy"
    ways = 0
    for actions in swarm.actions(state):
        for after in swarm.after(state, actions, lossy):
            ways += 1
            number_of(after)
    return quiet(swarm, state, number_of)._replace(ways=ways)


def quiet(swarm: Swarm, state: State, number_of: NumberOf) -> Expansion:
    """Where the state goes on when nothing is lost and no new block comes."""
    alone: list[tuple[int, ...]] = []
    crossing: dict[int, None] = {}
    for actions in swarm.ending(state):
        numbers = dict.fromkeys(map(number_of, swarm.after(state, actions, lossy=False)))
        if len(actions) == 1:
            alone.append(tuple(numbers))
        else:
            crossing |= numbers
    return Expansion(0, tuple(alone), tuple(crossing))
