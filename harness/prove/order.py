"""Of all orders of the agents one that stands for all: agents that are alike change places freely.

It is chosen by what the agents are and how their timers stand to each other, never by the numbers that states and zones
have got: so it is the same on any machine, and in whatever order states were come upon.
"""

from collections.abc import Callable, Iterator, Sequence
from itertools import groupby, islice, permutations, product
from typing import Any

from harness.prove.local import DEAD, LocalStates
from harness.prove.parts import NAMES_OF_OTHERS
from harness.prove.zones import Zones

Places = tuple[int, ...]
"""For each place of a state the place at which its agent stood before."""

MOST_KNOWN = 200_000
"""So many orders are remembered; then they are chosen again."""
MOST_ORDERS = 120
"""So many orders of agents that look alike are compared; of more, states that are alike may count as several."""


class Order:
    """Puts agents in order. `name_of` is what the agent at a place calls the one at another."""

    def __init__(self, local: LocalStates, zones: Zones, name_of: Callable[[int, int], int]) -> None:
        self._as_they_are = tuple(range(local.bounds.agents))
        self._local = local
        self._zones = zones
        self._name_of = name_of
        self._known: dict[tuple[tuple[int, ...], int], tuple[tuple[int, ...], int, Places]] = {}

    def of(self, locals_: tuple[int, ...], zone: int) -> tuple[tuple[int, ...], int, Places]:
        """The agents in order, the zone with their timers in that order, and where each of them stood."""
        key = locals_, zone
        ordered = self._known.get(key)
        if ordered is None:
            if len(self._known) >= MOST_KNOWN:
                self._known.clear()
            ordered = self._known[key] = self._put_in_order(locals_, zone)
        return ordered

    def _put_in_order(self, locals_: tuple[int, ...], zone: int) -> tuple[tuple[int, ...], int, Places]:
        timers = self._timers(locals_)
        orders = list(islice(self._orders(locals_, zone, timers), MOST_ORDERS))
        places = orders[0]
        if len(orders) > 1:
            places = min(orders, key=lambda places: self._looks(locals_, zone, timers, places))
        if places == self._as_they_are:
            return locals_, zone, places
        agents = tuple([self._renamed(locals_[old], new, places) for new, old in enumerate(places)])
        if zone:
            zone = self._zones.permuted(zone, tuple([timer for place in places for timer in timers[place]]))
        return agents, zone, places

    def _timers(self, locals_: Sequence[int]) -> list[range]:
        """For each place which of the zone's timers are its agent's."""
        timers, first = [], 1
        for local in locals_:
            end = first if local == DEAD else first + len(self._local.known[local].running)
            timers.append(range(first, end))
            first = end
        return timers

    def _orders(self, locals_: tuple[int, ...], zone: int, timers: Sequence[range]) -> Iterator[Places]:
        """All orders of the agents by what can be said of each; those of whom the same can be said in any."""
        known = self._local.known
        bounds = self._zones.bounds(zone) if zone else [()]
        looks: list[tuple[Any, ...]] = [
            (DEAD,) if local == DEAD else (known[local].anonymous, *bounds[own.start : own.stop])
            for local, own in zip(locals_, timers, strict=True)
        ]
        if len(set(looks)) == len(looks):
            yield tuple(sorted(range(len(locals_)), key=looks.__getitem__))
            return
        named: list[list[set[int]]] = []
        if any(local != DEAD and known[local].names_others for local in locals_):
            named = [self._named(local, place) for place, local in enumerate(locals_)]
            looks = [
                (
                    looks[place],
                    *sorted(
                        (looks[other], *(place in part for part in named[other]), *(other in part for part in here))
                        for other in range(len(locals_))
                        if other != place
                    ),
                )
                for place, here in enumerate(named)
            ]
        groups = [
            list(group) for _, group in groupby(sorted(range(len(locals_)), key=looks.__getitem__), looks.__getitem__)
        ]
        matter = [not self._change_places_freely(group, timers, named) for group in groups]
        orders = [permutations(group) if many else (tuple(group),) for group, many in zip(groups, matter, strict=True)]
        for chosen in product(*orders):
            yield tuple(place for group in chosen for place in group)

    def _change_places_freely(
        self, group: Sequence[int], timers: Sequence[range], named: Sequence[Sequence[set[int]]]
    ) -> bool:
        """Whether agents that look alike are one as the other: without timers, and in nobody's tally or in the same."""
        if timers[group[0]]:
            return False
        return all(
            not part if place in group else part.issuperset(group) or part.isdisjoint(group)
            for place, parts in enumerate(named)
            for part in parts
        )

    def _named(self, local: int, place: int) -> list[set[int]]:
        """For each kind of tally whom the agent at `place` has in it, by their places."""
        if local == DEAD:
            return [set() for _ in NAMES_OF_OTHERS]
        snapshot = self._local.known[local].snapshot
        return [{self._place_of(other, place) for other in snapshot[name]} for name in NAMES_OF_OTHERS]

    def _place_of(self, name: int, place: int) -> int:
        """Whom the agent at `place` calls so."""
        return name - 2 if name - 2 < place else name - 1

    def _looks(self, locals_: tuple[int, ...], zone: int, timers: Sequence[range], places: Places) -> tuple[Any, ...]:
        """What tells this order from others."""
        new_place = {old: new for new, old in enumerate(places)}
        named = [
            [sorted(new_place[other] for other in part) for part in self._named(locals_[old], old)] for old in places
        ]
        matrix = self._zones.matrix(zone)
        order = (0, *(timer for place in places for timer in timers[place])) if zone else ()
        return named, [[matrix[i][j] for j in order] for i in order]

    def _renamed(self, local: int, new: int, places: Places) -> int:
        """The agent at its new place, calling the others by theirs."""
        if local == DEAD:
            return local
        if not self._local.known[local].names_others:
            return local
        names = [0] * (len(places) - 1)
        for other_new, other_old in enumerate(places):
            if other_new != new:
                names[self._name_of(other_old, places[new]) - 2] = self._name_of(other_new, new)
        return self._local.renamed(local, tuple(names))
