"""How many more votes it takes, from a state at rest with several chains, until there is one.

A vote is a block more that somebody completes. What follows it is looked at only as far as one way to one chain asks,
and all of it only where none was found like that.
"""

from collections import Counter
from collections.abc import Iterator

from harness.proof.graph._expansion import quiet
from harness.proof.model._global_states import AGENTS, BLOCKS, State, Swarm
from harness.proof.model._instant import Action
from harness.proof.model._known_states import DEAD
from harness.proof.questions._attractor import Attractor, ByTimer, Check

MOST_LOOKED_AT = 50_000
"""States that follow the votes of one state, with wrong agents without end; with more it is not decided."""
MOST_KNOWN = 200_000
"""Of so many states it is remembered how many votes they need."""
LONGEST = 150
"""So many instants, at most, has a way that is tried, with those of all its votes, before all are looked at."""


class UndecidedError(Exception):
    """More may follow than is looked at."""


class Votes:
    """Of states at rest, and of all that follow when they vote."""

    def __init__(self, swarm: Swarm, check: Check = lambda: None) -> None:
        self._swarm = swarm
        self._check = check
        self._enough: dict[State, int] = {}
        """So many votes are enough; and so many are not."""
        self._too_few: dict[State, int] = {}
        self._looked_at = 0

    def needed(self, fork: State) -> int | None:
        """The least number; None if one for each agent is not enough. Raises UndecidedError."""
        if len(self._enough) + len(self._too_few) > MOST_KNOWN:
            self._enough.clear()
            self._too_few.clear()
        self._looked_at = 0
        most = self._swarm.bounds.agents
        return next((votes for votes in range(1, most + 1) if self._leads_by_a_vote(fork, votes)), None)

    def _leads_by_a_vote(self, fork: State, votes: int, instants: int = 0) -> bool:
        """Whether a vote of somebody's leads to one chain, if then there may be all but one of `votes` more.

        So many `instants` are on the way to it: Python bears only so many.
        """
        return any(self._leads(after, votes - 1, instants + 1) for after in self._after_a_vote(fork))

    def _after_a_vote(self, fork: State) -> Iterator[State]:
        """What may follow when one of the agents that make a difference votes; those first whose chain fewest have."""
        locals_, known = fork[AGENTS:], self._swarm.local.known
        alike = {
            local if self._swarm.bounds.alike else place: place for place, local in enumerate(locals_) if local != DEAD
        }
        chains = Counter(known[local].chain for local in locals_ if local != DEAD)
        for place in sorted(alike.values(), key=lambda place: chains[known[locals_[place]].chain]):
            yield from self._swarm.after(fork, (Action(place, "complete", fork[BLOCKS] + 1),), lossy=False)

    def _leads(self, state: State, votes: int, instants: int) -> bool:
        """Whether some way, whichever timer is the next to end, leads from here to rest with one chain."""
        if not self._some_way(state, votes, set(), instants) and self._too_few.get(state, -1) < votes:
            self._look_at_all(state, votes, instants)
        return self._is_enough(state, votes)

    def _is_enough(self, state: State, votes: int) -> bool:
        enough = self._enough.get(state)
        return enough is not None and enough <= votes

    def _some_way(self, state: State, votes: int, tried: set[State], instants: int) -> bool:
        """Whether a way is found that comes to no state twice. If not there may be one nevertheless."""
        if self._is_enough(state, votes):
            return True
        if state in tried or instants > LONGEST or self._too_few.get(state, -1) >= votes:
            return False
        tried.add(state)
        self._count()
        if self._swarm.is_idle(state):
            leads = self._at_rest_leads(state, votes, instants)
        else:
            leads = self._timers_lead(state, votes, tried, instants)
        if leads:
            self._enough[state] = min(votes, self._enough.get(state, votes))
        return leads

    def _timers_lead(self, state: State, votes: int, tried: set[State], instants: int) -> bool:
        """The same of a state in which timers run: whichever of them is the next to end."""
        any_order = self._swarm.bounds.timers_any
        leads = False
        for following in self._by_timer(state):
            leads = False
            for after in following:
                if self._some_way(after, votes, tried, instants + 1):
                    leads = True
                    break
            if leads == any_order:
                break
        return leads

    def _at_rest_leads(self, state: State, votes: int, instants: int) -> bool:
        return len(self._swarm.chains(state)) <= 1 or (votes > 0 and self._leads_by_a_vote(state, votes, instants))

    def _by_timer(self, state: State) -> Iterator[Iterator[State]]:
        """For each timer that may be the next to end what may follow if it does."""
        ending = [*self._swarm.ending(state)]
        for action, tied in self._swarm.alternatives(state):
            if (action,) in ending:
                yield (
                    after
                    for actions in ending
                    if tied.issuperset(actions)
                    for after in self._swarm.after(state, actions, lossy=False)
                )

    def _look_at_all(self, state: State, votes: int, instants: int) -> None:
        """Of all that may follow it is known then whether so many votes are enough."""
        states, numbers = [state], {state: 0}

        def number_of(after: State) -> int:
            number = numbers.setdefault(after, len(states))
            if number == len(states):
                states.append(after)
            return number

        by_timer: list[ByTimer] = []
        for at in states:
            self._count()
            by_timer.append(quiet(self._swarm, at, number_of).by_timer)
        attractor = Attractor(by_timer, self._swarm.bounds.timers_any, self._check)
        attractor.add(
            number
            for number, at in enumerate(states)
            if self._swarm.is_idle(at) and self._at_rest_leads(at, votes, instants)
        )
        for number, at in enumerate(states):
            if number in attractor:
                self._enough[at] = min(votes, self._enough.get(at, votes))
            else:
                self._too_few[at] = max(votes, self._too_few.get(at, votes))

    def _count(self) -> None:
        self._check()
        self._looked_at += 1
        if self._looked_at > MOST_LOOKED_AT:
            raise UndecidedError
