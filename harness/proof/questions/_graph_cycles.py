"""Find cycles in the state graph without lost messages and without new blocks.

A state of the graph can represent states with smaller zones. A cycle of such a graph can be impossible to repeat: in
each round the times of the agents shift, until another timer expires first. Each part of the graph with a cycle is
therefore explored again with exact zones. A cycle through exact zones can repeat forever. Conversely, each endless run
stays in one part in the end, and with exact zones it repeats a state, because the number of zones is finite.
"""

from array import array
from collections.abc import Iterator, Sequence

from harness.proof.graph._expansion import StateExpansion, quiet
from harness.proof.graph._exploration import NO_PARENT, StateGraph
from harness.proof.model._global_states import AGENTS, ZONE, State
from harness.proof.questions._attractor import ByTimer, Check

OUTSIDE = -1
"""The number that stands for all states outside the explored part."""


def cycles(graph: StateGraph, check: Check = lambda: None) -> Iterator[list[int]]:
    """Yield a shortest cycle of each strongly connected component. The component that is nearest to the initial state
    comes first.
    """
    parts = sorted(_cyclic_parts(graph, check), key=min)
    if graph.states.exact:
        yield from (_shortest_cycle(graph, min(part), set(part)) for part in parts)
        return
    for part in parts:
        exact = _with_exact_zones(graph, sorted(part), check)
        numbers = dict(enumerate(sorted(part)))
        for cycle in cycles(exact, check):
            yield [_number_in(graph, exact, state, numbers) for state in cycle]


def _cyclic_parts(graph: StateGraph, check: Check) -> Iterator[list[int]]:
    return (part for part in _parts(graph, check) if len(part) > 1 or part[0] in _after(graph, part[0]))


def _with_exact_zones(graph: StateGraph, part: Sequence[int], check: Check) -> StateGraph:
    """Explore a part of a graph again, starting from the states of `part`. Return a new graph, in which only equal
    states are one state. Its first states are the states of `part`.

    The exploration omits a state if the local state of one of its agents does not occur in the part.
    """
    exact = StateGraph(graph.swarm, exact=True)
    for number in part:
        exact.reach(graph.states[number], NO_PARENT)
    inside = {_agents(graph.states[number]) for number in part}
    while len(exact.quiet) < len(exact.states):
        check()
        parent = len(exact.quiet)

        def number_of(state: State, parent: int = parent) -> int:
            return exact.reach(state, parent) if _agents(state) in inside else OUTSIDE

        following = quiet(exact.swarm, exact.states[parent], number_of)
        by_timer: ByTimer = tuple(_inside(after) for after in following.by_timer)
        exact.take_in(StateExpansion(0, by_timer, _inside(following.crossing)))
    return exact


def _agents(state: State) -> State:
    """Return the part of a state that does not concern the remaining times of timers."""
    return (*state[:ZONE], *state[AGENTS:])


def _inside(after: Sequence[int]) -> tuple[int, ...]:
    return tuple(number for number in after if number != OUTSIDE)


def _number_in(graph: StateGraph, exact: StateGraph, state: int, numbers: dict[int, int]) -> int:
    """Return the number that a state of the graph `exact` has in `graph`. If `graph` does not contain the state yet,
    add the state and the path to it. `numbers` contains the states of `exact` that are already in `graph`.
    """
    path = [state]
    while path[-1] not in numbers:
        path.append(exact.parents[path[-1]])
    for after, before in zip(path[-2::-1], path[:0:-1], strict=True):
        numbers[after] = graph.states.append(exact.states[after])
        graph.parents.append(numbers[before])
    return numbers[state]


def _after(graph: StateGraph, number: int) -> set[int]:
    """Return the successors of a state. In an incomplete graph, unexplored successors are omitted."""
    following = {state for after in graph.quiet[number] for state in after} | {*graph.crossing.get(number, ())}
    if graph.ended == "complete":
        return following
    return {state for state in following if state < len(graph.quiet)}


def _shortest_cycle(graph: StateGraph, start: int, part: set[int]) -> list[int]:
    came_from: dict[int, int] = {}
    layer = [start]
    while layer:
        following = []
        for number in layer:
            for after in _after(graph, number):
                if after == start:
                    path = [number]
                    while path[-1] != start:
                        path.append(came_from[path[-1]])
                    return path[::-1]
                if after in part and after not in came_from:
                    came_from[after] = number
                    following.append(after)
        layer = following
    raise AssertionError("each part contains a cycle")


def _after_a_cycle(graph: StateGraph, check: Check) -> list[int]:
    """Return all states that lie on a cycle or can be reached from a cycle.

    The function removes states without a predecessor among the remaining states, until each remaining state has one.
    """
    incoming = array("q", bytes(8 * len(graph.quiet)))
    for number in range(len(graph.quiet)):
        check()
        for after in _after(graph, number):
            incoming[after] += 1
    waiting = [number for number, count in enumerate(incoming) if not count]
    while waiting:
        check()
        for after in _after(graph, waiting.pop()):
            incoming[after] -= 1
            if not incoming[after]:
                waiting.append(after)
    return [number for number, count in enumerate(incoming) if count]


def _parts(graph: StateGraph, check: Check) -> Iterator[list[int]]:
    """Yield the strongly connected components (Tarjan's algorithm, without recursion). Most components with a single
    state are omitted.
    """
    index: dict[int, int] = {}
    low: dict[int, int] = {}
    stack: list[int] = []
    on_stack: set[int] = set()
    for root in _after_a_cycle(graph, check):
        if root in index:
            continue
        work = [(root, iter(_after(graph, root)))]
        index[root] = low[root] = len(index)
        stack.append(root)
        on_stack.add(root)
        while work:
            check()
            number, rest = work[-1]
            for after in rest:
                if after not in index:
                    index[after] = low[after] = len(index)
                    stack.append(after)
                    on_stack.add(after)
                    work.append((after, iter(_after(graph, after))))
                    break
                if after in on_stack:
                    low[number] = min(low[number], index[after])
            else:
                work.pop()
                if work:
                    low[work[-1][0]] = min(low[work[-1][0]], low[number])
                if low[number] == index[number]:
                    part = []
                    while True:
                        member = stack.pop()
                        on_stack.remove(member)
                        part.append(member)
                        if member == number:
                            break
                    yield part
