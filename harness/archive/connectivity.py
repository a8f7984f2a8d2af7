"""Find out which vehicles were connected at each time, from the network changes in `network.jsonl`.

A link joins two vehicles that receive each other directly. A pair that loses all messages has no link. Two kinds of
changes are recorded. If the scenario changes the network, the file contains the requested network conditions. If
vehicles move, the file contains the pairs whose radio loss changed, with the new losses. A pair has no link while the
conditions or the radio cause a loss of 1.
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
from harness.scenario.faults import fault_class
from netem.conditions import NetworkConditions
from netem.link import GilbertElliott, LinkConditions
from netem.radio import components

NETWORK_FILE = "network.jsonl"

Pair = tuple[int, int]
"""Two vehicle IDs, the lower one first."""
Link = tuple[int, int]
"""The vehicle IDs of a sender and a receiver."""
Components = tuple[frozenset[int], ...]


@dataclass(frozen=True, slots=True)
class Topology:
    """The groups of connected living vehicles from mission second `at_s` on. The largest group is the first element of
    `components`.

    `what` names the network change that led to these groups.
    """

    at_s: float
    what: str
    components: Components


@dataclass(frozen=True, slots=True)
class LossRates:
    """The mean and the highest loss rate (0 to 1) of the links between living vehicles, from mission second `at_s` on.

    Pairs with a loss of 1 have no link, so they are not counted.
    """

    at_s: float
    mean: float
    worst: float


QUALITY_LIMITS = (0.05, 0.25, 0.6, 1.0)
"""Loss rates that separate the five grades of link quality. In grade 0, the loss rate is below the first limit. In
grade 4, the loss rate is 1.
"""


SAME_LOSS = 0.05
"""Smallest change of a pair's loss rate that is stored."""


def quality(loss: float) -> int:
    """Return the quality of a link with this loss rate, from 0 (best) to 4 (no link)."""
    return bisect_right(QUALITY_LIMITS, loss)


def _differs(loss: float, before: float) -> bool:
    return abs(loss - before) >= SAME_LOSS or quality(loss) != quality(before)


@dataclass(frozen=True)
class Connectivity:
    """The connections and losses of the network over mission time. All lists are empty if the network was not recorded.

    Two consecutive states in a list are different.
    """

    vehicles: tuple[int, ...]
    states: list[Topology]
    losses: list[LossRates]
    """The losses over time, rounded to a tenth of a per cent. Consecutive entries differ."""
    reboots: list[tuple[float, int]]
    """Mission second and agent ID of each stop of an agent whose vehicle continued its flight."""
    problems: list[str]
    pair_losses: dict[Pair, list[tuple[float, float]]]
    """Pair of vehicles -> the mission seconds at which the loss rate of the pair changed, with the new loss rate. The
    loss rate is the mean of both directions. Changes below SAME_LOSS are omitted, unless the grade changes. A loss rate
    of 1.0 means that the pair has no link or that a vehicle is lost.
    """
    _cut: dict[Pair, list[float]]
    """Pair of vehicles -> the times at which the pair lost its link, got it back, lost it again, and so on."""
    _lost: dict[int, list[float]]
    """Vehicle -> the times at which the vehicle was lost, replaced, lost again, and so on."""

    def links(self, at_s: float) -> list[Pair]:
        """Return the links between living vehicles at mission second `at_s`."""
        living = [vehicle for vehicle in self.vehicles if not _is_on(self._lost.get(vehicle, ()), at_s)]
        return [pair for pair in combinations(living, 2) if not _is_on(self._cut.get(pair, ()), at_s)]

    def loss(self, pair: Pair, at_s: float) -> float:
        """Return the loss rate between two vehicles at mission second `at_s`, as defined for `pair_losses`."""
        losses = self.pair_losses.get(pair, [])
        at = bisect_right(losses, at_s, key=itemgetter(0))
        return losses[at - 1][1] if at else 1.0

    def airborne_intervals(self, vehicle: int, end_s: float) -> list[tuple[float, float, bool]]:
        """Return the intervals during which the vehicle was part of the swarm. An interval is (start, end, true if the
        vehicle was lost at the end).

        No interval ends after `end_s`.
        """
        times = [at_s for at_s in self._lost.get(vehicle, ()) if at_s <= end_s]
        ends = [0.0, *times, *([end_s] if len(times) % 2 == 0 else [])]
        return [(ends[at], ends[at + 1], at < len(times)) for at in range(0, len(ends) - 1, 2)]


class NetworkLine(BaseModel):
    """A line of `network.jsonl`: a change of the network, or a fault of agents."""

    model_config = ConfigDict(strict=True, defer_build=True)

    at_s: MissionSeconds
    what: Annotated[str, Field(max_length=200)]
    asked: dict[str, Any] | None = None
    losses: dict[str, float] = {}
    agents: list[int] = []


