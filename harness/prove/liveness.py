"""Whether the swarm can always come to rest with one chain, and whether it can go round for ever: on the whole graph.

Both are asked of what follows when nothing is lost any more and no new block comes, beside some more votes.
"""

from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from harness.prove.explore import Graph, quieten
from harness.prove.instant import Action
from harness.prove.local import DEAD
from harness.prove.swarm import AGENTS, BLOCKS

MOST_ADDED = 200_000
"""States that votes add, with wrong agents without end; with more it is not decided whether there is one chain."""


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


Check = Callable[[], None]
"""Is called again and again, and raises GivenUpError when memory or time have come to an end."""


def look(graph: Graph, check: Check = lambda: None) -> Liveness:
    """Of a graph that is complete."""
    result = Liveness()
    reachable = len(graph.states)
    at_rest = [number for number in range(reachable) if _is_fork(graph, number)]
    result.forks, result.fork = len(at_rest), at_rest[0] if at_rest else None
    result.cycles = list(_cycles(graph, reachable, check))
    safe = _attracted(graph, check, {number for number in range(reachable) if _is_one(graph, number)})
    votes: dict[int, set[int]] = {}
    while True:
        astray = [number for number in range(reachable) if number not in safe]
        result.astray.append(len(astray))
        if astray and len(result.astray) == 2:
            result.reluctant = astray[0]
        if not astray or len(result.astray) > graph.swarm.bounds.agents:
            result.lost = astray[0] if astray else None
            return result
        forks = [number for number in range(len(graph.states)) if number not in safe and _is_fork(graph, number)]
        for number in forks:
            check()
            if number not in votes:
                votes[number] = _vote(graph, number)
        while len(graph.quiet) < len(graph.states):
            if len(graph.states) > reachable + MOST_ADDED:
                result.decided = False
                return result
            check()
            quieten(graph, len(graph.quiet))
        safe = _attracted(graph, check, {number for number in range(len(graph.states)) if _is_one(graph, number)})
        for _ in result.astray:  # one vote more, each time, of which all that follows is known by now
            safe = _attracted(graph, check, safe | {number for number, choices in votes.items() if choices & safe})


def _is_one(graph: Graph, number: int) -> bool:
    state = graph.states[number]
    return graph.swarm.is_idle(state) and len(graph.swarm.chains(state)) <= 1


def _is_fork(graph: Graph, number: int) -> bool:
    state = graph.states[number]
    return graph.swarm.is_idle(state) and len(graph.swarm.chains(state)) > 1


def _vote(graph: Graph, number: int) -> set[int]:
    """What follows a state at rest when somebody completes one more block."""
    state = graph.states[number]
    return {
        graph.add(after, number)
        for place, local in enumerate(state[AGENTS:])
        if local != DEAD
        for after in graph.swarm.after(state, (Action(place, "complete", state[BLOCKS] + 1),), lossy=False)
    }


def _attracted(graph: Graph, check: Check, goal: set[int]) -> set[int]:
    """All states from which, whichever timer is the next to end, some way leads to the goal.

    The durations decide which timer is next, and a zone does not tell: so all that it leaves open have to lead there.
    Of timers that have to end at the same moment only how long messages take decides which is first: any may be.
    """
    before: dict[int, list[tuple[int, int]]] = defaultdict(list)
    open_timers: list[set[int]] = []
    for number, alone in enumerate(graph.quiet):
        check()
        open_timers.append(set(range(len(alone))))
        for timer, after in enumerate(alone):
            for state in after:
                before[state].append((number, timer))
    any_order = graph.swarm.bounds.timers_any
    attracted, waiting = set(goal), list(goal)
    while waiting:
        for number, timer in before[waiting.pop()]:
            open_timers[number].discard(timer)
            if number not in attracted and (any_order or not open_timers[number]):
                attracted.add(number)
                waiting.append(number)
    return attracted


def _cycles(graph: Graph, reachable: int, check: Check) -> Iterator[list[int]]:
    """A shortest way round in every part of the graph from whose states all others of it can be reached."""
    for part in _parts(graph, reachable):
        check()
        if len(part) > 1 or part[0] in _after(graph, part[0]):
            yield _round(graph, min(part), set(part))


def _after(graph: Graph, number: int) -> set[int]:
    return {state for after in graph.quiet[number] for state in after} | {*graph.crossing.get(number, ())}


def _round(graph: Graph, start: int, part: set[int]) -> list[int]:
    came_from: dict[int, int] = {}
    layer = [start]
    while layer:
        following = []
        for number in layer:
            for after in _after(graph, number):
                if after == start:
                    way = [number]
                    while way[-1] != start:
                        way.append(came_from[way[-1]])
                    return way[::-1]
                if after in part and after not in came_from:
                    came_from[after] = number
                    following.append(after)
        layer = following
    raise AssertionError("a part has a way round")


def _parts(graph: Graph, reachable: int) -> Iterator[list[int]]:
    """Strongly connected components (Tarjan), without recursion."""
    index: dict[int, int] = {}
    low: dict[int, int] = {}
    stack: list[int] = []
    on_stack: set[int] = set()
    for root in range(reachable):
        if root in index:
            continue
        work = [(root, iter(_after(graph, root)))]
        index[root] = low[root] = len(index)
        stack.append(root)
        on_stack.add(root)
        while work:
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
