"""Global states, and all that may happen next in each.

A global state is how many blocks were completed, which faults are left, the zone of the timers that run, and the
agents' local states: a tuple of small numbers. Where `bounds.alike`, agents that are alike change places freely:
of all orders of the agents one stands for all; and where `bounds.blocks_alike` of all orders of the blocks.
"""

from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from itertools import combinations, permutations, product
from typing import NamedTuple

from harness.proof.attacker._attacker import Captor
from harness.proof.bounds import FAULTS, MAX_COINCIDENCES, MAX_LIES, Bounds
from harness.proof.model._block_renaming import Ordinals
from harness.proof.model._canonical_order import Order, Ordered, Places
from harness.proof.model._flaws import Flaw
from harness.proof.model._instant import Action, Actions, Agents, Instants, Wave, Way
from harness.proof.model._known_states import DEAD
from harness.proof.model._local_steps import LocalStates
from harness.proof.model._snapshot import Started
from harness.proof.model._zones import NOTHING_RUNS, Zones

State = tuple[int, ...]
"""Blocks completed, what may yet befall (a bit for each fault and the capture, how many lies,
coincidences and losses), zone, the agents."""
MOST_KNOWN = 200_000
"""So many instants are remembered; then they are worked out again."""
ONCE = (*FAULTS, "captured")
"""What may befall an agent once, by the bit that says that it still may."""
ALL_LEFT = -1
LIES = 1 << len(ONCE)
"""One more lie that may be told."""
COINCIDENCES = LIES << (MAX_LIES.bit_length())
"""One more moment that may be the same as another by chance, where that is bounded."""
LOSSES = COINCIDENCES << (MAX_COINCIDENCES.bit_length())
"""One more message that an agent may lose, where that is bounded."""
ANY_NUMBER = 1 << 30
"""Of losses."""
BLOCKS, LEFT, ZONE, AGENTS = 0, 1, 2, 3
"""Where they stand in it."""


class Move(NamedTuple):
    """One way on: what is done, what comes of it, and who then stands where. `wave` is the last round of hearing."""

    actions: Actions
    state: State
    places: Places
    wave: Wave | None
    started: tuple[Started, ...]
    """By the places before."""
    blocks: Ordinals
    """Which the first, second, ... block of `state` was before; none if it still is what it was."""


class _Outcome(NamedTuple):
    """Agents after an instant. `running` says of each of their timers which it was; the rest says how it came so."""

    agents: tuple[int, ...]
    running: tuple[int, ...]
    started: tuple[Started, ...]
    way: Way


class _Instant(NamedTuple):
    """What may come of agents, whatever the zone: the timers that end, blocks completed, what is left, and outcomes."""

    ended: tuple[int, ...]
    completed: int
    left: int
    lies: int
    outcomes: tuple[_Outcome, ...]


