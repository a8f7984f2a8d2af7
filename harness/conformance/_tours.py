"""Test one agent with many generated tests in sequence, along the shortest paths between their states.

A tour is such a sequence. In each state it first runs the vectors that do not change the agent. It then runs one vector
that changes the agent. If no vectors remain in a state, the tour continues in the nearest state with remaining vectors.
Many tours run in parallel, and share the set of remaining vectors. A deviation of the agent ends its tour with a
suspected failure. Another agent continues with the other vectors, and the suite later replays the suspected failure.
"""

import heapq
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Container, Iterator
from dataclasses import dataclass

from harness.conformance._agent_under_test import AgentUnderTest
from harness.conformance._alphabet import INPUTS, TIMER
from harness.conformance._observation import RecordedDatagram, TestedStep
from harness.conformance._reference_model import ReferenceModel
from harness.conformance._state_space import AgentState, AgentTransition, SettingsVariant, VectorKey, key_of, state_of

TIMER_COSTS = 10.0
"""Cost of a timer expiry on a path between two states. One unit is about one mission second."""
INPUT_COSTS = 0.3
START_COSTS = 100.0
"""Cost of starting a new agent. The cost is higher than the duration of a start, because a start uses processor time
that other agents need.
"""
GROWTH_COSTS = 60.0
"""Cost of adding a block to the chain. A chain never becomes shorter, and some vectors need a short chain."""
MAX_TRIES = 6
"""Maximum number of attempts for a vector if the machine is late each time."""
MAX_SEARCHED_STATES = 3000
"""Maximum number of states that the search for a path visits."""
_RESTART = "another agent starts"


@dataclass(frozen=True)
class SuspectedFailure:
    """A wrong answer of an agent. A slow machine may also have caused it."""

    path: tuple[str, ...]
    """All inputs since the start of the agent. The agent answered the last one wrongly."""
    observation: TestedStep
    exchanges: tuple[RecordedDatagram, ...]
    """All datagrams since the start of the agent."""


class VectorMap:
    """The remaining tests for one combination of settings, and a graph of the transitions that lead to these tests."""

    def __init__(self, variant: SettingsVariant, transitions: list[AgentTransition], wanted: set[VectorKey]) -> None:
        self.variant = variant
        self.start = state_of(ReferenceModel(variant.settings))
        self._unseen: dict[tuple[str, tuple[str | int, ...]], set[VectorKey]] = defaultdict(set)
        """Activity and holdings -> the vectors that remain in states with these values."""
        self.left = len(wanted)
        for key in wanted:
            self._unseen[key.activity, key.holdings].add(key)
        self._edges: dict[tuple[str, tuple[str | int, ...], tuple[object, ...]], list[tuple[str, AgentState, float]]]
        self._edges = defaultdict(list)
        """Activity, holdings and relevant counts of a state -> the inputs that lead to another state, each with this
        state and the cost.
        """
        self._quiet: set[VectorKey] = set()
        self._growing: set[VectorKey] = set()
        self._tries: Counter[VectorKey] = Counter()
        self.given_up: list[VectorKey] = []
        """Tests that were abandoned, because the machine was late at MAX_TRIES attempts."""
        self.claimed: set[VectorKey] = set()
        """Tests that a tour will run soon, so that no other tour runs them."""
        for transition in transitions:
            if transition.after == transition.before:
                self._quiet.add(transition.key)
            else:
                costs = TIMER_COSTS if transition.expired else INPUT_COSTS
                if transition.after.holdings[0] > transition.before.holdings[0]:  # type: ignore[operator]
                    costs += GROWTH_COSTS
                    self._growing.add(transition.key)
                self._edges[transition.key[:3]].append((transition.key.input, transition.after, costs))

    def unseen_in(self, state: AgentState, ruled_out: Container[VectorKey] = ()) -> VectorKey | None:
        """Return the next test to run in this state, except those in `ruled_out`. Return None if no test remains.
        Inputs that leave the agent unchanged come first, then other inputs, then timers, and last the inputs that make
        the chain longer.
        """
        here = self._unseen.get((state.activity, state.holdings))
        if not here:
            return None
        keys = (
            key
            for key in here
            if key not in self.claimed
            and key not in ruled_out
            and key.counted in ((), state.counted)
            and key == key_of(state, INPUTS[key.input])
        )
        return min(keys, key=self._rank, default=None)

    def is_cheap(self, key: VectorKey) -> bool:
        return key not in self._growing

    def _rank(self, key: VectorKey) -> tuple[bool, bool, bool, str]:
        return key in self._growing, INPUTS[key.input].tally == "timer", key not in self._quiet, key.input

    def take(self, key: VectorKey) -> bool:
        """Remove a test from the remaining tests. Return true if the test was one of them."""
        here = self._unseen.get((key.activity, key.holdings))
        if here is None or key not in here:
            return False
        here.remove(key)
        self.left -= 1
        return True

    def return_key(self, key: VectorKey) -> bool:
        """Put a test back into the remaining tests, because the machine was too late for it. After MAX_TRIES times,
        abandon the test.

        Return true if the test remains.
        """
        self._tries[key] += 1
        if self._tries[key] >= MAX_TRIES:
            self.given_up.append(key)
            return False
        self._unseen[key.activity, key.holdings].add(key)
        self.left += 1
        return True

    def give_up(self) -> None:
        """Remove all tests that have not been run."""
        self._unseen.clear()
        self.left = 0

    def avoid(self, key: VectorKey) -> None:
        """Remove a transition from all paths, because the agent deviates at it."""
        edges = self._edges[key[:3]]
        edges[:] = [edge for edge in edges if edge[0] != key.input]

    def path_from(
        self, state: AgentState, ruled_out: Container[VectorKey] = ()
    ) -> tuple[list[str], VectorKey | None] | None:
        """Return the cheapest sequence of inputs to a remaining test, and the test. Return None if no test can be
        reached.

        An empty path means that it is cheaper to start a new agent. `ruled_out` contains tests that were impossible, or
        that led to another state than the graph predicts.
        """
        queue: list[tuple[float, int, AgentState | VectorKey, tuple[str, ...]]] = [(0.0, 0, state, ())]
        if state != self.start:
            queue.append((START_COSTS, 1, self.start, (_RESTART,)))
        closed: set[AgentState] = set()
        number = 1
        while queue and len(closed) < MAX_SEARCHED_STATES:
            costs, _, at, path = heapq.heappop(queue)
            if isinstance(at, VectorKey):
                return ([], None) if path[0] == _RESTART else (list(path), at)
            if at in closed:
                continue
            closed.add(at)
            key = self.unseen_in(at, ruled_out)
            if key is not None:
                number += 1
                heapq.heappush(
                    queue, (costs + (0.0 if self.is_cheap(key) else GROWTH_COSTS), number, key, (*path, key.input))
                )
            for name, after, more in self._edges_from(at):
                if after not in closed and key_of(at, INPUTS[name]) not in ruled_out:
                    number += 1
                    heapq.heappush(queue, (costs + more, number, after, (*path, name)))
        return None

    def leads_to(self, state: AgentState, name: str) -> AgentState | None:
        """Return the state to which the input leads according to the graph. Return None if the graph does not contain
        the input.
        """
        return next((after for each, after, _ in self._edges_from(state) if each == name), None)

    def _edges_from(self, state: AgentState) -> Iterator[tuple[str, AgentState, float]]:
        yield from self._edges.get((state.activity, state.holdings, ()), ())
        if state.counted:
            yield from self._edges.get(state, ())


