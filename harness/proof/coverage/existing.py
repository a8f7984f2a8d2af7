"""What exists within bounds: all local states and inputs that `harness.proof` sees, by the numbers of `reached`."""

from dataclasses import dataclass

from harness.proof.bounds import Bounds
from harness.proof.graph.exploration import explore
from harness.proof.model.any_sender import collect
from harness.proof.model.global_states import Swarm
from harness.proof.model.known_states import DEAD
from harness.proof.model.local_steps import LocalStates
from harness.proof.model.shape import Held, Shape, shape_of
from harness.proof.progress_bar import Ended


@dataclass
class Existing:
    """Numbers of the local states, and of the pairs, that there are within `bounds`; all, if `ended` is "complete"."""

    bounds: Bounds
    states: set[int]
    pairs: set[int]
    ended: Ended = "complete"


def existing(bounds: Bounds, *, most_bytes: float = 4e9, most_s: float = float("inf")) -> Existing:
    """All that exists, or what memory and time allow to see of it."""
    there = Existing(bounds, set(), set())
    if bounds.network == "any":
        collected = collect(bounds, most_bytes=most_bytes, most_s=most_s, keep=lambda local: _add(there, local))
        there.ended = collected.ended
    else:
        swarm = Swarm(bounds, every_count=True)
        there.ended = explore(swarm, most_bytes=most_bytes, most_s=most_s).ended
        _add(there, swarm.local)
    return there


def _add(there: Existing, local: LocalStates) -> None:
    shapes: list[tuple[Held, Shape, int]] = []
    for number in range(len(local.known)):
        state = local.state(number)
        held = Held(state)
        shape = shape_of(state, held)
        shapes.append((held, shape, held.number(shape)))
    there.states.update(number for _, _, number in shapes)
    for before, given, step in local.inputs():
        held, shape, number = shapes[before]
        if step.local == DEAD or (shapes[step.local][2] == number and not step.sent):
            continue
        if isinstance(given, str):
            there.pairs.add(held.number((shape, ("timer", given))))
        else:
            there.pairs.add(held.number((shape, ("event",) if given is None else held.input_shape(given))))
