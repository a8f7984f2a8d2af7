"""Whether the swarm can always come to rest with one chain, and whether it can go round for ever: on the whole graph.

Both are asked of what follows when nothing is lost any more and no new block comes, beside some more votes.
"""

from collections import Counter, defaultdict
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
        if not _try_votes(graph, reachable, check, safe, votes):
            result.decided = False
            return result
        safe = _attracted(graph, check, {number for number in range(len(graph.states)) if _is_one(graph, number)})
        for _ in result.astray:  # one vote more, each time, of which all that follows is known by now
            safe = _attracted(graph, check, safe | {number for number, choices in votes.items() if choices & safe})


def _is_one(graph: Graph, number: int) -> bool:
    state = graph.states[number]
    return graph.swarm.is_idle(state) and len(graph.swarm.chains(state)) <= 1


def _is_fork(graph: Graph, number: int) -> bool:
    state = graph.states[number]
    return graph.swarm.is_idle(state) and len(graph.swarm.chains(state)) > 1


def _try_votes(graph: Graph, reachable: int, check: Check, safe: set[int], votes: dict[int, set[int]]) -> bool:
    """Let somebody vote in each state at rest that is not safe, one after the other until that leads to one chain.

    What follows is in `votes`. False if it is too much.
    """
    forks = [number for number in range(len(graph.states)) if number not in safe and _is_fork(graph, number)]
    trying = {number: _voters(graph, number) for number in forks if number not in votes}
    votes.update((number, set()) for number in trying)
    while trying:
        for number, voters in trying.items():
            check()
            votes[number] |= _vote(graph, number, voters.pop())
        while len(graph.quiet) < len(graph.states):
            if len(graph.states) > reachable + MOST_ADDED:
                return False
            check()
            quieten(graph, len(graph.quiet))
        added = range(reachable, len(graph.states))
        safe = _attracted(graph, check, safe.union(number for number in added if _is_one(graph, number)), added)
        trying = {number: voters for number, voters in trying.items() if voters and not votes[number] & safe}
    return True


def _voters(graph: Graph, number: int) -> list[int]:
    """Places of agents that make a difference; last those whose chain most have."""
    locals_, known = graph.states[number][AGENTS:], graph.swarm.local.known
    alike = {
        local if graph.swarm.bounds.alike else place: place for place, local in enumerate(locals_) if local != DEAD
    }
    chains = Counter(known[local].chain for local in locals_ if local != DEAD)
    return sorted(alike.values(), key=lambda place: chains[known[locals_[place]].chain])


def _vote(graph: Graph, number: int, place: int) -> set[int]:
    """What follows a state at rest when the agent at this place completes one more block."""
    state = graph.states[number]
    actions = (Action(place, "complete", state[BLOCKS] + 1),)
    return {graph.add(after, number) for after in graph.swarm.after(state, actions, lossy=False)}


def _attracted(graph: Graph, check: Check, goal: set[int], of: range | None = None) -> set[int]:
    """All states, or those of some of them, from which, whichever timer is the next to end, some way leads to the goal.

    The durations decide which timer is next, and a zone does not tell: so all that it leaves open have to lead there.
    Of timers that have to end at the same moment only how long messages take decides which is first: any may be.
    """
    before: dict[int, list[tuple[int, int]]] = defaultdict(list)
    open_timers: dict[int, set[int]] = {}
    for number in range(len(graph.quiet)) if of is None else of:
        check()
        open_timers[number] = set(range(len(graph.quiet[number])))
        for timer, after in enumerate(graph.quiet[number]):
            for state in after:
                before[state].append((number, timer))
    any_order = graph.swarm.bounds.timers_any
    attracted, waiting = set(goal), list(goal)
    while waiting:
        for number, timer in before.get(waiting.pop(), ()):
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