class AgentTour:
    """A sequence of tests of one agent. The tour calls `passed` for each test that passes."""

    def __init__(self, vector_map: VectorMap, agent: AgentUnderTest, passed: Callable[[VectorKey], None]) -> None:
        self._map = vector_map
        self._agent = agent
        self._plan: list[str] = []
        self._claim: VectorKey | None = None
        self._ruled_out: set[VectorKey] = set()
        self._path: list[str] = []
        self._passed = passed

    async def run(self, until: float) -> SuspectedFailure | None:
        """Run tests until the agent deviates, no test remains, or the time `until` is reached, in seconds of the
        monotonic clock.

        Return the deviation, or None if the agent did not deviate.
        """
        try:
            return await self._run_until(until)
        finally:
            self._discard_plan()

    async def _run_until(self, until: float) -> SuspectedFailure | None:
        while time.monotonic() < until and (name := self._next_input()) is not None:
            state = state_of(self._agent.model)
            key = key_of(state, INPUTS[name])
            taken = self._map.take(key)
            observation = await self._agent.step(INPUTS[name])
            if observation is not None:
                self._path.append(name)
            if observation is None or (observation.wrong and observation.late):
                if taken:
                    self._map.return_key(key)
                self._discard_plan()
                if observation is None:
                    self._ruled_out.add(key)
                elif not self._agent.reference_follows:
                    return None
                continue
            if observation.wrong:
                return SuspectedFailure(tuple(self._path), observation, self._agent.exchanges())
            if taken:
                self._passed(key)
            if self._map.leads_to(state, name) not in (None, state_of(self._agent.model)):
                self._ruled_out.add(key)
                self._discard_plan()
        return None

    def _discard_plan(self) -> None:
        self._plan = []
        if self._claim is not None:
            self._map.claimed.discard(self._claim)
            self._claim = None

    def _next_input(self) -> str | None:
        """Return the name of the next input. Return None if the tour should end here."""
        state = state_of(self._agent.model)
        if self._agent.timer_is_near:
            self._discard_plan()
            return TIMER
        key = self._map.unseen_in(state, self._ruled_out)
        if key is not None and self._map.is_cheap(key):
            return key.input
        if not self._plan:
            self._discard_plan()
            path = self._map.path_from(state, self._ruled_out)
            if path is None:  # a path may begin in the state after the next timer
                return TIMER if self._agent.model.agent.next_timer() is not None else None
            self._plan, self._claim = path
            if self._claim is not None:
                self._map.claimed.add(self._claim)
        return self._plan.pop(0) if self._plan else None
