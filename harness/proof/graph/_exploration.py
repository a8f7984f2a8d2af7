"""Explore all reachable states of a swarm, breadth first. The first violation found therefore has a shortest path.

For each state, the graph also keeps the successors without a lost message and without a new block (`quiet`).
`../questions/_convergence.py` uses them.
"""

from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial

from harness.proof._progress_bar import LOOK_EVERY, Ended, ExplorationBudget, ExplorationProgress, LimitReachedError
from harness.proof.graph._expansion import StateExpansion, StateStore, SuccessorStore, cycles_left_alone, expanded
from harness.proof.graph._workers import Workers
from harness.proof.model._flaws import PropertyViolation
from harness.proof.model._global_states import ModelSwarm, State

NO_PARENT = -1


@dataclass
class StateGraph:
    """The explored states by number, and a predecessor of each state. If `ended` is "complete", the graph contains all
    reachable states.
    """

    swarm: ModelSwarm
    exact: bool = False
    """True if a state represents only itself. If false, it may also represent states whose timers have fewer possible
    values.
    """
    states: StateStore = field(init=False)
    parents: "array[int]" = field(default_factory=lambda: array("q"))
    """The state from which each state was first reached."""
    quiet: SuccessorStore = field(default_factory=SuccessorStore)
    """State -> its successors without a lost message and without a new block, by the timer that expires."""
    crossing: dict[int, tuple[int, ...]] = field(default_factory=dict)
    """State -> its successors in which several timers expire at the same moment, so that messages cross."""
    transitions: int = 0
    depth: int = 0
    seconds: float = 0.0
    looked_at: int = 0
    ended: Ended = "complete"
    flawed: int | None = None
    """The number of the first state with a violation. None if no state has one."""
    shown: dict[str, int] = field(default_factory=dict)
    """Characteristic -> the number of the first state in which an attacker has violated this characteristic although
    the agents are correct.
    """
    workers_bytes: float = 0.0
    workers_s: float = 0.0
    workers_steps: int = 0
    """Memory and processor time of the workers, and the number of agent steps that they have computed."""

    def __post_init__(self) -> None:
        self.states = StateStore(self.swarm.bounds.agents, None if self.exact else self.swarm.contains)

    @property
    def flaw(self) -> PropertyViolation | None:
        return None if self.flawed is None else self.swarm.flaw(self.states[self.flawed])

    def reach(self, state: State, parent: int) -> int:
        """Return the number of a state. If the state is new, add it and check it for violations."""
        number = self.states.add(state)
        if number == len(self.parents):
            self.parents.append(parent)
            if self.flawed is None and self.swarm.flaw(state) is not None:
                self.flawed = number
            if self.swarm.bounds.captured is not None:
                for key in self.swarm.violated(state):
                    self.shown.setdefault(key, number)
        return number

    def take_in(self, expansion: StateExpansion) -> None:
        """Store the successors of the next state. Call this method exactly once for each state, in the order of the
        state numbers.
        """
        number = len(self.quiet)
        self.transitions += expansion.transitions
        self.quiet.append(expansion.by_timer)
        if expansion.crossing:
            self.crossing[number] = expansion.crossing

    def progress(self, seconds: float, asked: str | None = None) -> ExplorationProgress:
        return ExplorationProgress(len(self.states), self.looked_at, self.transitions, self.depth, seconds, asked)

    def path(self, number: int) -> list[int]:
        """Return the states on the path from the initial state to this state."""
        path = [number]
        while (parent := self.parents[path[-1]]) != NO_PARENT:
            path.append(parent)
        return path[::-1]


@cycles_left_alone()
def explore(
    swarm: ModelSwarm,
    *,
    most_bytes: float,
    most_s: float,
    workers: Workers | None = None,
    watch: Callable[[ExplorationProgress], None] = lambda progress: None,
) -> StateGraph:
    """Explore all states, until a limit of memory or time is reached or a violation is found.

    The result does not depend on the use of workers.
    """
    graph, budget = StateGraph(swarm), ExplorationBudget(most_bytes, most_s)
    try:
        for progress in _all(graph, budget, workers):
            watch(progress)
            ended = "flaw" if graph.flawed is not None else budget.ended(graph.workers_bytes)
            if ended is not None:
                graph.ended = ended
                break
    except LimitReachedError as given_up:
        graph.ended = given_up.ended
    except KeyboardInterrupt:
        graph.ended = "interrupted"
    graph.seconds = budget.seconds
    return graph


def _all(graph: StateGraph, budget: ExplorationBudget, workers: Workers | None) -> Iterator[ExplorationProgress]:
    graph.reach(graph.swarm.initial, NO_PARENT)
    layer_ends = 1
    for looked_at, expansion in enumerate(_expansions(graph, budget, workers), 1):
        graph.take_in(expansion)
        graph.looked_at = looked_at
        if looked_at == layer_ends:
            graph.depth += 1
            layer_ends = len(graph.states)
        if looked_at % LOOK_EVERY == 0 or graph.flawed is not None:
            yield graph.progress(budget.seconds)


def _expansions(graph: StateGraph, budget: ExplorationBudget, workers: Workers | None) -> Iterator[StateExpansion]:
    """Yield the successors of each state in order, including states that are added during the loop.

    If many states are waiting, worker processes compute their successors.
    """
    swarm, states, looked_at = graph.swarm, graph.states, 0
    while looked_at < len(states):
        if workers is not None and workers.pays_off(len(states) - looked_at):
            for expansion in workers.expansions(
                states, looked_at, graph.reach, lambda: budget.check(workers.memory_bytes)
            ):
                graph.workers_bytes, graph.workers_s, graph.workers_steps = (
                    workers.memory_bytes,
                    workers.processor_s,
                    workers.steps,
                )
                yield expansion
            return
        yield expanded(swarm, states[looked_at], partial(graph.reach, parent=looked_at))
        looked_at += 1
