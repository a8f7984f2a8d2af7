"""Compute the states of a whole swarm and their successors.

A global state is a tuple of small numbers: the completed blocks, the remaining faults, the zone of the running timers,
and the local states of the agents. If `bounds.alike` is true, equal agents are interchangeable, and one order of the
agents represents all orders. If `bounds.blocks_alike` is true, the same holds for blocks.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache
from itertools import combinations, permutations, product
from typing import NamedTuple

from harness.proof.attacker._attacker import Attacker
from harness.proof.bounds import FAULTS, MAX_COINCIDENCES, MAX_LIES, Bounds
from harness.proof.model._block_renaming import Ordinals
from harness.proof.model._canonical_order import CanonicalOrder, OrderedAgents, Places
from harness.proof.model._flaws import PropertyViolation
from harness.proof.model._instant import (
    Actions,
    AgentAction,
    AgentStates,
    FinalMessageRound,
    InstantOutcomes,
    MessageRound,
)
from harness.proof.model._known_states import DEAD
from harness.proof.model._local_steps import LocalStates
from harness.proof.model._snapshot import Started
from harness.proof.model._zones import NOTHING_RUNS, ZoneTable

State = tuple[int, ...]
"""A global state: the number of completed blocks, the remaining faults, the zone, and the local states.

