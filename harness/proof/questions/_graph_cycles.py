"""Find cycles in the state graph without lost messages and without new blocks."""

from array import array
from collections.abc import Iterator

from harness.proof.graph._exploration import StateGraph
from harness.proof.questions._attractor import Check


def cycles(graph: StateGraph, check: Check = lambda: None) -> list[list[int]]:
    """Return a shortest cycle of each strongly connected component. The component that is nearest to the initial state
    comes first.
    """
    parts = [part for part in _parts(graph, check) if len(part) > 1 or part[0] in _after(graph, part[0])]
    return [_shortest_cycle(graph, min(part), set(part)) for part in sorted(parts, key=min)]


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
