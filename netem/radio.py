"""Define radio models. A radio model computes the loss rate between two places from their distance. The module also
adds these losses to network conditions. The caller provides the positions of the vehicles.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations, permutations
from typing import Protocol

from netem.conditions import NetworkConditions
from netem.errors import ConditionsError
from netem.link import GilbertElliott, LinkConditions

MIN_DISTANCE_M = 1.0
"""Reference distance of the path loss models, in metres. Shorter distances are treated like this distance."""

STEPS = 100
"""Number of steps into which the loss rates from 0 to 1 are divided: each loss rate is rounded to a whole multiple of
1/STEPS. Because of the rounding, small movements of hovering vehicles do not change the network conditions.
"""


@dataclass(frozen=True)
class Place:
    """The position of a vehicle in metres north, east and up from a common origin."""

    north_m: float
    east_m: float
    up_m: float

    def distance_m(self, other: Place) -> float:
        return math.dist((self.north_m, self.east_m, self.up_m), (other.north_m, other.east_m, other.up_m))

    def to_json(self) -> list[float]:
        """Return [north, east, up] in metres, rounded to decimetres."""
        return [round(self.north_m, 1), round(self.east_m, 1), round(self.up_m, 1)]


class Radio(Protocol):
    """A radio model. The loss rate between two vehicles depends only on their distance, and is the same in both
    directions.
    """

    def loss(self, distance_m: float) -> float:
        """Return the probability, from 0 to 1, that a message over this distance is lost."""


@dataclass(frozen=True)
class HardRange:
    """A radio that reaches every vehicle within `range_m` metres and none beyond. Most simulators use this model.

    The default is the outdoor range that tables give for IEEE 802.11n, the radio of the ARSENL swarm (Section 2.5 of
    the thesis).
    """

    range_m: float = 250.0

    def __post_init__(self) -> None:
        _positive("range_m", self.range_m)

    def loss(self, distance_m: float) -> float:
        return 0.0 if distance_m <= self.range_m else 1.0


@dataclass(frozen=True)
class LogDistance:
    """A radio with log-distance path loss and log-normal shadowing (Rappaport, Wireless Communications, 2nd ed., 4.9
    and 4.9.2).

    At d metres the mean received power is power_dbm - PL(1 m) - 10 exponent log10(d), where PL(1 m) is the free-space
    loss of Friis over the first metre. The shadowing is a normally distributed deviation from this mean, with standard
    deviation `shadowing_db`. A message is lost when the received power is below `sensitivity_dbm`, with probability
    Q(margin / shadowing_db). Each message is drawn independently.

    The defaults are: 100 mW, the limit for 2.4 GHz in Europe (ETSI EN 300 328); the sensitivity that IEEE 802.11-2020
    demands at 6 Mb/s, the lowest OFDM rate (Table 17-18); exponent 2.32 and 3 dB of shadowing. The last two are from
    the middle of the values measured with small UAVs, 2.0 to 2.6 and 2.6 to 5.3 dB (collected by Khawaja et al., A
    Survey of Air-to-Ground Propagation Channel Modeling for Unmanned Aerial Vehicles, IEEE Communications Surveys &
    Tutorials 21(3), 2019). With the defaults, 1 % of the messages are lost at 231 m, 50 % at 462 m, and 99 % at 924 m.
    """

    exponent: float = 2.32
    shadowing_db: float = 3.0
    power_dbm: float = 20.0
    sensitivity_dbm: float = -82.0
    frequency_hz: float = 2.437e9

    def __post_init__(self) -> None:
        for key in ("exponent", "frequency_hz"):
            _positive(key, getattr(self, key))
        for key in ("shadowing_db", "power_dbm", "sensitivity_dbm"):
            _finite(key, getattr(self, key))
        if self.shadowing_db < 0:
            raise ConditionsError(f"radio.shadowing_db: {self.shadowing_db!r} is below 0; allowed is 0 dB or more")

    def margin_db(self, distance_m: float) -> float:
        """Return the mean received power minus the sensitivity, in decibels, at this distance in metres."""
        first_metre_db = 20 * math.log10(4 * math.pi * MIN_DISTANCE_M * self.frequency_hz / 299_792_458.0)
        path_db = first_metre_db + 10 * self.exponent * math.log10(max(distance_m, MIN_DISTANCE_M))
        return self.power_dbm - path_db - self.sensitivity_dbm

    def loss(self, distance_m: float) -> float:
        margin_db = self.margin_db(distance_m)
        if self.shadowing_db == 0.0:
            return 0.0 if margin_db >= 0.0 else 1.0
        return 0.5 * math.erfc(margin_db / self.shadowing_db / math.sqrt(2))


def links(radio: Radio, places: Mapping[int, Place]) -> dict[frozenset[int], float]:
    """Return the rounded loss rate for each pair of vehicles. Pairs without loss are omitted."""
    losses: dict[frozenset[int], float] = {}
    for first, second in combinations(places, 2):
        if lost := round(radio.loss(places[first].distance_m(places[second])) * STEPS) / STEPS:
            losses[frozenset((first, second))] = lost
    return losses


def over_the_air(conditions: NetworkConditions, losses: Mapping[frozenset[int], float]) -> NetworkConditions:
    """Return a copy of the network conditions with the loss of the radio added to each link. The loss of the radio is
    independent of the other losses.
    """
    if not losses:
        return conditions
    pairs = dict(conditions.links)
    for pair, lost in losses.items():
        for sender, receiver in permutations(pair):
            pairs[sender, receiver] = _and_lost(conditions.link(sender, receiver), lost)
    return replace(conditions, links=pairs)


def components(conditions: NetworkConditions, vehicles: tuple[int, ...]) -> tuple[frozenset[int], ...]:
    """Return the groups of vehicles that can reach each other in both directions. The largest group is first.

    Two vehicles of a group may reach each other only through other vehicles. A link with a loss of 1 does not connect
    its vehicles.
    """
    left = list(vehicles)
    groups: list[frozenset[int]] = []
    while left:
        reached, ahead = {left[0]}, [left[0]]
        while ahead:
            vehicle = ahead.pop()
            nearby = {peer for peer in left if peer not in reached and _both_ways(conditions, vehicle, peer)}
            reached |= nearby
            ahead += nearby
        groups.append(frozenset(reached))
        left = [vehicle for vehicle in left if vehicle not in reached]
    return tuple(sorted(groups, key=lambda group: (-len(group), min(group))))


def _both_ways(conditions: NetworkConditions, first: int, second: int) -> bool:
    if conditions.is_cut(first, second):
        return False
    return not (_is_dead(conditions.link(first, second)) or _is_dead(conditions.link(second, first)))


def _is_dead(link: LinkConditions) -> bool:
    loss = link.loss
    if isinstance(loss, GilbertElliott):
        return loss.loss_bad == 1.0 and loss.loss_good == 1.0
    return loss == 1.0


def _and_lost(link: LinkConditions, lost: float) -> LinkConditions:
    def both(loss: float) -> float:
        return 1 - (1 - loss) * (1 - lost)

    if isinstance(link.loss, GilbertElliott):
        bursts = replace(link.loss, loss_bad=both(link.loss.loss_bad), loss_good=both(link.loss.loss_good))
        return replace(link, loss=bursts)
    return replace(link, loss=both(link.loss))


def _positive(key: str, value: float) -> None:
    _finite(key, value)
    if value <= 0:
        raise ConditionsError(f"radio.{key}: {value!r} is not above 0; allowed is a positive number")


def _finite(key: str, value: object) -> None:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ConditionsError(f"radio.{key}: {value!r} is not a finite number")
