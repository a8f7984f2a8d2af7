"""Compute how many further votes an idle swarm with different chains needs until all chains are equal.

A further vote is the vote on a block that an agent completes in the idle state. The search first explores single paths
until one leads to equal chains. It explores all successors only if it finds no such path.
"""

from collections import Counter
from collections.abc import Iterator

from harness.proof.graph._expansion import quiet
from harness.proof.model._flaws import PropertyViolation
from harness.proof.model._global_states import AGENTS, BLOCKS, ModelSwarm, State
from harness.proof.model._instant import AgentAction
from harness.proof.model._known_states import DEAD
from harness.proof.questions._attractor import BackwardReachableStates, ByTimer, Check

MAX_EXPLORED = 50_000
"""Maximum number of states to explore after the votes of one state.

With faulty agents, the number of states can be infinite. Above the limit, the question remains undecided.
"""
MAX_CACHED = 200_000
"""Maximum number of states for which the number of votes is cached."""
MAX_PATH_INSTANTS = 150
"""Maximum number of steps of the swarm on a single path, including the steps of all votes. If a path is longer, the
search explores all successors instead.
"""


class UndecidedError(Exception):
    """An error: more successors would have to be explored than the limit allows."""


class ExtraVotes:
    """The number of further votes that idle states and their successors need until all chains are equal."""

    def __init__(self, swarm: ModelSwarm, check: Check = lambda: None) -> None:
        self._swarm = swarm
        self._check = check
        self._enough: dict[State, int] = {}
        """State -> a number of further votes that makes all chains equal. `_too_few` contains numbers of votes that are
        not enough.
        """
        self._too_few: dict[State, int] = {}
        self._explored = 0
        self._flaw: PropertyViolation | None = None
        """The first violation after further votes. The violation ends the path on which it was found, because a wrong
        agent takes no further step.
        """

    def needed(self, fork: State) -> int | PropertyViolation | None:
        """Return the smallest number of votes that makes all chains equal.

        If one vote per agent is not enough, return the violation that ended a path after further votes, or None if
        there was none. Raises UndecidedError.
        """
        if len(self._enough) + len(self._too_few) > MAX_CACHED:
            self._enough.clear()
            self._too_few.clear()
        self._explored = 0
        most = self._swarm.bounds.agents
        return next((votes for votes in range(1, most + 1) if self._a_vote_leads(fork, votes)), self._flaw)

    def _a_vote_leads(self, fork: State, votes: int, instants: int = 0) -> bool:
        """Return true if the swarm can reach equal chains with at most `votes` votes. The first vote starts now.

        `instants` is the number of instants that the search has already examined on this path. The search is
        recursive, so it limits this number.
        """
        return any(self._leads(after, votes - 1, instants + 1) for after in self._after_a_vote(fork))

    def _after_a_vote(self, fork: State) -> Iterator[State]:
        """Yield the possible states after a vote of one agent. Of several agents in equal states, only one votes,
        because the other votes have equal results. The agents with the rarest chain are tried first.
        """
        locals_, known = fork[AGENTS:], self._swarm.local.known
        alike = {
            local if self._swarm.bounds.alike else place: place for place, local in enumerate(locals_) if local != DEAD
        }
        chains = Counter(known[local].chain for local in locals_ if local != DEAD)
        for place in sorted(alike.values(), key=lambda place: chains[known[locals_[place]].chain]):
            yield from self._swarm.after(fork, (AgentAction(place, "complete", fork[BLOCKS] + 1),), lossy=False)

    def _leads(self, state: State, votes: int, instants: int) -> bool:
        """Return true if the swarm becomes idle with equal chains from this state, regardless of which timer expires
        next.
        """
        if not self._find_path(state, votes, set(), instants) and self._too_few.get(state, -1) < votes:
            self._explore_all(state, votes, instants)
        return self._is_enough(state, votes)

    def _is_enough(self, state: State, votes: int) -> bool:
        enough = self._enough.get(state)
        return enough is not None and enough <= votes

    def _find_path(self, state: State, votes: int, tried: set[State], instants: int) -> bool:
        """Search for a path to equal chains, and return true if one was found. A path may exist even if none was found,
        because each state is tried only once.
        """
        if self._is_enough(state, votes):
            return True
        if state in tried or instants > MAX_PATH_INSTANTS or self._too_few.get(state, -1) >= votes:
            return False
        tried.add(state)
        self._note_explored(state)
        if self._swarm.is_idle(state):
            leads = self._idle_leads(state, votes, instants)
        else:
            leads = self._timers_lead(state, votes, tried, instants)
        if leads:
            self._enough[state] = min(votes, self._enough.get(state, votes))
        return leads

    def _timers_lead(self, state: State, votes: int, tried: set[State], instants: int) -> bool:
        """Search, for each timer that may expire next, for a path that leads to equal chains. Return true if the search
        found a path for each of these timers.

        If timers may expire in any order, a path for one timer is enough.
        """
        any_order = self._swarm.bounds.timers_any
        leads = False
        for following in self._by_timer(state):
            leads = False
            for after in following:
                if self._find_path(after, votes, tried, instants + 1):
                    leads = True
                    break
            if leads == any_order:
                break
        return leads

    def _idle_leads(self, state: State, votes: int, instants: int) -> bool:
        return len(self._swarm.chains(state)) <= 1 or (votes > 0 and self._a_vote_leads(state, votes, instants))

    def _by_timer(self, state: State) -> Iterator[Iterator[State]]:
        """Yield, for each timer that may expire next, an iterator over the successors of the state."""
        ending = [*self._swarm.ending(state)]
        for action, tied in self._swarm.alternatives(state):
            if (action,) in ending:
                yield (
                    after
                    for actions in ending
                    if tied.issuperset(actions)
                    for after in self._swarm.after(state, actions, lossy=False)
                )

    def _explore_all(self, state: State, votes: int, instants: int) -> None:
        """Explore all successors of a state. Record for each successor whether this number of votes is enough."""
        states, numbers = [state], {state: 0}

        def number_of(after: State) -> int:
            number = numbers.setdefault(after, len(states))
            if number == len(states):
                states.append(after)
            return number

        by_timer: list[ByTimer] = []
        for at in states:
            self._note_explored(at)
            by_timer.append(quiet(self._swarm, at, number_of).by_timer)
        attractor = BackwardReachableStates(by_timer, self._swarm.bounds.timers_any, self._check)
        attractor.add(
            number
            for number, at in enumerate(states)
            if self._swarm.is_idle(at) and self._idle_leads(at, votes, instants)
        )
        for number, at in enumerate(states):
            if number in attractor:
                self._enough[at] = min(votes, self._enough.get(at, votes))
            else:
                self._too_few[at] = max(votes, self._too_few.get(at, votes))

    def _note_explored(self, state: State) -> None:
        self._check()
        self._flaw = self._flaw or self._swarm.flaw(state)
        self._explored += 1
        if self._explored > MAX_EXPLORED:
            raise UndecidedError
