"""Who could reach whom at which second of a run: `network.jsonl` read back.

A link is between two vehicles that hear each other, both ways, directly; one that loses everything is none. A change
that the scenario made is on record as the conditions that it asked for; one that flight made, as the pairs whose loss
over the radio changed. A pair is cut while either loses everything.
"""

from bisect import bisect_right
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from operator import itemgetter
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field

from harness.archive.bounded_file import JsonLines
from harness.archive.tracks import MissionSeconds
from harness.scenario.faults import named
from netem.conditions import NetworkConditions
from netem.link import GilbertElliott, LinkConditions
from netem.radio import components

NETWORK_FILE = "network.jsonl"

Pair = tuple[int, int]
"""Two vehicles, the lower ID first."""
Link = tuple[int, int]
"""From a sender to a receiver."""
Components = tuple[frozenset[int], ...]


@dataclass(frozen=True, slots=True)
class Topology:
    """From `at_s` on the living vehicles fell into these components, the largest first; `what` changed them."""

    at_s: float
    what: str
    components: Components


@dataclass(frozen=True, slots=True)
class Losses:
    """From `at_s` on links between living vehicles lost this share of messages, on average and at worst, 0..1.

    Links that lose everything are none.
    """

    at_s: float
    mean: float
    worst: float


QUALITY_LIMITS = (0.05, 0.25, 0.6, 1.0)
"""A link that loses less than the first of these is of quality 0; who loses everything, of quality 4, has none."""


SAME_LOSS = 0.05
"""Losses of a pair that differ by less are one."""


def quality(loss: float) -> int:
    """Of a link that loses this share of messages."""
    return bisect_right(QUALITY_LIMITS, loss)


def _differs(loss: float, before: float) -> bool:
    return abs(loss - before) >= SAME_LOSS or quality(loss) != quality(before)


@dataclass(frozen=True)
class Connectivity:
    """The states of the network, no two in a row alike; none if there is no record of it."""

    vehicles: tuple[int, ...]
    states: list[Topology]
    losses: list[Losses]
    """Likewise, to a tenth of a per cent."""
    reboots: list[tuple[float, int]]
    """When an agent went down, while its vehicle flew on."""
    problems: list[str]
    pair_losses: dict[Pair, list[tuple[float, float]]]
    """From when on each pair of vehicles loses which share of messages, both ways together, to a twentieth. 1.0 is no
    link, or a vehicle that is lost."""
    _cut: dict[Pair, list[float]]
    """When each pair was cut, joined, cut again, and so on."""
    _lost: dict[int, list[float]]
    """When each vehicle was lost, back, lost again, and so on."""

    def links(self, at_s: float) -> list[Pair]:
        """The links between living vehicles."""
        living = [vehicle for vehicle in self.vehicles if not _is_on(self._lost.get(vehicle, ()), at_s)]
        return [pair for pair in combinations(living, 2) if not _is_on(self._cut.get(pair, ()), at_s)]

    def loss(self, pair: Pair, at_s: float) -> float:
        """What a pair loses then, to a twentieth."""
        losses = self.pair_losses.get(pair, [])
        at = bisect_right(losses, at_s, key=itemgetter(0))
        return losses[at - 1][1] if at else 1.0

    def airborne_intervals(self, vehicle: int, end_s: float) -> list[tuple[float, float, bool]]:
        """From when to when the vehicle was in the air, and whether it was then lost; nothing goes beyond `end_s`."""
        times = [at_s for at_s in self._lost.get(vehicle, ()) if at_s <= end_s]
        ends = [0.0, *times, *([end_s] if len(times) % 2 == 0 else [])]
        return [(ends[at], ends[at + 1], at < len(times)) for at in range(0, len(ends) - 1, 2)]


