"""Every global state that can be reached, breadth first: so the first that has a flaw is as near as any.

Of each state it is also kept where it goes on losing nothing and with no new block (`quiet`), for `liveness.py`.
"""

import time
from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from harness.prove.local import Flaw
from harness.prove.progress import Ended, Progress, memory_bytes
from harness.prove.swarm import State, Swarm

LOOK_EVERY = 200
"""States between two looks at memory, clock and whoever watches."""
NO_PARENT = -1


@dataclass
class Graph:
    """The states by number, and how each was come to first. `ended` is "complete" if there are no others.

    `quiet` has for each state and each timer that may end next the states that may follow if this one ends alone and
    nobody loses anything; `crossing` those that may follow if several end at once.
    """

    swarm: Swarm
    states: list[State] = field(default_factory=list)
    number: dict[State, int] = field(default_factory=dict)
    parents: "array[int]" = field(default_factory=lambda: array("q"))
    quiet: list[tuple[tuple[int, ...], ...]] = field(default_factory=list)
    crossing: dict[int, tuple[int, ...]] = field(default_factory=dict)
    transitions: int = 0
    depth: int = 0
    seconds: float = 0.0
    reached: int = 0
    """States that were reached; `liveness.py` adds others, with more blocks."""
    looked_at: int = 0
    ended: Ended = "complete"
    flawed: int | None = None

    @property
    def flaw(self) -> Flaw | None:
        return None if self.flawed is None else self.swarm.flaw(self.states[self.flawed])

    def add(self, state: State, parent: int) -> int:
        """Its number; a new one if it is new."""
        number = self.number.setdefault(state, len(self.states))
        if number == len(self.states):
            self.states.append(state)
            self.parents.append(parent)
        return number

    def path(self, number: int) -> list[int]:
        """The states on the way to this one, from the beginning."""
        path = [number]
        while (parent := self.parents[path[-1]]) != NO_PARENT:
            path.append(parent)
        return path[::-1]


def explore(
    swarm: Swarm,
    *,
    most_bytes: float,
    most_s: float,
    watch: Callable[[Progress], None] = lambda progress: None,
) -> Graph:
    """All states, or as many as memory and time allow, or up to the first that has a flaw."""
    graph = Graph(swarm)
    began = time.monotonic()
    try:
        for progress in _all(graph, began):
            graph.seconds = progress.seconds
            watch(progress)
            if graph.flawed is not None:
                graph.ended = "flaw"
                break
            if memory_bytes() > most_bytes:
                graph.ended = "memory"
                break
            if progress.seconds > most_s:
                graph.ended = "time"
                break
    except KeyboardInterrupt:
        graph.ended = "interrupted"
    graph.seconds = time.monotonic() - began
    graph.reached = len(graph.states)
    return graph


def _all(graph: Graph, began: float) -> Iterator[Progress]:
    swarm = graph.swarm
    graph.add(swarm.initial, NO_PARENT)
    looked_at = 0
    layer_ends = 1
    while looked_at < len(graph.states):
        expand(graph, looked_at)
        looked_at += 1
        graph.looked_at = looked_at
        if looked_at == layer_ends:
            graph.depth += 1
            layer_ends = len(graph.states)
        if looked_at % LOOK_EVERY == 0 or graph.flawed is not None:
            yield Progress(len(graph.states), looked_at, graph.transitions, graph.depth, time.monotonic() - began)


def expand(graph: Graph, number: int) -> None:
    """All that can follow this state."""
    swarm, state = graph.swarm, graph.states[number]
    lossy = swarm.bounds.network == "lossy"
    for actions in swarm.actions(state):
        for after in swarm.after(state, actions, lossy):
            graph.transitions += 1
            known = len(graph.states)
            new = graph.add(after, number)
            if new == known and graph.flawed is None and swarm.flaw(after):
                graph.flawed = new
    quieten(graph, number)


def quieten(graph: Graph, number: int) -> None:
    """Where the state goes on when nothing is lost and no new block comes."""
    swarm, state = graph.swarm, graph.states[number]
    alone: list[tuple[int, ...]] = []
    crossing: set[int] = set()
    for actions in swarm.ending(state):
        after = {graph.add(state_after, number) for state_after in swarm.after(state, actions, lossy=False)}
        if len(actions) == 1:
            alone.append(tuple(after))
        else:
            crossing |= after
    graph.quiet.append(tuple(alone))
    if crossing:
        graph.crossing[number] = tuple(crossing)
