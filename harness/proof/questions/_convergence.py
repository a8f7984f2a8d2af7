"""Find states from which the swarm cannot become idle with one common chain, and cycles that never end.

The search follows only successors without a lost message and without a new block, except the blocks of further votes.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial

from harness.proof.graph._expansion import cycles_left_alone
from harness.proof.graph._exploration import StateGraph
from harness.proof.graph._workers import Workers
from harness.proof.model._flaws import PropertyViolation
from harness.proof.questions._attractor import BackwardReachableStates, Check
from harness.proof.questions._extra_votes import ExtraVotes, UndecidedError
from harness.proof.questions._graph_cycles import cycles

Watch = Callable[[str], None]
"""A function that is called repeatedly with the question that is being answered. It raises LimitReachedError when the
limit of memory or time is reached.
"""


@dataclass
class ConvergenceResult:
    """The result of the search: endless cycles, and states from which the swarm does not reach one common chain.

    - `forks`: number of idle states with several different chains. `fork` is the one of these states that is nearest to
      the initial state.
    - `cycles`: cycles as lists of their states. The cycle nearest to the initial state is first.
    - `astray`: numbers of states. Element n is the number of states from which the swarm cannot become idle with one
      chain even after n further votes. The last element is 0, or belongs to as many votes as agents exist.
    - `lost`: the nearest state for which one vote of each agent is not enough.
    - `reluctant`: the nearest state for which one vote is not enough.
    - `flaw`: a violation after further votes. It ended a path that might have led to one chain.
    """

    forks: int = 0
    fork: int | None = None
    cycles: list[list[int]] = field(default_factory=list)
    astray: list[int] = field(default_factory=list)
    lost: int | None = None
    reluctant: int | None = None
    flaw: PropertyViolation | None = None
    decided: bool = True
    """True if all states after further votes could be explored."""


@cycles_left_alone()
def look(graph: StateGraph, watch: Watch = lambda asked: None, workers: Workers | None = None) -> ConvergenceResult:
    """Search a complete state graph for endless cycles and for states that do not lead to one chain. The `workers`
    compute the number of votes that idle states with different chains need.
    """
    idle_states = dict(_idle_states(graph, partial(watch, "idle states")))
    forks = [number for number, chains in idle_states.items() if chains > 1]
    result = ConvergenceResult(len(forks), forks[0] if forks else None, [*cycles(graph, partial(watch, "cycles"))])
    safe = BackwardReachableStates(graph.quiet, graph.swarm.bounds.timers_any, partial(watch, "paths to one chain"))
    safe.add(number for number, chains in idle_states.items() if chains <= 1)
    result.astray.append(safe.left)
    if not safe.left:
        return result
    try:
        needed = _needed(graph, forks, watch, workers)
    except UndecidedError:
        result.decided = False
        return result
    for votes in range(1, graph.swarm.bounds.agents + 1):
        safe.add(fork for fork, need in needed.items() if isinstance(need, int) and need <= votes)
        result.astray.append(safe.left)
        if not safe.left:
            return result
        if votes == 1:
            result.reluctant = safe.first_left
    result.lost = safe.first_left
    result.flaw = next((need for need in needed.values() if isinstance(need, PropertyViolation)), None)
    return result


def _idle_states(graph: StateGraph, check: Check) -> Iterator[tuple[int, int]]:
    """Yield each idle state, with the number of its different chains."""
    for number, by_timer in enumerate(graph.quiet):
        check()
        state = graph.states[number]
        if not by_timer and graph.swarm.is_idle(state):
            yield number, len(graph.swarm.chains(state))


def _needed(
    graph: StateGraph, forks: Sequence[int], watch: Watch, workers: Workers | None
) -> dict[int, int | PropertyViolation | None]:
    """Return the number of further votes that each of these states needs. If one vote for each agent is not enough, the
    dictionary contains instead the violation that ended a path, or None.
    """
    needed: dict[int, int | PropertyViolation | None] = {}

    def check() -> None:
        watch(f"what votes lead to ({len(needed):,} of {len(forks):,} forks)")

    states = [graph.states[number] for number in forks]
    shared = workers if workers is not None and workers.pays_off(len(states)) else None
    votes = map(ExtraVotes(graph.swarm, check).needed, states) if shared is None else shared.needed(states, check)
    for fork, need in zip(forks, votes, strict=True):
        needed[fork] = need
    return needed
