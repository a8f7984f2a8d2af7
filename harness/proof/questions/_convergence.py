"""Whether the swarm can always come to rest with one chain, and whether a cycle lasts for ever.

Both are asked of what follows when nothing is lost any more and no new block comes, beside some more votes.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial

from harness.proof.graph._expansion import cycles_left_alone
from harness.proof.graph._exploration import Graph
from harness.proof.graph._workers import Crew
from harness.proof.questions._attractor import Attractor, Check
from harness.proof.questions._extra_votes import UndecidedError, Votes
from harness.proof.questions._graph_cycles import cycles

Watch = Callable[[str], None]
"""Is told again and again what is asked now, and raises GivenUpError when memory or time have come to an end."""


@dataclass
class Liveness:
    """`forks`: states at rest with several chains, of which `fork` is the nearest. `cycles`: ways round, each as the
    states on it, the nearest first.

    `astray`: how many states have no way to rest with one chain if there are 0, 1, 2, ... more votes, until it is none,
    or there was one vote for each agent. `lost` is the nearest of those that are left then, `reluctant` the nearest of
    those for which one is not enough.
    """

    forks: int = 0
    fork: int | None = None
    cycles: list[list[int]] = field(default_factory=list)
    astray: list[int] = field(default_factory=list)
    lost: int | None = None
    reluctant: int | None = None
    decided: bool = True
    """Whether all that follows more votes was looked at."""


@cycles_left_alone()
def look(graph: Graph, watch: Watch = lambda asked: None, crew: Crew | None = None) -> Liveness:
    """Of a graph that is complete; a crew, if there is one, lets those vote who are at rest with several chains."""
    at_rest = dict(_at_rest(graph, partial(watch, "idle states")))
    forks = [number for number, chains in at_rest.items() if chains > 1]
    result = Liveness(len(forks), forks[0] if forks else None, cycles(graph, partial(watch, "cycles")))
    safe = Attractor(graph.quiet, graph.swarm.bounds.timers_any, partial(watch, "paths to one chain"))
    safe.add(number for number, chains in at_rest.items() if chains <= 1)
    result.astray.append(safe.left)
    if not safe.left:
        return result
    try:
        needed = _needed(graph, forks, watch, crew)
    except UndecidedError:
        result.decided = False
        return result
    for votes in range(1, graph.swarm.bounds.agents + 1):
        safe.add(fork for fork, need in needed.items() if need is not None and need <= votes)
        result.astray.append(safe.left)
        if not safe.left:
            return result
        if votes == 1:
            result.reluctant = safe.first_left
    result.lost = safe.first_left
    return result


def _at_rest(graph: Graph, check: Check) -> Iterator[tuple[int, int]]:
    """Each state at rest, and how many chains there are."""
    for number, by_timer in enumerate(graph.quiet):
        check()
        state = graph.states[number]
        if not by_timer and graph.swarm.is_idle(state):
            yield number, len(graph.swarm.chains(state))


def _needed(graph: Graph, forks: Sequence[int], watch: Watch, crew: Crew | None) -> dict[int, int | None]:
    """How many more votes each of these states needs; None if one for each agent is not enough."""
    needed: dict[int, int | None] = {}

    def check() -> None:
        watch(f"what votes lead to ({len(needed):,} of {len(forks):,} forks)")

    states = [graph.states[number] for number in forks]
    shared = crew if crew is not None and crew.is_worth_it(len(states)) else None
    votes = map(Votes(graph.swarm, check).needed, states) if shared is None else shared.needed(states, check)
    for fork, need in zip(forks, votes, strict=True):
        needed[fork] = need
    return needed
