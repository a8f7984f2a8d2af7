"""Choose one order of the agents in a state to represent all equivalent orders. Agents with equal states and timers can
change places without an effect, and so can blocks.

The choice depends on the states of the agents and the relations of their timers, but not on the numbers that the prover
gave to states and zones. The order is therefore the same on all machines, and for any order of exploration.
"""

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from itertools import chain, groupby, islice, permutations, product
from typing import Any, NamedTuple

from harness.proof.model._block_renaming import Ordinals
from harness.proof.model._known_states import DEAD
from harness.proof.model._local_steps import LocalStates
from harness.proof.model._snapshot import NAMES_OF_OTHERS
from harness.proof.model._zones import ZoneTable

Places = tuple[int, ...]
"""New position of an agent in a state -> its previous position."""


class OrderedAgents(NamedTuple):
    """The agents of a state in their chosen order, their timers in the same order, and the previous position of each
    agent.

    `blocks` contains the previous number of each block, counted from 1. It is empty if the blocks keep their numbers.
    """

    agents: tuple[int, ...]
    zone: int
    places: Places
    blocks: Ordinals = ()


MOST_KNOWN = 200_000
"""Maximum number of cached orders. When the cache exceeds this number, it is emptied."""
MOST_ORDERS = 120
"""Maximum number of orders of similar agents that are compared. If more orders exist, equivalent states may count as
several states.
"""


