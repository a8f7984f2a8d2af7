"""Global states, and all that may happen next in each.

A global state is how many blocks were completed, which faults are left, the zone of the timers that run, and the
agents' local states: a tuple of small numbers. Where `bounds.reduced`, agents that are alike change places freely:
of all orders of the agents one stands for all.
"""

from collections.abc import Iterable, Iterator, Sequence
from itertools import combinations, permutations, product
from typing import NamedTuple

from harness.prove.bounds import FAULTS, Bounds
from harness.prove.instant import Action, Agents, Instants, Wave
from harness.prove.local import DEAD, Flaw, LocalStates, Started
from harness.prove.zones import NOTHING_RUNS, Zones

State = tuple[int, ...]
"""Blocks completed, faults left (a bit for each), zone, then the agents."""
BLOCKS, LEFT, ZONE, AGENTS = 0, 1, 2, 3
"""Where they stand in it."""

Places = tuple[int, ...]
"""For each place of a state the place at which its agent stood before."""


class Move(NamedTuple):
    """One way on: what is done, what comes of it, and who then stands where. `wave` is the last round of hearing."""

    actions: tuple[Action, ...]
    state: State
    places: Places
    wave: Wave | None
    started: tuple[Started, ...]
    """By the places before."""


class Swarm:
    """All global states of `bounds` are made here."""

    def __init__(self, bounds: Bounds) -> None:
        self.bounds = bounds
        self.local = LocalStates(bounds)
        self.zones = Zones()
        self._instants = Instants(self.local, bounds)
        self._in_order: dict[tuple[tuple[int, ...], int], tuple[tuple[int, ...], int, Places]] = {}
        own = [1] * bounds.agents if bounds.reduced else range(1, bounds.agents + 1)
        faults = sum(1 << FAULTS.index(name) for name in bounds.faults if name != "duplicate")
        self.initial: State = (0, faults, NOTHING_RUNS, *(self.local.initial[agent_id] for agent_id in own))

    # What an instant begins with

    def firsts(self, state: State) -> list[Action]:
        """The timers that may be the next to end."""
        running = self._running(state[AGENTS:])
        if self.bounds.timers_any:
            return [Action(place, "timer", timer) for place, timer in running]
        return [
            Action(running[first - 1][0], "timer", running[first - 1][1]) for first in self.zones.firsts(state[ZONE])
        ]

    def ending(self, state: State) -> Iterator[tuple[Action, ...]]:
        """All sets of timers that may end in one instant, of each agent one at most; some of the sets cannot."""
        by_place: dict[int, list[Action]] = {}
        for action in self.firsts(state):
            by_place.setdefault(action.place, []).append(action)
        for count in range(1, len(by_place) + 1):
            for places in combinations(by_place, count):
                for actions in product(*(by_place[place] for place in places)):
                    if not (self.bounds.apart and self.coincidences(state, actions)):
                        yield actions

    def actions(self, state: State) -> Iterator[tuple[Action, ...]]:
        """All sets of what may happen in one instant: timers that end at once, and blocks completed meanwhile."""
        alive = [place for place, local in enumerate(state[AGENTS:]) if local != DEAD]
        left = self.bounds.blocks - state[BLOCKS]
        for ending in self.ending(state):
            yield ending
            if self.bounds.apart:
                continue
            idle_hands = [place for place in alive if all(place != action.place for action in ending)]
            for count in range(1, min(left, len(idle_hands)) + 1):
                for places in self._unlike(state, permutations(idle_hands, count)):
                    completed = (
                        Action(place, "complete", state[BLOCKS] + 1 + index) for index, place in enumerate(places)
                    )
                    yield (*ending, *completed)
        if left:
            for (place,) in self._unlike(state, ((place,) for place in alive)):
                yield (Action(place, "complete", state[BLOCKS] + 1),)
        for bit, fault in enumerate(FAULTS):
            if state[LEFT] >> bit & 1:
                yield from ((Action(place, fault),) for place in alive)

    def coincidences(self, state: State, actions: Sequence[Action]) -> int:
        """How many moments have to be the same by chance for this to happen in one instant, and before all else."""
        if self.bounds.timers_any:
            return 0
        at = {timer: index + 1 for index, timer in enumerate(self._running(state[AGENTS:]))}
        ended = tuple(sorted(at[action.place, action.number] for action in actions if action.what == "timer"))
        if not ended:
            return len(actions) - 1
        if self.zones.after(state[ZONE], ended, ()) is None:
            return len(actions)  # they never end at once
        return self.zones.coincidences(state[ZONE], ended) + len(actions) - len(ended)

    def _unlike(self, state: State, choices: Iterable[tuple[int, ...]]) -> Iterator[tuple[int, ...]]:
        """Of all choices of agents one for each that makes a difference: agents at rest in one state are alike.

        Unless somebody has heard one of them and not the other.
        """
        known = self.local.known
        locals_ = state[AGENTS:]
        if not self.bounds.reduced or any(local != DEAD and known[local].names_others for local in locals_):
            yield from choices
            return
        seen = set()
        for places in choices:
            looks = tuple(place if known[locals_[place]].running else -1 - locals_[place] for place in places)
            if looks not in seen:
                seen.add(looks)
                yield places

    # What comes of it

    def moves(self, state: State, actions: Sequence[Action], lossy: bool) -> Iterator[Move]:
        """All that may come of these actions in one instant; none if their timers cannot end at once."""
        locals_ = state[AGENTS:]
        running = self._running(locals_)
        at = {timer: index + 1 for index, timer in enumerate(running)}
        ended = tuple(sorted(at[action.place, action.number] for action in actions if action.what == "timer"))
        if len(ended) > 1 and not self.bounds.timers_any and self.zones.after(state[ZONE], ended, ()) is None:
            return
        blocks = state[BLOCKS] + sum(action.what == "complete" for action in actions)
        left = state[LEFT]
        for action in actions:
            if action.what in FAULTS:
                left &= ~(1 << FAULTS.index(action.what))
        for there, wave in self._instants.outcomes(locals_, actions, lossy).items():
            zone = NOTHING_RUNS if self.bounds.timers_any else self._zone_after(state[ZONE], ended, at, there)
            agents, zone, places = self._ordered(there.locals, zone)
            yield Move(tuple(actions), (blocks, left, zone, *agents), places, wave, there.started)

    def _zone_after(self, zone: int, ended: tuple[int, ...], at: dict[tuple[int, int], int], there: Agents) -> int:
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
        after = self.zones.after(zone, ended, tuple(running))
        assert after is not None, "these timers can end at once"
        return after

    def _running(self, locals_: Sequence[int]) -> list[tuple[int, int]]:
        """(place, timer) of all timers that run, in the order of the zone."""
        known = self.local.known
        return [
            (place, timer) for place, local in enumerate(locals_) if local != DEAD for timer in known[local].running
        ]

    def _ordered(self, locals_: tuple[int, ...], zone: int) -> tuple[tuple[int, ...], int, Places]:
        """One of all orders of the agents, and where each of them stood."""
        if not self.bounds.reduced:
            return locals_, zone, tuple(range(len(locals_)))
        key = locals_, zone
        ordered = self._in_order.get(key)
        if ordered is None:
            ordered = self._in_order[key] = self._put_in_order(locals_, zone)
        return ordered

    def _put_in_order(self, locals_: tuple[int, ...], zone: int) -> tuple[tuple[int, ...], int, Places]:
        known = self.local.known
        running = self._running(locals_)

        def looks(place: int) -> tuple[object, ...]:
            if locals_[place] == DEAD:
                return (DEAD,)
            mine = [index + 1 for index, (owner, _) in enumerate(running) if owner == place]
            bounds = [] if self.bounds.timers_any else [self.zones.bounds(zone, timer) for timer in mine]
            return (known[locals_[place]].anonymous, *bounds)

        places = tuple(sorted(range(len(locals_)), key=looks))
        agents = []
        for new, old in enumerate(places):
            local = locals_[old]
            if local != DEAD and known[local].names_others and known[local].flaw is None:
                names = [0] * (len(places) - 1)
                for other_new, other_old in enumerate(places):
                    if other_old != old:
                        names[self._instants.name_of(other_old, old) - 2] = self._instants.name_of(other_new, new)
                local = self.local.renamed(local, tuple(names))
            agents.append(local)
        if not self.bounds.timers_any:
            order = [index + 1 for place in places for index, (owner, _) in enumerate(running) if owner == place]
            zone = self.zones.permuted(zone, tuple(order))
        return tuple(agents), zone, places

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

    def is_idle(self, state: State) -> bool:
        return all(local == DEAD or self.local.known[local].idle for local in state[AGENTS:])

    def chains(self, state: State) -> set[tuple[int, ...]]:
        """The chains that there are."""
        return {self.local.known[local].chain for local in state[AGENTS:] if local != DEAD}
