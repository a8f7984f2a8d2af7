"""What the air is like: loss and partitions as plain values, which know nothing of how they are applied.

Loss belongs to the receiver, as in the thesis: a broadcast is drawn for by every receiver on its own.
A partition is a tuple of groups; a packet crosses from one vehicle to another only inside a group.
Vehicles named in no group form one more group together, "the rest", so a single group cuts its members
off from everybody else.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from netem.addresses import MAX_ID, MIN_ID
from netem.errors import ConditionsError


@dataclass(frozen=True)
class LinkConditions:
    """What happens to packets on the way to one receiver.

    `loss` is the probability, 0..1, that a packet is dropped, drawn for each packet on its own.
    """

    loss: float = 0.0

    def __post_init__(self) -> None:
        loss = self.loss
        if isinstance(loss, bool) or not isinstance(loss, (int, float)):
            raise ConditionsError(f"loss: {loss!r} is not a number; allowed is a probability 0..1")
        if math.isnan(loss) or not 0.0 <= loss <= 1.0:
            hint = f" (for {loss:g} % write {loss / 100:g})" if 1.0 < loss <= 100.0 else ""
            raise ConditionsError(f"loss: {loss!r} is not a probability; allowed is 0..1{hint}")
        object.__setattr__(self, "loss", float(loss))

    def to_json(self) -> dict[str, Any]:
        return {"loss": self.loss}

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> LinkConditions:
        return cls(**_known(value, {"loss"}))


@dataclass(frozen=True)
class NetworkConditions:
    """The conditions between all vehicles at one time.

    `default` holds for every receiver that `receivers` (vehicle ID -> conditions) does not name.
    `partition` are disjoint groups of vehicle IDs; empty means that nothing is cut.
    """

    default: LinkConditions = field(default_factory=LinkConditions)
    receivers: Mapping[int, LinkConditions] = field(default_factory=dict)
    partition: tuple[frozenset[int], ...] = ()

    def __post_init__(self) -> None:
        for vehicle in self.receivers:
            _check_id("receivers", vehicle)
        # Copies: a value that its maker can still change is none.
        object.__setattr__(self, "receivers", dict(sorted(self.receivers.items())))
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
        """What happens to a packet from `sender` to `receiver` that no partition cuts."""
        return self.receivers.get(receiver, self.default)

    def is_cut(self, sender: int, receiver: int) -> bool:
        """Whether a partition stands between the two."""
        return self._group(sender) != self._group(receiver)

    @property
    def fully_connected(self) -> bool:
        """No loss anywhere and no partition."""
        links = (self.default, *self.receivers.values())
        return not self.partition and all(link.loss == 0.0 for link in links)

    def groups(self, vehicles: Iterable[int]) -> tuple[frozenset[int], ...]:
        """The groups that `vehicles` fall into, the rest last; one group when nothing is cut."""
        members: dict[int, set[int]] = {}
        for vehicle in vehicles:
            members.setdefault(self._group(vehicle), set()).add(vehicle)
        return tuple(frozenset(members[index]) for index in sorted(members))

    def with_partition(self, groups: Iterable[Iterable[int]]) -> NetworkConditions:
        """The same conditions under another partition."""
        return replace(self, partition=tuple(frozenset(group) for group in groups))

    def healed(self) -> NetworkConditions:
        """The same conditions without a partition."""
        return replace(self, partition=())

    def validate(self, vehicles: Iterable[int]) -> None:
        """Raise ConditionsError if a vehicle is named that is not one of `vehicles`."""
        known = set(vehicles)
        named = [("receivers", frozenset(self.receivers))]
        named += [(f"partition[{index}]", group) for index, group in enumerate(self.partition)]
        for key, group in named:
            if unknown := sorted(group - known):
                allowed = ", ".join(map(str, sorted(known)))
                raise ConditionsError(f"{key}: unknown {_name(unknown)}; allowed is any of {allowed}")

    def to_json(self) -> dict[str, Any]:
        return {
            "default": self.default.to_json(),
            "receivers": {str(vehicle): link.to_json() for vehicle, link in self.receivers.items()},
            "partition": [sorted(group) for group in self.partition],
        }

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> NetworkConditions:
        """The inverse of `to_json`."""
        _known(value, {"default", "receivers", "partition"})
        return cls(
            LinkConditions.from_json(value.get("default", {})),
            {int(key): LinkConditions.from_json(link) for key, link in value.get("receivers", {}).items()},
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


def _known(value: Mapping[str, Any], keys: set[str]) -> dict[str, Any]:
    for key in value:
        if key not in keys:
            raise ConditionsError(f"{key}: not a key of the conditions; allowed is {', '.join(sorted(keys))}")
    return dict(value)


def _name(vehicles: list[int]) -> str:
    return f"vehicle {vehicles[0]}" if len(vehicles) == 1 else f"vehicles {', '.join(map(str, vehicles))}"