class Swarm:
    """All global states of `bounds` are made here.

    `every_count`: for all local states that there are: answers are heard in every order, though they are only counted,
    and counts are kept, though they decide nothing any more.
    """

    def __init__(self, bounds: Bounds, *, every_count: bool = False) -> None:
        self.bounds = bounds
        self.local = LocalStates(bounds, every_count=every_count)
        self.zones = Zones()
        self._instants = Instants(self.local, bounds, every_order=every_count)
        self._order = Order(self.local, self.zones, self.name_of) if bounds.alike or bounds.blocks_alike else None
        self._known: dict[tuple[tuple[int, ...], Actions, int], _Instant] = {}
        self._running = lru_cache(MOST_KNOWN)(self._running_of)
        self._as_they_are = tuple(range(bounds.agents))
        own = [1] * bounds.agents if bounds.alike else range(1, bounds.agents + 1)
        faults = sum(1 << ONCE.index(name) for name in bounds.faults if name != "duplicate")
        self.captor = None if bounds.captured is None else Captor(bounds, self.local)
        if bounds.captured is not None:
            faults += (1 << ONCE.index("captured")) + bounds.lies * LIES
        faults += (bounds.coincidences or 0) * COINCIDENCES + (bounds.losses or 0) * LOSSES
        self.initial: State = (0, faults, NOTHING_RUNS, *(self.local.initial[agent_id] for agent_id in own))

    # What an instant begins with

    def firsts(self, state: State) -> list[Action]:
        """The timers that may be the next to end, each in all ways in which it may."""
        return [action for actions in self._firsts(state) for action in actions]

    def _firsts(self, state: State) -> list[list[Action]]:
        """The same by timer."""
        running = self._running(state[AGENTS:])
        if not self.bounds.timers_any:
            running = tuple([running[first - 1] for first in self.zones.firsts(state[ZONE])])
        return [
            [Action(place, "timer", timer, way) for way in range(len(self.local.ends(state[AGENTS + place], timer)))]
            for place, timer in running
        ]

    def alternatives(self, state: State) -> Iterator[tuple[Action, frozenset[Action]]]:
        """Each timer that may be the next to end, with those that have to end at that very moment, and itself.

        And that for all that blocks may be to them: which of two is the older nobody can choose.
        """
        firsts = self._firsts(state)
        tied = [(index,) for index in range(len(firsts))] if self.bounds.timers_any else self.zones.tied(state[ZONE])
        for first, others in enumerate(tied):
            together = [first, *[other for other in others if other != first]]
            for actions in product(*(firsts[index] for index in together)):
                yield actions[0], frozenset(actions)

    def ending(self, state: State) -> Iterator[Actions]:
        """All sets of timers that may end in one instant, of each agent one at most; some of the sets cannot.

        Where nothing crosses they end one by one.
        """
        by_place: dict[int, list[Action]] = {}
        for action in self.firsts(state):
            by_place.setdefault(action.place, []).append(action)
        most = len(by_place) if self.bounds.crossing else 1
        for count in range(1, most + 1):
            for places in combinations(by_place, count):
                for actions in product(*(by_place[place] for place in places)):
                    if self._may_coincide(state, actions):
                        yield actions

    def actions(self, state: State, ending: Iterable[Actions] | None = None) -> Iterator[Actions]:
        """All sets of what may happen in one instant: timers that end at once, and blocks completed meanwhile.

        `ending` has what there is of it, if that is known.
        """
        alive = [place for place, local in enumerate(state[AGENTS:]) if local != DEAD]
        left = self.bounds.blocks - state[BLOCKS]
        for timers in self.ending(state) if ending is None else ending:
            yield timers
            if not self.bounds.crossing:
                continue
            idle_hands = [place for place in alive if all(place != action.place for action in timers)]
            for count in range(1, min(left, len(idle_hands)) + 1):
                for places in self._unlike(state, permutations(idle_hands, count)):
                    completed = (
                        Action(place, "complete", state[BLOCKS] + 1 + index) for index, place in enumerate(places)
                    )
                    actions = (*timers, *completed)
                    if self._may_coincide(state, actions):
                        yield actions
        singly: list[Action] = []
        if left:
            for (place,) in self._unlike(state, ((place,) for place in alive)):
                singly.append(Action(place, "complete", state[BLOCKS] + 1))
        for bit, fault in enumerate(FAULTS):
            if state[LEFT] >> bit & 1:
                singly += [Action(place, fault) for place in alive]
        yield from ((action,) for action in singly if self._may_coincide(state, (action,)))
        if self.captor is not None:
            yield from self._of_the_captor(self.captor, state)

    def _of_the_captor(self, captor: Captor, state: State) -> Iterator[Actions]:
        """It takes the vehicle, and then says one thing after the other, which any of the agents hear."""
        assert self.bounds.captured is not None, "it has somebody's keys"
        if state[LEFT] >> ONCE.index("captured") & 1:
            yield (Action(self.bounds.captured - 1, "captured"),)
        elif _lies(state):
            yield from captor.lies(state[AGENTS:])

    def _may_coincide(self, state: State, actions: Sequence[Action]) -> bool:
        if self.bounds.coincidences is None:
            return True
        return self.coincidences(state, actions) <= state[LEFT] % LOSSES // COINCIDENCES

    def coincidences(self, state: State, actions: Sequence[Action]) -> int:
        """How many moments have to be the same by chance for this to happen in one instant, and before all else."""
        if self.bounds.timers_any:
            return 0
        ended = self._ended(state[AGENTS:], actions)
        if not ended:
            chosen = actions[0].what in ("captured", "lie")  # by somebody who may wait for his moment
            between = not chosen and self.zones.no_time_passes(state[ZONE])
            return len({(action.what, action.number) for action in actions}) - 1 + between
        if self.zones.after(state[ZONE], ended, ()) is None:
            return len(actions)  # they never end at once
        return self.zones.coincidences(state[ZONE], ended) + len(actions) - len(ended)

    def _unlike(self, state: State, choices: Iterable[tuple[int, ...]]) -> Iterator[tuple[int, ...]]:
        """Of all choices of agents one for each that makes a difference: agents at rest in one state are alike.

        Unless somebody has heard one of them and not the other.
        """
        known = self.local.known
        locals_ = state[AGENTS:]
        if not self.bounds.alike or any(local != DEAD and known[local].names_others for local in locals_):
            yield from choices
            return
        seen = set()
        for places in choices:
            looks = tuple(place if known[locals_[place]].running else -1 - locals_[place] for place in places)
            if looks not in seen:
                seen.add(looks)
                yield places

    # What comes of it

    def after(self, state: State, actions: Actions, lossy: bool) -> Iterator[State]:
        """The states that may come of these actions in one instant; none if their timers cannot end at once."""
        key = state[AGENTS:], actions, self._most_lost(state, lossy)
        instant = self._known.get(key)
        if instant is None:
            if len(self._known) >= MOST_KNOWN:
                self._known.clear()
            instant = self._known[key] = self._instant(*key, tell=False)
        if self._can_be(state, instant):
            left = self._left(state, actions, instant)
            for outcome, there in zip(instant.outcomes, self._ordered(state, instant, left), strict=True):
                still = left - outcome.way.lost * LOSSES
                yield (state[BLOCKS] + instant.completed, still, there.zone, *there.agents)

    def moves(self, state: State, actions: Actions, lossy: bool) -> Iterator[Move]:
        """The same, with how each comes about."""
        instant = self._instant(state[AGENTS:], actions, self._most_lost(state, lossy), tell=True)
        if self._can_be(state, instant):
            left = self._left(state, actions, instant)
            ordered = self._ordered(state, instant, left)
            for outcome, there in zip(instant.outcomes, ordered, strict=True):
                still = left - outcome.way.lost * LOSSES
                after = (state[BLOCKS] + instant.completed, still, there.zone, *there.agents)
                yield Move(actions, after, there.places, outcome.way.wave, outcome.started, there.blocks)

    def _most_lost(self, state: State, lossy: bool) -> int:
        """So many messages may be lost in an instant."""
        if not lossy:
            return 0
        return ANY_NUMBER if self.bounds.losses is None else state[LEFT] // LOSSES

    def _can_be(self, state: State, instant: _Instant) -> bool:
        """Whether these timers can end at once, before all others; it is known that each can by itself."""
        if len(instant.ended) < 2 or self.bounds.timers_any:
            return True
        return self.zones.after(state[ZONE], instant.ended, ()) is not None

    def _ordered(self, state: State, instant: _Instant, left: int) -> Iterator[Ordered]:
        completed = state[BLOCKS] + instant.completed
        only_timers = self.bounds.reduced and completed >= self.bounds.blocks and not left % COINCIDENCES
        for outcome in instant.outcomes:
            zone = NOTHING_RUNS
            if not self.bounds.timers_any:
                after = self.zones.after(state[ZONE], instant.ended, outcome.running)
                assert after is not None, "these timers can end at once"
                zone = self.zones.adrift(after) if only_timers else after
            if self._order is None:
                yield Ordered(outcome.agents, zone, self._as_they_are)
            else:
                yield self._order.of(outcome.agents, zone)

    def _left(self, state: State, actions: Sequence[Action], instant: _Instant) -> int:
        """What may still befall."""
        left = (state[LEFT] & instant.left) - instant.lies * LIES
        if self.bounds.coincidences:
            left -= self.coincidences(state, actions) * COINCIDENCES
        return left

    def _instant(self, locals_: tuple[int, ...], actions: Actions, most_lost: int, *, tell: bool) -> _Instant:
        at = {timer: index + 1 for index, timer in enumerate(self._running(locals_))}
        left = ALL_LEFT
        for action in actions:
            if action.what in ONCE:
                left &= ~(1 << ONCE.index(action.what))
        return _Instant(
            self._ended(locals_, actions),
            sum(action.what == "complete" for action in actions),
            left,
            int(any(action.what == "lie" for action in actions)),
            tuple(
                _Outcome(there.locals, self._running_after(at, there), there.started if tell else (), way)
                for there, way in self._instants.outcomes(locals_, actions, most_lost, tell=tell).items()
            ),
        )

    def _running_after(self, at: dict[tuple[int, int], int], there: Agents) -> tuple[int, ...]:
        """Of each timer that runs then which it was, or, if it has just been started, minus its duration less one."""
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

    def _ended(self, locals_: tuple[int, ...], actions: Sequence[Action]) -> tuple[int, ...]:
        """The timers that end, from 1, in the order of the zone."""
        ended = [(action.place, action.number) for action in actions if action.what == "timer"]
        running = self._running(locals_)
        return tuple(sorted([running.index(timer) + 1 for timer in ended]))

    def _running_of(self, locals_: tuple[int, ...]) -> tuple[tuple[int, int], ...]:
        """(place, timer) of all timers that run, in the order of the zone."""
        known = self.local.known
        return tuple(
            [(place, timer) for place, local in enumerate(locals_) if local != DEAD for timer in known[local].running]
        )

    def name_of(self, other: int, place: int) -> int:
        """What the agent at `place` calls the one at `other`."""
        return self._instants.name_of(other, place)

    def order_matters(self, local: int, place: int, wave: Wave, heard: Sequence[int]) -> bool:
        """Whether it makes a difference to the agent at `place` in which order it hears what it heard of the wave."""
        return self._instants.order_matters(local, place, wave, heard)

    # What is to be known of a state

    def flaw(self, state: State) -> Flaw | None:
        """What must never be and is, at one of its agents."""
        known = self.local.known
        return next((flaw for local in state[AGENTS:] if local != DEAD and (flaw := known[local].flaw)), None)

    def violated(self, state: State) -> Iterator[str]:
        """Characteristics that a captor has violated though no agent has done anything wrong.

        Somebody believed what the vehicle never sent, or holds a block in its name that it never completed.
        """
        if _lies(state) < self.bounds.lies:
            yield "1"
        if any(local != DEAD and self.local.known[local].deceived for local in state[AGENTS:]):
            yield "4"

    def is_idle(self, state: State) -> bool:
        return all(local == DEAD or self.local.known[local].idle for local in state[AGENTS:])

    def chains(self, state: State) -> set[tuple[int, ...]]:
        """The chains that there are."""
        return {self.local.known[local].chain for local in state[AGENTS:] if local != DEAD}


def _lies(state: State) -> int:
    """How many lies may yet be told."""
    return state[LEFT] % COINCIDENCES // LIES
