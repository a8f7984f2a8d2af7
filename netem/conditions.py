"""Represent network conditions independently of the mechanism that applies them. Network conditions are the conditions
of all links, and a partition.

As in the thesis, conditions belong to the receiver. Each receiver of a broadcast loses or receives the broadcast
independently of the other receivers. In addition, a link can have its own conditions. A link leads from one sender to
one receiver, in this direction only. `netem.link` defines the conditions of a link. A partition is a tuple of groups. A
packet reaches only vehicles in the group of its sender. Vehicles in no group form a further group. A partition with a
single group therefore separates this group from all other vehicles.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import chain, permutations
from typing import Any

from netem.addresses import MAX_ID, MIN_ID
from netem.errors import ConditionsError
from netem.link import Delay, Distribution, GilbertElliott, LinkConditions, keywords

__all__ = ["Delay", "Distribution", "GilbertElliott", "LinkConditions", "NetworkConditions"]


@dataclass(frozen=True)
class NetworkConditions:
    """The network conditions of all links at one time.

    The first match among `links` (by sender and receiver), `receivers` (by receiver) and `default` determines the
    conditions of a packet. The conditions of different matches are not combined. `partition` contains disjoint groups
    of vehicle IDs. Vehicles of different groups cannot reach each other. An empty tuple means that there is no
    partition.
    """

    default: LinkConditions = field(default_factory=LinkConditions)
    receivers: Mapping[int, LinkConditions] = field(default_factory=dict)
    links: Mapping[tuple[int, int], LinkConditions] = field(default_factory=dict)
    partition: tuple[frozenset[int], ...] = ()

    def __post_init__(self) -> None:
        for vehicle in self.receivers:
            _check_id("receivers", vehicle)
        for sender, receiver in self.links:
            _check_id("links", sender)
            _check_id("links", receiver)
            if sender == receiver:
                raise ConditionsError(f"links: {sender}>{receiver} leads to itself; allowed is another receiver")
        # Copies, so that later changes by the caller have no effect.
        object.__setattr__(self, "receivers", dict(sorted(self.receivers.items())))
        object.__setattr__(self, "links", dict(sorted(self.links.items())))
        groups = tuple(frozenset(group) for group in self.partition)
        seen: set[int] = set()
        for index, group in enumerate(groups):
            key = f"partition[{index}]"
            if not group:
                raise ConditionsError(f"{key}: the group is empty; allowed is one or more vehicle IDs")
            for vehicle in group:
                _check_id(key, vehicle)
            if both := sorted(seen & group):
                raise ConditionsError(
                    f"{key}: {_name(both)} is in an earlier group too; allowed is one group per vehicle"
                )
            seen |= group
        object.__setattr__(self, "partition", groups)

    def link(self, sender: int, receiver: int) -> LinkConditions:
        """Return the network conditions for packets from `sender` to `receiver`, without considering the partition."""
        return self.links.get((sender, receiver)) or self.receivers.get(receiver, self.default)

    def all_links(self) -> tuple[LinkConditions, ...]:
        """Return the conditions of all links, with the default first. Links may have equal conditions."""
        return self.default, *self.receivers.values(), *self.links.values()

    def is_cut(self, sender: int, receiver: int) -> bool:
        """Return true if a partition separates the two vehicles."""
        return self._group(sender) != self._group(receiver)

    @property
    def fully_connected(self) -> bool:
        """True if there is no partition and no link loses packets. Packets may still be late or duplicated."""
        links = self.all_links()
        return not self.partition and all(link.lossless for link in links)

    def needs(self) -> tuple[str, ...]:
        """Return the names of all network conditions in use, other than independent loss and partition. Each condition
        occurs once. If the default conditions use it, its name is a word such as "delay". Otherwise the name includes
        the first receiver or link that uses the condition, for example "receivers 3 reorder" or "links 1>2 delay".
        """
        asked = {key: key for key in self.default.needs()}
        for vehicle, link in self.receivers.items():
            asked |= {key: f"receivers {vehicle} {key}" for key in link.needs() if key not in asked}
        for (sender, receiver), link in self.links.items():
            asked |= {key: f"links {sender}>{receiver} {key}" for key in link.needs() if key not in asked}
        return tuple(asked.values())

    def differing_links(self) -> Iterator[tuple[int, int, LinkConditions]]:
        """Yield (sender, receiver, conditions) for each link whose network conditions differ from the usual conditions
        of its receiver.
        """
        for (sender, receiver), link in self.links.items():
            if link != self.receivers.get(receiver, self.default):
                yield sender, receiver, link

    def groups(self, vehicles: Iterable[int]) -> tuple[frozenset[int], ...]:
        """Divide these vehicles into the groups of the partition, and return the groups. Vehicles in no group form the
        last group. Without a partition, return all vehicles as one group.
        """
        members: dict[int, set[int]] = {}
        for vehicle in vehicles:
            members.setdefault(self._group(vehicle), set()).add(vehicle)
        return tuple(frozenset(members[index]) for index in sorted(members))

    def with_partition(self, groups: Iterable[Iterable[int]]) -> NetworkConditions:
        """Return a copy of these network conditions with this partition."""
        return replace(self, partition=tuple(frozenset(group) for group in groups))

    def healed(self) -> NetworkConditions:
        """Return a copy of these network conditions without a partition."""
        return replace(self, partition=())

    def with_listener(self, listener: int, vehicles: Iterable[int]) -> NetworkConditions:
        """Return these network conditions with an additional vehicle `listener`, whose links to and from `vehicles` are
        perfect.

        Links with a loss of 1 replace the partition, because the listener must reach the vehicles of all groups.
        """
        roster, open_air = tuple(vehicles), LinkConditions()
        cut = {pair: LinkConditions(loss=1.0) for pair in permutations(roster, 2) if self.is_cut(*pair)}
        heard = {pair: open_air for vehicle in roster for pair in ((listener, vehicle), (vehicle, listener))}
        return replace(self, links={**self.links, **cut, **heard}, partition=())

    def at_speed(self, speedup: float) -> NetworkConditions:
        """Convert these network conditions from mission time to wall time. `speedup` is the number of mission seconds
        per second of wall time. A kernel measures wall time, so the method divides delays by `speedup` and multiplies
        rates by `speedup`.
        """
        if speedup == 1:
            return self
        return replace(
            self,
            default=self.default.at_speed(speedup),
            receivers={vehicle: link.at_speed(speedup) for vehicle, link in self.receivers.items()},
            links={pair: link.at_speed(speedup) for pair, link in self.links.items()},
        )

    def validate(self, vehicles: Iterable[int]) -> None:
        """Raise ConditionsError if the network conditions name a vehicle that is not in `vehicles`."""
        known = set(vehicles)
        named = [("receivers", frozenset(self.receivers)), ("links", frozenset(chain.from_iterable(self.links)))]
        named += [(f"partition[{index}]", group) for index, group in enumerate(self.partition)]
        for key, group in named:
            if unknown := sorted(group - known):
                allowed = ", ".join(map(str, sorted(known)))
                raise ConditionsError(f"{key}: unknown {_name(unknown)}; allowed is any of {allowed}")

    def to_json(self) -> dict[str, Any]:
        return {
            "default": self.default.to_json(),
            "receivers": {str(vehicle): link.to_json() for vehicle, link in self.receivers.items()},
            "links": {f"{sender}>{receiver}": link.to_json() for (sender, receiver), link in self.links.items()},
            "partition": [sorted(group) for group in self.partition],
        }

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> NetworkConditions:
        """Create the network conditions from a JSON object in the format of `to_json`. Raises ConditionsError."""
        keywords(cls, value)
        return cls(
            LinkConditions.from_json(value.get("default", {})),
            {int(key): LinkConditions.from_json(link) for key, link in value.get("receivers", {}).items()},
            {_pair(key): LinkConditions.from_json(link) for key, link in value.get("links", {}).items()},
            tuple(frozenset(group) for group in value.get("partition", ())),
        )

    def _group(self, vehicle: int) -> int:
        for index, group in enumerate(self.partition):
            if vehicle in group:
                return index
        return len(self.partition)


def _check_id(key: str, vehicle: object) -> None:
    if isinstance(vehicle, bool) or not isinstance(vehicle, int) or not MIN_ID <= vehicle <= MAX_ID:
        raise ConditionsError(f"{key}: {vehicle!r} is not a vehicle ID; allowed is {MIN_ID}..{MAX_ID}")


def _pair(key: str) -> tuple[int, int]:
    sender, separator, receiver = key.partition(">")
    if not (separator and sender.isdecimal() and receiver.isdecimal()):
        raise ConditionsError(f'links: {key!r} is not a link; allowed is "sender>receiver", such as "1>2"')
    return int(sender), int(receiver)


def _name(vehicles: list[int]) -> str:
    return f"vehicle {vehicles[0]}" if len(vehicles) == 1 else f"vehicles {', '.join(map(str, vehicles))}"