One number encodes the remaining faults. This number has a bit for each fault and for the capture. It also contains the
remaining numbers of forged messages, coincidences and losses.
"""
MOST_KNOWN = 200_000
"""Maximum number of cached results for actions at one moment. When the cache exceeds this number, it is emptied."""
ONCE = (*FAULTS, "captured")
"""Faults that can happen at most once in a run. Each has a bit in the state, which is set while the fault can still
happen.
"""
ALL_LEFT = -1
LIES = 1 << len(ONCE)
"""The number that encodes the remaining faults contains the remaining number of forged messages times this factor."""
COINCIDENCES = LIES << (MAX_LIES.bit_length())
"""The number that encodes the remaining faults contains the remaining number of coincidences times this factor. Not
used if coincidences are unlimited.
"""
LOSSES = COINCIDENCES << (MAX_COINCIDENCES.bit_length())
"""The number that encodes the remaining faults contains the remaining number of losses times this factor. Not used if
losses are unlimited.
"""
ANY_NUMBER = 1 << 30
"""The number that stands for an unlimited number of losses."""
BLOCKS, LEFT, ZONE, AGENTS = 0, 1, 2, 3
"""The indices of the parts of a global state."""


class SwarmTransition(NamedTuple):
    """A transition between two states of the swarm. `state` is the new state, and `places` contains the previous
    positions of the agents.

    `last_round` is the last round of messages in the transition.
    """

    actions: Actions
    state: State
    places: Places
    last_round: MessageRound | None
    started: tuple[Started, ...]
    """The timers that were started. Agents are identified by their positions before the transition."""
    blocks: Ordinals
    """The previous ordinals of the blocks 1, 2, ... of `state`. Empty if the ordinals did not change."""


class _InstantResult(NamedTuple):
    """The states of all agents after one instant. An instant consists of simultaneous actions and all messages that
    these actions cause.

    `running` contains the previous number of each running timer. `started` contains the timers that each agent started.
    `ending` is the last round of messages.
    """

    agents: tuple[int, ...]
    running: tuple[int, ...]
    started: tuple[Started, ...]
    ending: FinalMessageRound


class _InstantResults(NamedTuple):
    """The possible results of one instant, without the exact timer values: the expired timers, the number of completed
    blocks, the remaining faults, the forged messages, and the states of the agents.
    """

    ended: tuple[int, ...]
    completed: int
    left: int
    lies: int
    outcomes: tuple[_InstantResult, ...]


class ModelSwarm:
    """The states of a swarm within `bounds`, and the transitions between them.

    If `every_count` is true, the prover does not merge states with different vote counts. Agents then receive answers
    in every order, even if they only count them, and keep vote counts even if these have no effect.
    """

    def __init__(self, bounds: Bounds, *, every_count: bool = False) -> None:
        self.bounds = bounds
        self.local = LocalStates(bounds, every_count=every_count)
        self.zones = ZoneTable()
        self._instants = InstantOutcomes(self.local, bounds, every_order=every_count)
        self._order = (
            CanonicalOrder(self.local, self.zones, self.name_of) if bounds.alike or bounds.blocks_alike else None
        )
        self._known: dict[tuple[tuple[int, ...], Actions, int], _InstantResults] = {}
        self._running = lru_cache(MOST_KNOWN)(self._running_of)
        self._as_they_are = tuple(range(bounds.agents))
        own = [1] * bounds.agents if bounds.alike else range(1, bounds.agents + 1)
        faults = sum(1 << ONCE.index(name) for name in bounds.faults if name != "duplicate")
        self.attacker = None if bounds.captured is None else Attacker(bounds, self.local)
        if bounds.captured is not None:
            faults += (1 << ONCE.index("captured")) + bounds.lies * LIES
        faults += (bounds.coincidences or 0) * COINCIDENCES + (bounds.losses or 0) * LOSSES
        self.initial: State = (0, faults, NOTHING_RUNS, *(self.local.initial[agent_id] for agent_id in own))

    @property
    def contains(self) -> Callable[[int, int], bool] | None:
        """A function that takes two zones, and returns true if the first one contains the second one. None if only
        equal states count as one state.
        """
        return self.zones.contains if self.bounds.zones_contained else None

    # Actions of an instant

    def firsts(self, state: State) -> list[AgentAction]:
        """Return the timer expiries that may happen next. There is one action for each possible result of an expiry."""
        return [action for actions in self._firsts(state) for action in actions]

    def _firsts(self, state: State) -> list[list[AgentAction]]:
        """Return the timer expiries that may happen next. The result contains a list for each timer. The list has one
        action for each possible result of the expiry.
        """
        running = self._running(state[AGENTS:])
        if not self.bounds.timers_any:
            running = tuple([running[first - 1] for first in self.zones.firsts(state[ZONE])])
        return [
            [
                AgentAction(place, "timer", timer, result)
                for result in range(len(self.local.ends(state[AGENTS + place], timer)))
            ]
            for place, timer in running
        ]

    def alternatives(self, state: State) -> Iterator[tuple[AgentAction, frozenset[AgentAction]]]:
        """Yield each timer that may expire next, with the set of all timers that must expire at the same moment.

        If an expiry has several results because the ages of blocks are not fixed, each combination of results is
        yielded separately, because agents cannot choose which block is older.
        """
        firsts = self._firsts(state)
        tied = [(index,) for index in range(len(firsts))] if self.bounds.timers_any else self.zones.tied(state[ZONE])
        for first, others in enumerate(tied):
            together = [first, *[other for other in others if other != first]]
            for actions in product(*(firsts[index] for index in together)):
                yield actions[0], frozenset(actions)

    def ending(self, state: State) -> Iterator[Actions]:
        """Yield all sets of timers that may expire at the same moment, with at most one timer per agent. The durations
        of timers may make some of these sets impossible.

        If messages must not cross (`bounds.crossing` is false), timers expire one by one.
        """
        by_place: dict[int, list[AgentAction]] = {}
        for action in self.firsts(state):
            by_place.setdefault(action.place, []).append(action)
        most = len(by_place) if self.bounds.crossing else 1
        for count in range(1, most + 1):
            for places in combinations(by_place, count):
                for actions in product(*(by_place[place] for place in places)):
                    if self._may_coincide(state, actions):
                        yield actions

    def actions(self, state: State, ending: Iterable[Actions] | None = None) -> Iterator[Actions]:
        """Yield all sets of actions that may happen at the same moment. An action is the expiry of a timer, the
        completion of a block, a fault, or an action of the attacker.

        `ending` contains the sets of timers if they are already known.
        """
        alive = [place for place, local in enumerate(state[AGENTS:]) if local != DEAD]
        left = self.bounds.blocks - state[BLOCKS]
        for timers in self.ending(state) if ending is None else ending:
            yield timers
            if not self.bounds.crossing:
                continue
            idle_hands = [place for place in alive if all(place != action.place for action in timers)]
            for count in range(1, min(left, len(idle_hands)) + 1):
                for places in self._distinct(state, permutations(idle_hands, count)):
                    completed = (
                        AgentAction(place, "complete", state[BLOCKS] + 1 + index) for index, place in enumerate(places)
                    )
                    actions = (*timers, *completed)
                    if self._may_coincide(state, actions):
                        yield actions
        singly: list[AgentAction] = []
        if left:
            for (place,) in self._distinct(state, ((place,) for place in alive)):
                singly.append(AgentAction(place, "complete", state[BLOCKS] + 1))
        for bit, fault in enumerate(FAULTS):
            if state[LEFT] >> bit & 1:
                singly += [AgentAction(place, fault) for place in alive]
        yield from ((action,) for action in singly if self._may_coincide(state, (action,)))
        if self.attacker is not None:
            yield from self._of_the_attacker(self.attacker, state)

    def _of_the_attacker(self, attacker: Attacker, state: State) -> Iterator[Actions]:
        """Yield the actions of the attacker. First it can capture a vehicle. After that, it can send each forged
        message to any set of receivers.
        """
        assert self.bounds.captured is not None, "the attacker has the keys of a vehicle"
        if state[LEFT] >> ONCE.index("captured") & 1:
            yield (AgentAction(self.bounds.captured - 1, "captured"),)
        elif _lies(state):
            yield from attacker.forged_messages(state[AGENTS:])

    def _may_coincide(self, state: State, actions: Sequence[AgentAction]) -> bool:
        if self.bounds.coincidences is None:
            return True
        return self.coincidences(state, actions) <= state[LEFT] % LOSSES // COINCIDENCES

    def coincidences(self, state: State, actions: Sequence[AgentAction]) -> int:
        """Return the number of coincidences that these simultaneous actions need. In a coincidence, two independent
        events happen at the same moment by chance.
        """
        if self.bounds.timers_any:
            return 0
        ended = self._ended(state[AGENTS:], actions)
        if not ended:
            chosen = actions[0].what in ("captured", "lie")  # the attacker can wait for its moment
            between = not chosen and self.zones.no_time_passes(state[ZONE])
            return len({(action.what, action.number) for action in actions}) - 1 + between
        if self.zones.after(state[ZONE], ended, ()) is None:
            return len(actions)  # they never happen at once
        return self.zones.coincidences(state[ZONE], ended) + len(actions) - len(ended)

    def _distinct(self, state: State, choices: Iterable[tuple[int, ...]]) -> Iterator[tuple[int, ...]]:
        """Return the choices without equivalent ones: of each group of equivalent choices, yield only the first. A
        choice is a tuple of positions of agents.

        Two agents are equivalent if they are in the same local state and have no running timer. If an agent has counted
        the votes of only some other agents, no agents are equivalent.
        """
        known = self.local.known
        locals_ = state[AGENTS:]
        if not self.bounds.alike or any(local != DEAD and known[local].names_others for local in locals_):
            yield from choices
            return
        seen = set()
        for places in choices:
            described = tuple(place if known[locals_[place]].running else -1 - locals_[place] for place in places)
            if described not in seen:
                seen.add(described)
                yield places

    # Results of an instant

    def after(self, state: State, actions: Actions, lossy: bool) -> Iterator[State]:
        """Yield the possible states after these simultaneous actions. Yield no state if the timers cannot expire
        together.
        """
        key = state[AGENTS:], actions, self._most_lost(state, lossy)
        instant = self._known.get(key)
        if instant is None:
            if len(self._known) >= MOST_KNOWN:
                self._known.clear()
            instant = self._known[key] = self._instant(*key, with_rounds=False)
        if self._can_be(state, instant):
            left = self._left(state, actions, instant)
            for outcome, there in zip(instant.outcomes, self._ordered(state, instant, left), strict=True):
                still = left - outcome.ending.lost * LOSSES
                yield (state[BLOCKS] + instant.completed, still, there.zone, *there.agents)

    def moves(self, state: State, actions: Actions, lossy: bool) -> Iterator[SwarmTransition]:
        """Yield the transitions that these simultaneous actions can cause."""
        instant = self._instant(state[AGENTS:], actions, self._most_lost(state, lossy), with_rounds=True)
        if self._can_be(state, instant):
            left = self._left(state, actions, instant)
            ordered = self._ordered(state, instant, left)
            for outcome, there in zip(instant.outcomes, ordered, strict=True):
                still = left - outcome.ending.lost * LOSSES
                after = (state[BLOCKS] + instant.completed, still, there.zone, *there.agents)
                yield SwarmTransition(
                    actions, after, there.places, outcome.ending.last_round, outcome.started, there.blocks
                )

    def _most_lost(self, state: State, lossy: bool) -> int:
        """Return the maximum number of messages that may be lost at one moment in this state."""
        if not lossy:
            return 0
        return ANY_NUMBER if self.bounds.losses is None else state[LEFT] // LOSSES

    def _can_be(self, state: State, instant: _InstantResults) -> bool:
        """Return true if these timers can expire together and before all other timers. Call this method only if each of
        the timers alone can expire first.
        """
        if len(instant.ended) < 2 or self.bounds.timers_any:
            return True
        return self.zones.after(state[ZONE], instant.ended, ()) is not None

    def _ordered(self, state: State, instant: _InstantResults, left: int) -> Iterator[OrderedAgents]:
        completed = state[BLOCKS] + instant.completed
        only_timers = self.bounds.reduced and completed >= self.bounds.blocks and not left % COINCIDENCES
        for outcome in instant.outcomes:
            zone = NOTHING_RUNS
            if not self.bounds.timers_any:
                after = self.zones.after(state[ZONE], instant.ended, outcome.running)
                assert after is not None, "these timers can end at once"
                zone = self.zones.adrift(after) if only_timers else after
            if self._order is None:
                yield OrderedAgents(outcome.agents, zone, self._as_they_are)
            else:
                yield self._order.of(outcome.agents, zone)

    def _left(self, state: State, actions: Sequence[AgentAction], instant: _InstantResults) -> int:
        """Return the remaining numbers of faults, forged messages, coincidences and losses after these actions, encoded
        in one number.
        """
        left = (state[LEFT] & instant.left) - instant.lies * LIES
        if self.bounds.coincidences:
            left -= self.coincidences(state, actions) * COINCIDENCES
        return left

    def _instant(
        self, locals_: tuple[int, ...], actions: Actions, most_lost: int, *, with_rounds: bool
    ) -> _InstantResults:
        at = {timer: index + 1 for index, timer in enumerate(self._running(locals_))}
        left = ALL_LEFT
        for action in actions:
            if action.what in ONCE:
                left &= ~(1 << ONCE.index(action.what))
        return _InstantResults(
            self._ended(locals_, actions),
            sum(action.what == "complete" for action in actions),
            left,
            int(any(action.what == "lie" for action in actions)),
            tuple(
                _InstantResult(
                    there.locals, self._running_after(at, there), there.started if with_rounds else (), ending
                )
                for there, ending in self._instants.outcomes(
                    locals_, actions, most_lost, with_rounds=with_rounds
                ).items()
            ),
        )

    def _running_after(self, at: dict[tuple[int, int], int], there: AgentStates) -> tuple[int, ...]:
        """Return a number for each timer that runs after a step. For a timer that ran before the step, it is the
        timer's previous number. For a timer that the step started, it is -1 minus the timer's duration in microseconds.
        """
        running = []
        for place, local in enumerate(there.locals):
            if local == DEAD:
                continue
            started = dict(there.started[place])
            for timer in self.local.known[local].running:
                if timer in started:
                    running.append(-started[timer] - 1)
                else:
                    running.append(at.get((place, timer)) or -self.local.durations_us[timer] - 1)
        return tuple(running)

    def _ended(self, locals_: tuple[int, ...], actions: Sequence[AgentAction]) -> tuple[int, ...]:
        """Return the numbers of the expired timers. The number of a timer is its position in the swarm's list of
        timers, counted from 1.
        """
        ended = [(action.place, action.number) for action in actions if action.what == "timer"]
        running = self._running(locals_)
        return tuple(sorted([running.index(timer) + 1 for timer in ended]))

    def _running_of(self, locals_: tuple[int, ...]) -> tuple[tuple[int, int], ...]:
        """Return all running timers of the swarm in order, each as a pair (position of the agent, timer)."""
        known = self.local.known
        return tuple(
            [(place, timer) for place, local in enumerate(locals_) if local != DEAD for timer in known[local].running]
        )

    def name_of(self, other: int, place: int) -> int:
        """Return the ID that the agent at position `place` uses for the agent at position `other`."""
        return self._instants.name_of(other, place)

    def order_matters(self, local: int, place: int, message_round: MessageRound, heard: Sequence[int]) -> bool:
        """Return true if the state of the agent at `place` depends on the order of the messages that it receives in
        this round.
        """
        return self._instants.order_matters(local, place, message_round, heard)

    # Properties of a state

    def flaw(self, state: State) -> PropertyViolation | None:
        """Return the violation in the state of one of the agents. Return None if there is no violation."""
        known = self.local.known
        return next((flaw for local in state[AGENTS:] if local != DEAD and (flaw := known[local].flaw)), None)

    def violated(self, state: State) -> Iterator[str]:
        """Yield the characteristics that the attacker has violated although all honest agents follow the protocol.

        Such a violation exists in two cases. An agent accepted a message that the captured vehicle never sent. Or an
        agent holds a block with the name of the captured vehicle, and the captured vehicle never completed this block.
        """
        if _lies(state) < self.bounds.lies:
            yield "1"
        if any(local != DEAD and self.local.known[local].deceived for local in state[AGENTS:]):
            yield "4"

    def is_idle(self, state: State) -> bool:
        return all(local == DEAD or self.local.known[local].idle for local in state[AGENTS:])

    def chains(self, state: State) -> set[tuple[int, ...]]:
        """Return the set of different chains that living agents hold."""
        return {self.local.known[local].chain for local in state[AGENTS:] if local != DEAD}


def _lies(state: State) -> int:
    """Return the number of forged messages that the attacker may still send."""
    return state[LEFT] % COINCIDENCES // LIES