class CanonicalOrder:
    """The order of the agents that represents all equivalent orders. The method `of` puts the agents of a state into
    this order.

    Agents use IDs for each other. `name_of` returns the ID that the agent at one position uses for the agent at another
    position.
    """

    def __init__(self, local: LocalStates, zones: ZoneTable, name_of: Callable[[int, int], int]) -> None:
        self._as_they_are = tuple(range(local.bounds.agents))
        self._local = local
        self._zones = zones
        self._name_of = name_of
        self._known: dict[tuple[tuple[int, ...], int], OrderedAgents] = {}

    def of(self, locals_: tuple[int, ...], zone: int) -> OrderedAgents:
        key = locals_, zone
        ordered = self._known.get(key)
        if ordered is None:
            if len(self._known) >= MOST_KNOWN:
                self._known.clear()
            ordered = self._known[key] = self._put_in_order(locals_, zone)
        return ordered

    def _put_in_order(self, locals_: tuple[int, ...], zone: int) -> OrderedAgents:
        timers = self._timers(locals_)
        orders = [self._as_they_are]
        if self._local.bounds.alike:
            orders = list(islice(self._orders(locals_, zone, timers), MOST_ORDERS))
        places = orders[0]
        if len(orders) > 1:
            places = min(orders, key=lambda places: self._described_in_order(locals_, zone, timers, places))
        if places != self._as_they_are:
            agents = tuple([self._renamed(locals_[old], new, places) for new, old in enumerate(places)])
            if zone:
                zone = self._zones.permuted(zone, tuple([timer for place in places for timer in timers[place]]))
        else:
            agents = locals_
        blocks = self._blocks(agents)
        if blocks == tuple(range(1, len(blocks) + 1)):
            return OrderedAgents(agents, zone, places)
        number = {block: new for new, block in enumerate(blocks, 1)}
        about, exchanged = self._local.about, self._local.exchanged
        agents = tuple([exchanged(local, tuple([number[block] for block in about(local)])) for local in agents])
        return OrderedAgents(agents, zone, places, blocks)

    def _blocks(self, agents: Sequence[int]) -> Ordinals:
        """Return the numbers of the agents' blocks in the order in which the blocks first occur.

        The result is empty if blocks are not renumbered.
        """
        if not self._local.bounds.blocks_alike:
            return ()
        return tuple(dict.fromkeys(chain.from_iterable(map(self._local.about, agents))))

    def _timers(self, locals_: Sequence[int]) -> list[range]:
        """Return, for each agent, the range of its timers in the list of the swarm's timers."""
        timers, first = [], 1
        for local in locals_:
            end = first if local == DEAD else first + len(self._local.known[local].running)
            timers.append(range(first, end))
            first = end
        return timers

    def _orders(self, locals_: tuple[int, ...], zone: int, timers: Sequence[range]) -> Iterator[Places]:
        """Sort the agents by their descriptions, and yield each possible order. There are several orders if agents have
        equal descriptions, because these agents can be in any order among themselves.
        """
        known, pattern = self._local.known, self._local.pattern
        bounds = self._zones.bounds(zone) if zone else [()]
        descriptions: list[tuple[Any, ...]] = [
            (DEAD,) if local == DEAD else (known[pattern(local)].anonymous, *bounds[own.start : own.stop])
            for local, own in zip(locals_, timers, strict=True)
        ]
        groups = _groups(descriptions)
        some_named = any(local != DEAD and known[local].names_others for local in locals_)
        if all(len(group) == 1 or (not some_named and self._are_one(group, locals_, timers)) for group in groups):
            yield tuple(chain.from_iterable(groups))
            return
        if self._local.bounds.blocks_alike:
            descriptions = self._with_blocks(locals_, descriptions)
        named: list[list[set[int]]] = []
        if some_named:
            named = [self._named(local, place) for place, local in enumerate(locals_)]
            descriptions = [
                (
                    descriptions[place],
                    *sorted(
                        (
                            descriptions[other],
                            *(place in part for part in named[other]),
                            *(other in part for part in here),
                        )
                        for other in range(len(locals_))
                        if other != place
                    ),
                )
                for place, here in enumerate(named)
            ]
        orders = [
            _distinct(group, locals_) if self._change_places_freely(group, timers, named) else permutations(group)
            for group in _groups(descriptions)
        ]
        for chosen in product(*orders):
            yield tuple(place for group in chosen for place in group)

    def _are_one(self, group: Sequence[int], locals_: Sequence[int], timers: Sequence[range]) -> bool:
        """Return true if these agents are interchangeable, because they are in the same state and none of their timers
        runs.
        """
        return not timers[group[0]] and len({locals_[place] for place in group}) == 1

    def _with_blocks(self, locals_: Sequence[int], descriptions: Sequence[tuple[Any, ...]]) -> list[tuple[Any, ...]]:
        """Return the description of each agent, extended with the positions of its blocks in the states of
        all agents.
        """
        ranks = {description: rank for rank, description in enumerate(sorted(set(descriptions)))}
        where: dict[int, list[tuple[int, int]]] = defaultdict(list)
        for local, description in zip(locals_, descriptions, strict=True):
            for position, block in enumerate(self._local.about(local)):
                where[block].append((ranks[description], position))
        return [
            (description, *[tuple(sorted(where[block])) for block in self._local.about(local)])
            for local, description in zip(locals_, descriptions, strict=True)
        ]

    def _change_places_freely(
        self, group: Sequence[int], timers: Sequence[range], named: Sequence[Sequence[set[int]]]
    ) -> bool:
        """Return true if these agents with equal descriptions differ only in their blocks.

        This is the case if the agents have no timers and have counted no other agent. In addition, each vote count of
        another agent must contain all agents of the group, or none of them.
        """
        if timers[group[0]]:
            return False
        return all(
            not part if place in group else part.issuperset(group) or part.isdisjoint(group)
            for place, parts in enumerate(named)
            for part in parts
        )

    def _named(self, local: int, place: int) -> list[set[int]]:
        """Return, for each kind of vote count of the agent at `place`, the positions of the agents whose votes it has
        counted.
        """
        if local == DEAD:
            return [set() for _ in NAMES_OF_OTHERS]
        snapshot = self._local.known[local].snapshot
        return [{self._place_of(other, place) for other in snapshot[name]} for name in NAMES_OF_OTHERS]

    def _place_of(self, name: int, place: int) -> int:
        """Return the position of the agent that has this ID for the agent at `place`."""
        return name - 2 if name - 2 < place else name - 1

    def _described_in_order(
        self, locals_: tuple[int, ...], zone: int, timers: Sequence[range], places: Places
    ) -> tuple[Any, ...]:
        """Return a description of the state with this order of the agents. If two orders have equal descriptions, the
        states are equal.
        """
        new_place = {old: new for new, old in enumerate(places)}
        named = [
            [sorted(new_place[other] for other in part) for part in self._named(locals_[old], old)] for old in places
        ]
        matrix = self._zones.matrix(zone)
        order = (0, *(timer for place in places for timer in timers[place])) if zone else ()
        number = {block: new for new, block in enumerate(self._blocks([locals_[old] for old in places]))}
        about = [[number[block] for block in self._local.about(locals_[old])] for old in places] if number else []
        return named, about, [[matrix[i][j] for j in order] for i in order]

    def _renamed(self, local: int, new: int, places: Places) -> int:
        """Return the state of an agent at its new position. The state contains the new IDs of the other agents."""
        if local == DEAD:
            return local
        if not self._local.known[local].names_others:
            return local
        names = [0] * (len(places) - 1)
        for other_new, other_old in enumerate(places):
            if other_new != new:
                names[self._name_of(other_old, places[new]) - 2] = self._name_of(other_new, new)
        return self._local.renamed(local, tuple(names))


def _groups(descriptions: Sequence[Any]) -> list[list[int]]:
    """Group agents with equal descriptions. Return the positions of the agents in each group. The groups are in
    ascending order of their descriptions.
    """
    in_order = sorted(range(len(descriptions)), key=descriptions.__getitem__)
    return [list(group) for _, group in groupby(in_order, descriptions.__getitem__)]


def _distinct(group: Sequence[int], locals_: Sequence[int]) -> Iterator[Places]:
    """Yield all orders of these positions that lead to different sequences of states."""
    if not group:
        yield ()
    for first in {locals_[place]: place for place in reversed(group)}.values():
        rest = [place for place in group if place != first]
        yield from ((first, *others) for others in _distinct(rest, locals_))
