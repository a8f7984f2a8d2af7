"""Every global state that can be reached, breadth first: so the first that has a flaw is as near as any.

Of each state it is also kept where it goes on losing nothing and with no new block (`quiet`), for
`../questions/convergence.py`.
"""

from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial

from harness.proof._progress_bar import LOOK_EVERY, Budget, Ended, GivenUpError, Progress
from harness.proof.graph._expansion import Expansion, Followers, States, cycles_left_alone, expanded
from harness.proof.graph._workers import Crew
from harness.proof.model._flaws import Flaw
from harness.proof.model._global_states import State, Swarm

NO_PARENT = -1


@dataclass
class Graph:
    """The states by number, and how each was come to first. `ended` is "complete" if there are no others.

    `quiet` has for each state and each timer that may end next the states that may follow if nobody loses anything, and
    `crossing` those that may follow if several end at once: both as `Expansion` has them.
    """

    swarm: Swarm
    states: States = field(init=False)
    parents: "array[int]" = field(default_factory=lambda: array("q"))
    quiet: Followers = field(default_factory=Followers)
    crossing: dict[int, tuple[int, ...]] = field(default_factory=dict)
    transitions: int = 0
    depth: int = 0
    seconds: float = 0.0
    looked_at: int = 0
    ended: Ended = "complete"
    flawed: int | None = None
    shown: dict[str, int] = field(default_factory=dict)
    """The first state, by characteristic, after each of what a captor can do that is no flaw of the agents."""
    crew_bytes: float = 0.0
    crew_s: float = 0.0
    crew_steps: int = 0
    """Memory and processor time of other processes, and the steps that they have computed."""

    def __post_init__(self) -> None:
        self.states = States(self.swarm.bounds.agents)

    @property
    def flaw(self) -> Flaw | None:
        return None if self.flawed is None else self.swarm.flaw(self.states[self.flawed])

    def reach(self, state: State, parent: int) -> int:
        """Its number; a new one if it is new. It should have no flaw."""
        number = self.states.add(state)
        if number == len(self.parents):
            self.parents.append(parent)
            if self.flawed is None and self.swarm.flaw(state) is not None:
                self.flawed = number
            if self.swarm.bounds.captured is not None:
                for key in self.swarm.violated(state):
                    self.shown.setdefault(key, number)
        return number

    def take_in(self, expansion: Expansion) -> None:
        """What follows the next state of which that is not known yet."""
        number = len(self.quiet)
        self.transitions += expansion.ways
        self.quiet.append(expansion.by_timer)
        if expansion.crossing:
            self.crossing[number] = expansion.crossing

    def progress(self, seconds: float, asked: str | None = None) -> Progress:
        return Progress(len(self.states), self.looked_at, self.transitions, self.depth, seconds, asked)

    def path(self, number: int) -> list[int]:
        """The states on the way to this one, from the beginning."""
        path = [number]
        while (parent := self.parents[path[-1]]) != NO_PARENT:
            path.append(parent)
        return path[::-1]


@cycles_left_alone()
def explore(
    swarm: Swarm,
    *,
    most_bytes: float,
    most_s: float,
    crew: Crew | None = None,
    watch: Callable[[Progress], None] = lambda progress: None,
) -> Graph:
    """All states, or as many as memory and time allow, or up to the first that has a flaw.

    What comes out is the same whether there is a crew or not.
    """
    graph, budget = Graph(swarm), Budget(most_bytes, most_s)
    try:
        for progress in _all(graph, budget, crew):
            watch(progress)
            ended = "flaw" if graph.flawed is not None else budget.ended(graph.crew_bytes)
            if ended is not None:
                graph.ended = ended
                break
    except GivenUpError as given_up:
        graph.ended = given_up.ended
    except KeyboardInterrupt:
        graph.ended = "interrupted"
    graph.seconds = budget.seconds
    return graph


def _all(graph: Graph, budget: Budget, crew: Crew | None) -> Iterator[Progress]:
    graph.reach(graph.swarm.initial, NO_PARENT)
    layer_ends = 1
    for looked_at, expansion in enumerate(_expansions(graph, budget, crew), 1):
        graph.take_in(expansion)
        graph.looked_at = looked_at
        if looked_at == layer_ends:
            graph.depth += 1
            layer_ends = len(graph.states)
        if looked_at % LOOK_EVERY == 0 or graph.flawed is not None:
            yield graph.progress(budget.seconds)


def _expansions(graph: Graph, budget: Budget, crew: Crew | None) -> Iterator[Expansion]:
    """What follows each state, in order, also of those that are reached meanwhile; by a crew if it is many."""
    swarm, states, looked_at = graph.swarm, graph.states, 0
    while looked_at < len(states):
        if crew is not None and crew.is_worth_it(len(states) - looked_at):
            for expansion in crew.expansions(states, looked_at, graph.reach, lambda: budget.check(crew.memory_bytes)):
                graph.crew_bytes, graph.crew_s, graph.crew_steps = crew.memory_bytes, crew.processor_s, crew.steps
                yield expansion
            return
        yield expanded(swarm, states[looked_at], partial(graph.reach, parent=looked_at))
        looked_at += 1
