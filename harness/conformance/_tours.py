"""Tours: an agent is led through as many vectors as it takes, by the shortest ways.

In a state first come the inputs that change nothing, then one that does; where all is seen, the nearest state in which
anything is not. Many tours go on side by side and share what is yet to be seen. Where the agent deviates, that is a
suspicion: the tour ends, and another agent goes on with what is left. What is suspected is tried again, alone.
"""

import heapq
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Container, Iterator
from dataclasses import dataclass

from harness.conformance._alphabet import INPUTS, TIMER
from harness.conformance._observation import Exchange, Seen
from harness.conformance._reference_model import Model
from harness.conformance._state_space import Pair, State, Step, Variant, pair_of, state_of
from harness.conformance._subject import Subject

TIMER_COSTS = 10.0
"""Mission seconds, about."""
INPUT_COSTS = 0.3
START_COSTS = 100.0
"""An agent takes less than that to start, but processor time, which others lack then."""
GROWTH_COSTS = 60.0
"""Of a chain that is as short as some vectors need it: it does not become shorter again."""
MOST_TRIES = 6
"""Of one vector, when the machine is late."""
MOST_WAYS = 3000
"""States that are looked at for a way."""
_ANEW = "another agent starts"


@dataclass(frozen=True)
class Suspicion:
    """Where an agent deviated: by these inputs from its start on, of which the last was wrong."""

    way: tuple[str, ...]
    seen: Seen
    exchanges: tuple[Exchange, ...]
    """All datagrams since the start of the agent."""


class Map:
    """The vectors of a variant: which are yet to be seen, and which ways lead there."""

    def __init__(self, variant: Variant, steps: list[Step], wanted: set[Pair]) -> None:
        self.variant = variant
        self.start = state_of(Model(variant.settings))
        self._unseen: dict[tuple[str, tuple[str | int, ...]], set[Pair]] = defaultdict(set)
        """By what the state does and holds."""
        self.left = len(wanted)
        for pair in wanted:
            self._unseen[pair.doing, pair.holds].add(pair)
        self._ways: dict[tuple[str, tuple[str | int, ...], tuple[object, ...]], list[tuple[str, State, float]]]
        self._ways = defaultdict(list)
        """From the part of a state that matters."""
        self._quiet: set[Pair] = set()
        self._growing: set[Pair] = set()
        self._tries: Counter[Pair] = Counter()
        self.given_up: list[Pair] = []
        """What could not be seen however often it was tried: the machine was late each time."""
        self.claimed: set[Pair] = set()
        """To which a tour is on its way."""
        for step in steps:
            if step.after == step.before:
                self._quiet.add(step.pair)
            else:
                costs = TIMER_COSTS if step.expired else INPUT_COSTS
                if step.after.holds[0] > step.before.holds[0]:  # type: ignore[operator]
                    costs += GROWTH_COSTS
                    self._growing.add(step.pair)
                self._ways[step.pair[:3]].append((step.pair.input, step.after, costs))

    def unseen_in(self, state: State, misled: Container[Pair] = ()) -> Pair | None:
        """Of what is yet to be seen, but for what is `misled`: inputs that change nothing come first, then others, the
        timer, and at last what makes the chain longer."""
        here = self._unseen.get((state.doing, state.holds))
        if not here:
            return None
        pairs = (
            pair
            for pair in here
            if pair not in self.claimed
            and pair not in misled
            and pair.counted in ((), state.counted)
            and pair == pair_of(state, INPUTS[pair.input])
        )
        return min(pairs, key=self._rank, default=None)

    def is_cheap(self, pair: Pair) -> bool:
        return pair not in self._growing

    def _rank(self, pair: Pair) -> tuple[bool, bool, bool, str]:
        return pair in self._growing, INPUTS[pair.input].tally == "timer", pair not in self._quiet, pair.input

    def take(self, pair: Pair) -> bool:
        """Whether it was yet to be seen; from now on it is not."""
        here = self._unseen.get((pair.doing, pair.holds))
        if here is None or pair not in here:
            return False
        here.remove(pair)
        self.left -= 1
        return True

    def put_back(self, pair: Pair) -> bool:
        """It could not be seen: another time, if there were not too many."""
        self._tries[pair] += 1
        if self._tries[pair] >= MOST_TRIES:
            self.given_up.append(pair)
            return False
        self._unseen[pair.doing, pair.holds].add(pair)
        self.left += 1
        return True

    def give_up(self) -> None:
        """Nothing more is to be seen."""
        self._unseen.clear()
        self.left = 0

    def avoid(self, pair: Pair) -> None:
        """No way leads over it any more: there the agent deviates."""
        ways = self._ways[pair[:3]]
        ways[:] = [way for way in ways if way[0] != pair.input]

    def way_from(self, state: State, misled: Container[Pair] = ()) -> tuple[list[str], Pair | None] | None:
        """Inputs that lead to something to see, the last of which is that.

        None are left if it is nearer to begin anew; None if no way leads anywhere. `misled` are steps that have led
        elsewhere than the map says, or that there were not.
        """
        queue: list[tuple[float, int, State | Pair, tuple[str, ...]]] = [(0.0, 0, state, ())]
        if state != self.start:
            queue.append((START_COSTS, 1, self.start, (_ANEW,)))
        closed: set[State] = set()
        number = 1
        while queue and len(closed) < MOST_WAYS:
            costs, _, at, way = heapq.heappop(queue)
            if isinstance(at, Pair):
                return ([], None) if way[0] == _ANEW else (list(way), at)
            if at in closed:
                continue
            closed.add(at)
            pair = self.unseen_in(at, misled)
            if pair is not None:
                number += 1
                heapq.heappush(
                    queue, (costs + (0.0 if self.is_cheap(pair) else GROWTH_COSTS), number, pair, (*way, pair.input))
                )
            for name, after, more in self._ways_out(at):
                if after not in closed and pair_of(at, INPUTS[name]) not in misled:
                    number += 1
                    heapq.heappush(queue, (costs + more, number, after, (*way, name)))
        return None

    def leads_to(self, state: State, name: str) -> State | None:
        """Where the map says that an input leads; None if it does not say."""
        return next((after for way, after, _ in self._ways_out(state) if way == name), None)

    def _ways_out(self, state: State) -> Iterator[tuple[str, State, float]]:
        yield from self._ways.get((state.doing, state.holds, ()), ())
        if state.counted:
            yield from self._ways.get(state, ())