class NetworkLine(BaseModel):
    """A line of `network.jsonl`: a change of the network, or a fault of agents."""

    model_config = ConfigDict(strict=True)

    at_s: MissionSeconds
    what: Annotated[str, Field(max_length=200)]
    asked: dict[str, Any] | None = None
    losses: dict[str, float] = {}
    agents: list[int] = []


class NetworkReplay:
    """The network while its record is read, line by line."""

    def __init__(self, vehicles: Collection[int]) -> None:
        self.vehicles = tuple(sorted(vehicles))
        self.lost: set[int] = set()
        self._pairs = {f"{low}-{high}": (low, high) for low, high in combinations(self.vehicles, 2)}
        self._out_of_range: set[Pair] = set()
        self._cut_off: set[Pair] = set()
        self._scripted: dict[Pair, tuple[float, float]] = {}
        """What each pair loses in either direction, over which the radio loses more."""
        self._radio_losses: dict[Pair, float] = {}

    @property
    def cut(self) -> set[Pair]:
        return self._out_of_range | self._cut_off

    def apply(self, line: NetworkLine) -> None:
        """Raises ValueError, TypeError, AttributeError or KeyError if the line means nothing."""
        losses = {self._pairs[name]: loss for name, loss in line.losses.items()}
        if line.asked is not None:
            conditions = NetworkConditions.from_json(line.asked)
            self._cut_off = {pair for pair in self._pairs.values() if len(components(conditions, pair)) > 1}
            self._scripted = {
                (low, high): (_asked_loss(conditions, low, high), _asked_loss(conditions, high, low))
                for low, high in self._pairs.values()
            }
        self._radio_losses |= losses
        self._out_of_range -= losses.keys()
        self._out_of_range |= {pair for pair, loss in losses.items() if loss == 1.0}
        if (fault := named(line.what)).takes_the_vehicle:
            self.lost |= set(line.agents) & set(self.vehicles)
        elif fault.brings_a_vehicle:
            self.lost -= set(line.agents)

    def losses(self, at_s: float) -> Losses:
        """What the links lose now."""
        lost = [loss for pair in self._scripted if self._is_up(pair) for loss in self._directions(pair)]
        mean = sum(lost) / len(lost) if lost else 0.0
        return Losses(at_s, round(mean, 3), round(max(lost, default=0.0), 3))

    def by_link(self) -> dict[Link, float]:
        """What each link loses now, in either direction: everything where there is none."""
        losses: dict[Link, float] = {}
        for low, high in self._scripted:
            there, back = (1.0, 1.0) if self.lost & {low, high} else self._directions((low, high))
            losses |= {(low, high): there, (high, low): back}
        return losses

    def directions(self, pair: Pair) -> tuple[float, float]:
        """What the pair loses now, there and back: everything where there is no link."""
        return self._directions(pair) if self._is_up(pair) else (1.0, 1.0)

    def by_pair(self) -> dict[Pair, float]:
        """What each pair loses now, both ways together."""
        return {pair: sum(self._directions(pair)) / 2 if self._is_up(pair) else 1.0 for pair in self._scripted}

    def _is_up(self, pair: Pair) -> bool:
        return pair not in self._out_of_range and pair not in self._cut_off and not self.lost & {*pair}

    def _directions(self, pair: Pair) -> tuple[float, float]:
        radio_loss = self._radio_losses.get(pair, 0.0)
        there, back = self._scripted[pair]
        return 1 - (1 - there) * (1 - radio_loss), 1 - (1 - back) * (1 - radio_loss)

    def components(self) -> Components:
        remaining = set(self.vehicles) - self.lost
        reaches = {vehicle: remaining - {vehicle} for vehicle in remaining}
        for low, high in self.cut:
            if low in remaining and high in remaining:
                reaches[low].discard(high)
                reaches[high].discard(low)
        groups = []
        while remaining:
            reached: set[int] = set()
            frontier = {min(remaining)}
            while frontier:
                reached |= frontier
                frontier = set().union(*(reaches[vehicle] for vehicle in frontier)) - reached
            groups.append(frozenset(reached))
            remaining -= reached
        return tuple(sorted(groups, key=lambda group: (-len(group), min(group))))


