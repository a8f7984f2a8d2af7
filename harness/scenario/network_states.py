"""Compute the states of the network during a mission from the scenario, its timeline, and its schedules.

A change of the timeline lasts until a later change of the same value, or ends after `for_s`. Two temporary changes of
the same value must not overlap, unless one lies inside the other. The inner change then applies, and after its end the
outer change applies again. Other overlaps are ambiguous and are rejected. A lasting change must not start during a
temporary change of the same value. A *value* is a condition of all links, of one receiver or of one link, or the
partition.
"""

import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import product

from harness.scenario._network import NetworkModel, NetworkValues, Scope, conditions_of, overlay, scope_in_words
from harness.scenario.timeline import EMPTY_LAYER, Schedule, TemporaryChange, TimelineEntry
from netem.conditions import NetworkConditions

Groups = tuple[frozenset[int], ...]
PARTITION = "partition"


@dataclass
class NetworkState:
    """The conditions and partitions of the network at one moment of the mission."""

    roster: tuple[int, ...]
    lasting: NetworkValues
    """Lasting conditions: those of the scenario, changed by the timeline so far."""
    layers: list[TemporaryChange]
    """The change that each schedule makes at this moment."""
    partition: Groups = ()
    temporary: list[TimelineEntry] = field(default_factory=list)
    """Active temporary changes of the timeline, in the order of their start."""

    def without_partition(self) -> NetworkConditions:
        """Return the network conditions without partitions and cut links. Raises ConditionsError."""
        network = self.lasting
        for entry in self.temporary:
            network = overlay(network, entry.changes())
        for layer in self.layers:
            if layer.values:
                network = overlay(network, layer.values)
        return conditions_of(network)

    def conditions(self) -> NetworkConditions:
        """Return the network conditions. Raises ConditionsError if they contradict each other."""
        conditions = self.without_partition().with_partition(self._undivided_groups())
        cut = sorted(pair for layer in self.layers for pair in layer.cut)
        severed = {pair: replace(conditions.link(*pair), loss=1.0) for pair in cut}
        return replace(conditions, links={**conditions.links, **severed})

    def _undivided_groups(self) -> Groups:
        """Return the groups of vehicles that remain connected when all active partitions are combined."""
        temporary = [entry.groups for entry in self.temporary if entry.network_key == PARTITION]
        standing = temporary[-1] if temporary else self.partition
        partitions = [partition for partition in (standing, *(layer.partition for layer in self.layers)) if partition]
        if len(partitions) < 2:
            return partitions[0] if partitions else ()
        sides = [NetworkConditions(partition=partition).groups(self.roster) for partition in partitions]
        together = (frozenset.intersection(*each) for each in product(*sides))
        return tuple(group for group in together if group)

    def play(self, entry: TimelineEntry) -> None:
        """Apply an entry of the timeline to this state."""
        if entry.for_s is not None:
            self.temporary.append(entry)
        elif entry.network_key in (PARTITION, "heal"):
            self.partition = entry.groups
        else:
            self.lasting = overlay(self.lasting, entry.changes())


@dataclass(frozen=True)
class NetworkStep:
    """A change of the network at one moment. `what` is its name, and `keys` are the scenario keys that cause it."""

    at_s: float
    what: str
    keys: list[str]
    network: NetworkState
    """The state of the network after the change. This object is valid only until the next step, which changes the same
    object.
    """


def network_steps(
    model: NetworkModel,
    roster: tuple[int, ...],
    timeline: Sequence[TimelineEntry],
    schedules: Sequence[Schedule],
    end_s: float,
) -> Iterator[NetworkStep]:
    """Yield every change of the network in order of time, beginning at 0 s. Changes at the same time are combined."""
    network = NetworkState(roster, model.by_scope(), [EMPTY_LAYER for _ in schedules])
    begins: dict[float, list[int]] = defaultdict(list)
    ends: dict[float, list[int]] = defaultdict(list)
    for number, entry in enumerate(timeline):
        if entry.network_key:
            begins[entry.at_s].append(number)
            if entry.for_s is not None:
                ends[entry.ends_at_s].append(number)
    scheduled: dict[float, list[tuple[int, str, TemporaryChange]]] = defaultdict(list)
    for number, schedule in enumerate(schedules):
        for at_s, what, layer in schedule.steps(roster, end_s):
            scheduled[at_s].append((number, what, layer))
    for at_s in sorted({0.0, *begins, *ends, *scheduled}):
        words, keys = [], []
        over = [timeline[number] for number in ends.get(at_s, ())]
        network.temporary = [entry for entry in network.temporary if entry not in over]
        for number in begins.get(at_s, ()):
            network.play(timeline[number])
            words.append(timeline[number].network_key or "")
            keys.append(f"timeline.{number}.{timeline[number].network_key}")
        if over:
            words.append("undone")
            keys += [f"the end of timeline.{number}" for number in ends[at_s]]
        for number, what, layer in scheduled.get(at_s, ()):
            network.layers[number] = layer
            words.append(what)
            keys.append(f"schedule.{number}")
        yield NetworkStep(at_s, ", ".join(dict.fromkeys(words)) or "start", keys, network)


def refuse_ambiguous_overlaps(timeline: Sequence[TimelineEntry]) -> None:
    """Raise ValueError if a change starts during an earlier temporary change of the same value, but ends after the
    earlier change. The result would be ambiguous.
    """
    active: dict[tuple[Scope, str], list[tuple[float, int]]] = defaultdict(list)
    for number, entry in sorted(enumerate(timeline), key=lambda numbered: numbered[1].at_s):
        until_s = math.inf if entry.for_s is None else entry.ends_at_s
        for scope, key in changed_values(entry):
            earlier = active[scope, key]
            while earlier and earlier[-1][0] <= entry.at_s:
                earlier.pop()
            if earlier and until_s > earlier[-1][0]:
                other_until_s, other_number = earlier[-1]
                lasts = "for good" if entry.for_s is None else f"until {until_s:g} s"
                raise ValueError(
                    f"timeline.{number} changes {key}{scope_in_words(scope)} {lasts}, but timeline.{other_number} "
                    f"changes it until {other_until_s:g} s: let timeline.{number} begin at that time, or end before it"
                )
            earlier.append((until_s, number))


def changed_values(entry: TimelineEntry) -> Iterator[tuple[Scope, str]]:
    """Yield the network values that the timeline entry changes, each as its scope and its key."""
    if entry.network_key in (PARTITION, "heal"):
        yield None, "the partition"
    elif entry.network_key:
        yield from ((scope, key) for scope, keys in entry.changes().items() for key in keys)