class NetworkReplay:
    """The state of the network after each recorded change. The caller must call `apply` with the lines in order."""

    def __init__(self, vehicles: Collection[int]) -> None:
        self.vehicles = tuple(sorted(vehicles))
        self.lost: set[int] = set()
        self._pairs = {f"{low}-{high}": (low, high) for low, high in combinations(self.vehicles, 2)}
        self._out_of_range: set[Pair] = set()
        self._cut_off: set[Pair] = set()
        self._scripted: dict[Pair, tuple[float, float]] = {}
        """Pair of vehicles -> the losses that the scenario requests for the two directions. The direction from the
        lower to the higher ID comes first. A message must survive both this loss and the loss by the radio model.
        """
        self._radio_losses: dict[Pair, float] = {}

    @property
    def cut(self) -> set[Pair]:
        return self._out_of_range | self._cut_off

    def apply(self, line: NetworkLine) -> None:
        """Apply a change of the network or a fault. Raises ValueError, TypeError, AttributeError or KeyError if the
        line is invalid.
        """
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
        if (fault := fault_class(line.what)).removes_vehicle:
            self.lost |= set(line.agents) & set(self.vehicles)
        elif fault.adds_vehicle:
            self.lost -= set(line.agents)

    def losses(self, at_s: float) -> LossRates:
        """Return the mean and the highest loss rate of the current links."""
        lost = [loss for pair in self._scripted if self._is_up(pair) for loss in self._directions(pair)]
        mean = sum(lost) / len(lost) if lost else 0.0
        return LossRates(at_s, round(mean, 3), round(max(lost, default=0.0), 3))

    def by_link(self) -> dict[Link, float]:
        """Return the current loss rate of each link in each direction. It is 1.0 if no message arrives."""
        losses: dict[Link, float] = {}
        for low, high in self._scripted:
            there, back = (1.0, 1.0) if self.lost & {low, high} else self._directions((low, high))
            losses |= {(low, high): there, (high, low): back}
        return losses

    def directions(self, pair: Pair) -> tuple[float, float]:
        """Return the current loss rates between two vehicles: from the lower ID to the higher ID, and back. Without a
        link, both loss rates are 1.0.
        """
        return self._directions(pair) if self._is_up(pair) else (1.0, 1.0)

    def by_pair(self) -> dict[Pair, float]:
        """Return the current loss rate of each pair of vehicles, as the mean of both directions. Without a link, the
        loss rate is 1.0.
        """
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
    """Return the long-term mean loss rate of a link, from 0 to 1."""
    return link.loss.mean if isinstance(link.loss, GilbertElliott) else link.loss


def read_connectivity(path: Path | None, vehicles: Collection[int]) -> Connectivity:
    """Read the connections between vehicles at each time. Invalid lines, and lines before the first conditions, are
    omitted.
    """
    lines = JsonLines(path, NetworkLine)
    network = NetworkReplay(vehicles)
    states: list[Topology] = []
    losses: list[LossRates] = []
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
        if (fault := fault_class(line.what)).ends_incarnation and not fault.removes_vehicle:
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
    """Yield the loss rates of links in the file at `path`, as `link_losses` does."""
    return link_losses(JsonLines(path, NetworkLine), vehicles)


def link_losses(lines: Iterable[NetworkLine], vehicles: Collection[int]) -> Iterator[tuple[float, dict[Link, float]]]:
    """Yield mission seconds with the loss rates (0 to 1) of links. The first entry contains all links, and each later
    entry the links whose loss rate changed.

    The loss is 1 for a link that is partitioned, out of radio range, or belongs to a lost vehicle. Invalid lines are
    omitted.
    """
    network = NetworkReplay(vehicles)
    before: dict[Link, float] = {}
    now_s = 0.0
    for line in lines:
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
    """Append a state of the network to the list `states` if it differs from the last state in the list. If the last
    state has the same mission second, replace the last state.
    """
    if states and states[-1].at_s == state.at_s:
        states.pop()
    if not states or states[-1].components != state.components:
        states.append(state)


Key = TypeVar("Key", Pair, int)


def _toggle(times: dict[Key, list[float]], keys: Iterable[Key], at_s: float) -> None:
    for key in keys:
        times.setdefault(key, []).append(at_s)


def _is_on(times: Sequence[float], at_s: float) -> bool:
    """Return true if a condition is on at mission second `at_s`. Before the first of `times`, the condition is off. It
    switches on at the first of `times`, off at the second, and so on.
    """
    return bisect_right(times, at_s) % 2 == 1