def _asked_loss(conditions: NetworkConditions, sender: int, receiver: int) -> float:
    return 1.0 if conditions.is_cut(sender, receiver) else _loss(conditions.link(sender, receiver))


def _loss(link: LinkConditions) -> float:
    """The share of messages that it loses in the long run."""
    return link.loss.mean if isinstance(link.loss, GilbertElliott) else link.loss


def read_connectivity(path: Path | None, vehicles: Collection[int]) -> Connectivity:
    """The network among `vehicles`. A line that means nothing, or comes before the first conditions, is left out."""
    lines = JsonLines(path, NetworkLine)
    network = NetworkReplay(vehicles)
    states: list[Topology] = []
    losses: list[Losses] = []
    reboots: list[tuple[float, int]] = []
    cut: dict[Pair, list[float]] = {}
    lost: dict[int, list[float]] = {}
    pair_losses: dict[Pair, list[tuple[float, float]]] = {}
    now_s = 0.0
    for line in lines:
        cut_before, lost_before = network.cut, set(network.lost)
        try:
            if not states and line.asked is None:
                raise ValueError("the record begins with conditions")
            network.apply(line)
        except (ValueError, TypeError, AttributeError, KeyError):
            lines.leave_out()
            continue
        now_s = max(now_s, line.at_s)
        toggled_pairs, toggled_vehicles = cut_before ^ network.cut, lost_before ^ network.lost
        _toggle(cut, toggled_pairs, now_s)
        _toggle(lost, toggled_vehicles, now_s)
        if (fault := named(line.what)).ends_a_life and not fault.takes_the_vehicle:
            reboots += [(now_s, vehicle) for vehicle in line.agents if vehicle in network.vehicles]
        lost_now = network.losses(now_s)
        if not losses or (lost_now.mean, lost_now.worst) != (losses[-1].mean, losses[-1].worst):
            losses.append(lost_now)
        for pair, loss in network.by_pair().items():
            history = pair_losses.setdefault(pair, [])
            if not history or _differs(loss, history[-1][1]):
                history.append((now_s, round(loss, 3)))
        if toggled_pairs or toggled_vehicles or not states:
            _append_state(states, Topology(now_s, line.what, network.components()))
    return Connectivity(network.vehicles, states, losses, reboots, lines.problems(), pair_losses, cut, lost)


def read_link_losses(path: Path | None, vehicles: Collection[int]) -> Iterator[tuple[float, dict[Link, float]]]:
    """From when on which links lose how much, 0..1: first all, then those that changed; what means nothing is left out.

    A link that is cut, out of range, or of a vehicle that is lost, loses everything.
    """
    network = NetworkReplay(vehicles)
    before: dict[Link, float] = {}
    now_s = 0.0
    for line in JsonLines(path, NetworkLine):
        if not before and line.asked is None:
            continue
        try:
            network.apply(line)
        except (ValueError, TypeError, AttributeError, KeyError):
            continue
        now_s = max(now_s, line.at_s)
        losses = network.by_link()
        if changed := dict(losses.items() - before.items()):
            yield now_s, {link: losses[link] for link in losses if link in changed}
        before = losses


def _append_state(states: list[Topology], state: Topology) -> None:
    """Add the state if it is another than the last; one that lasted no time was none."""
    if states and states[-1].at_s == state.at_s:
        states.pop()
    if not states or states[-1].components != state.components:
        states.append(state)


Key = TypeVar("Key", Pair, int)


def _toggle(times: dict[Key, list[float]], keys: Iterable[Key], at_s: float) -> None:
    for key in keys:
        times.setdefault(key, []).append(at_s)


def _is_on(times: Sequence[float], at_s: float) -> bool:
    """Whether what is switched at these times is on."""
    return bisect_right(times, at_s) % 2 == 1
