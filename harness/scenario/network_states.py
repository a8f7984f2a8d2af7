"""The states of the network during a mission, from the scenario, its timeline, and its schedules.

A change of the timeline lasts until a later change of the same value, or ends after `for_s`. Two temporary changes of
the same value must not overlap, unless one lies within the other. The inner one then applies, and after its end the
outer one again. Other overlaps are ambiguous and are rejected. A lasting change must not start during a temporary
change of the same value. A value is a key of all links, of a receiver or of a link, or the partition.
"""

import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import product

from harness.scenario._network import NetworkModel, NetworkValues, Where, conditions_of, laid_over, of_whom
from harness.scenario.timeline import UNTOUCHED, Layer, Schedule, TimelineEntry
from netem.conditions import NetworkConditions

Groups = tuple[frozenset[int], ...]
PARTITION = "partition"


@dataclass
class Network:
    """The network at one instant."""

    roster: tuple[int, ...]
    lasting: NetworkValues
    """Lasting conditions, of the scenario and of its timeline so far."""
    layers: list[Layer]
    """The current layer of each schedule."""
    partition: Groups = ()
    passing: list[TimelineEntry] = field(default_factory=list)
    """Active temporary changes of the timeline, in the order of their start."""

    def uncut(self) -> NetworkConditions:
        """Return the conditions without partitions and cuts. Raises ConditionsError."""
        network = self.lasting
        for entry in self.passing:
            network = laid_over(network, entry.changes())
        for layer in self.layers:
            if layer.values:
                network = laid_over(network, layer.values)
        return conditions_of(network)

    def conditions(self) -> NetworkConditions:
        """Return the conditions. Raises ConditionsError if they contradict each other."""
        conditions = self.uncut().with_partition(self._cut_by_any())
        cut = sorted(pair for layer in self.layers for pair in layer.cut)
        severed = {pair: replace(conditions.link(*pair), loss=1.0) for pair in cut}
        return replace(conditions, links={**conditions.links, **severed})

    def _cut_by_any(self) -> Groups:
        """Return the groups of vehicles that no partition separates."""
        passing = [entry.groups for entry in self.passing if entry.disturbs == PARTITION]
        standing = passing[-1] if passing else self.partition
        partitions = [partition for partition in (standing, *(layer.partition for layer in self.layers)) if partition]
        if len(partitions) < 2:
            return partitions[0] if partitions else ()
        sides = [NetworkConditions(partition=partition).groups(self.roster) for partition in partitions]
        together = (frozenset.intersection(*each) for each in product(*sides))
        return tuple(group for group in together if group)

    def play(self, entry: TimelineEntry) -> None:
        """Apply an entry of the timeline."""
        if entry.for_s is not None:
            self.passing.append(entry)
        elif entry.disturbs in (PARTITION, "heal"):
            self.partition = entry.groups
        else:
            self.lasting = laid_over(self.lasting, entry.changes())


@dataclass(frozen=True)
class Step:
    """A change of the network at one instant. `what` is its name, and `keys` are its places in the scenario."""

    at_s: float
    what: str
    keys: list[str]
    network: Network
    """The network after the change. The next step changes this object."""


def steps(
    model: NetworkModel,
    roster: tuple[int, ...],
    timeline: Sequence[TimelineEntry],
    schedules: Sequence[Schedule],
    end_s: float,
) -> Iterator[Step]:
    """Yield every change of the network in time order, the first at 0 s. Changes at the same instant form one step."""
    network = Network(roster, model.whole(), [UNTOUCHED for _ in schedules])
    begins: dict[float, list[int]] = defaultdict(list)
    ends: dict[float, list[int]] = defaultdict(list)
    for number, entry in enumerate(timeline):
        if entry.disturbs:
            begins[entry.at_s].append(number)
            if entry.for_s is not None:
                ends[entry.ends_at_s].append(number)
    scheduled: dict[float, list[tuple[int, str, Layer]]] = defaultdict(list)
    for number, schedule in enumerate(schedules):
        for at_s, what, layer in schedule.steps(roster, end_s):
            scheduled[at_s].append((number, what, layer))
    for at_s in sorted({0.0, *begins, *ends, *scheduled}):
        words, keys = [], []
        over = [timeline[number] for number in ends.get(at_s, ())]
        network.passing = [entry for entry in network.passing if entry not in over]
        for number in begins.get(at_s, ()):
            network.play(timeline[number])
            words.append(timeline[number].disturbs or "")
            keys.append(f"timeline.{number}.{timeline[number].disturbs}")
        if over:
            words.append("undone")
            keys += [f"the end of timeline.{number}" for number in ends[at_s]]
        for number, what, layer in scheduled.get(at_s, ()):
            network.layers[number] = layer
            words.append(what)
            keys.append(f"schedule.{number}")
        yield Step(at_s, ", ".join(dict.fromkeys(words)) or "start", keys, network)


def refuse_ambiguity(timeline: Sequence[TimelineEntry]) -> None:
    """Raise ValueError if two changes of the same value overlap ambiguously."""
    under_way: dict[tuple[Where, str], list[tuple[float, int]]] = defaultdict(list)
    for number, entry in sorted(enumerate(timeline), key=lambda numbered: numbered[1].at_s):
        until_s = math.inf if entry.for_s is None else entry.ends_at_s
        for where, key in changed(entry):
            earlier = under_way[where, key]
            while earlier and earlier[-1][0] <= entry.at_s:
                earlier.pop()
            if earlier and until_s > earlier[-1][0]:
                other_until_s, other_number = earlier[-1]
                lasts = "for good" if entry.for_s is None else f"until {until_s:g} s"
                raise ValueError(
                    f"timeline.{number} changes {key}{of_whom(where)} {lasts}, but timeline.{other_number} changes it "
                    f"until {other_until_s:g} s: let timeline.{number} begin at that time, or end before it"
                )
            earlier.append((until_s, number))


def changed(entry: TimelineEntry) -> Iterator[tuple[Where, str]]:
    """Yield the scope and the key of each value that the entry changes. The partition is a key of all links."""
    if entry.disturbs in (PARTITION, "heal"):
        yield None, "the partition"
    elif entry.disturbs:
        yield from ((where, key) for where, keys in entry.changes().items() for key in keys)