class Tour:
    """One life of an agent; `passed` is told of each vector that passed."""

    def __init__(self, atlas: Map, subject: Subject, passed: Callable[[Pair], None]) -> None:
        self._map = atlas
        self._subject = subject
        self._plan: list[str] = []
        self._claim: Pair | None = None
        self._misled: set[Pair] = set()
        self._way: list[str] = []
        self._passed = passed

    async def go_on(self, until: float) -> Suspicion | None:
        """To the end of the tour, or to that second of the monotonic clock; what was wrong there, if it was that."""
        try:
            return await self._go_on(until)
        finally:
            self._plan_anew()

    async def _go_on(self, until: float) -> Suspicion | None:
        while time.monotonic() < until and (name := self._next_input()) is not None:
            state = state_of(self._subject.model)
            pair = pair_of(state, INPUTS[name])
            taken = self._map.take(pair)
            seen = await self._subject.step(INPUTS[name])
            if seen is not None:
                self._way.append(name)
            if seen is None or (seen.wrong and seen.late):
                if taken:
                    self._map.put_back(pair)
                self._plan_anew()
                if seen is None:
                    self._misled.add(pair)
                elif not self._subject.in_step:
                    return None
                continue
            if seen.wrong:
                return Suspicion(tuple(self._way), seen, self._subject.exchanges())
            if taken:
                self._passed(pair)
            if self._map.leads_to(state, name) not in (None, state_of(self._subject.model)):
                self._misled.add(pair)
                self._plan_anew()
        return None

    def _plan_anew(self) -> None:
        self._plan = []
        if self._claim is not None:
            self._map.claimed.discard(self._claim)
            self._claim = None

    def _next_input(self) -> str | None:
        """What to give now; None if the tour should end here."""
        state = state_of(self._subject.model)
        if self._subject.hurried:
            self._plan_anew()
            return TIMER
        pair = self._map.unseen_in(state, self._misled)
        if pair is not None and self._map.is_cheap(pair):
            return pair.input
        if not self._plan:
            self._plan_anew()
            way = self._map.way_from(state, self._misled)
            if way is None:  # from what comes then a way may lead
                return TIMER if self._subject.model.agent.next_timer() is not None else None
            self._plan, self._claim = way
            if self._claim is not None:
                self._map.claimed.add(self._claim)
        return self._plan.pop(0) if self._plan else None
