"""Engine "netem": Linux netem at the switch ports, over netlink, where the kernel has sch_netem.

A packet is marked where it enters the switch, by its sender's port, with two numbers: the group of a partition that
its sender is in, and the sender's *kind*: senders of one kind are treated alike by every receiver. On the port that
leads to a receiver it passes two stages: what comes from another group is dropped, and then an HTB picks the class of
its kind, which holds one netem:

    v7 ingress  basic   skbedit priority 1:2 mark 1       vehicle 7 is of kind 2 and in group 1
    v7 egress   fw 1    pass                              vehicle 7 hears group 1
                basic   drop                              and nobody else
    v7 root     htb 1:
                  class 1:1     netem loss 15 %           what 7 hears of kind 1
                  class 1:3     netem delay 100 ms        what 7 hears of kind 3

A switch sees a packet once per receiver, so each receiver draws its own lot. Where a link remembers (bursts, rate,
limit) every sender is a kind of its own, for its packets alone count.

A change of figures changes the netem in place: its queue stays, and others are not touched. A change of kinds first
adds the new classes, then moves the senders over one by one; the old classes go when the last packet has left them. A
partition touches no class at all: receivers first hear the new groups too, then the senders move over one by one, then
the old groups are heard no more. So each pair is at all times treated as before or as after, and time grows with the
number of vehicles, not of pairs.

Since 2025 (6.1.148, 6.6.102, 6.12.42, 6.16.1) Linux has a netem that duplicates stand alone at its port: duplication
is then refused where a receiver does not hear all senders alike, and where links remember. Newer kernels also hold a
jitter of 2.1 s at most. `may_refuse` says whose network is worth a rehearsal.
See tc-netem(8), tc-htb(8), tc-skbedit(8), tc-fw(8).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from errno import ENOENT

from netem._fabric import Fabric
from netem._netlink import Netlink, Request
from netem._tc_requests import MAX_KIND, Class, TrafficControl
from netem.conditions import NetworkConditions
from netem.engine import Applied, Engine, ReceiverFigures
from netem.errors import EngineError, NetlinkError
from netem.link import Distribution, LinkConditions

_Numbers = dict[frozenset[int], int]

_SURE_JITTER_S = (2**31 - 1) / 1e9
"""What all kernels with netem can hold."""


def may_refuse(conditions: NetworkConditions) -> bool:
    """Whether these conditions are more than every kernel with netem can do (see the module)."""
    links = (conditions.default, *conditions.receivers.values(), *conditions.links.values())
    return any(link.duplicate or (link.delay and link.delay.jitter_s > _SURE_JITTER_S) for link in links)


@dataclass
class _Totals:
    """Packets counted by classes that are gone."""

    passed: int = 0
    lost: int = 0


@dataclass
class _Holds:
    """What a class was last told; None if nobody knows, for the kernel refused. `distribution`: whose table it has."""

    link: LinkConditions | None
    distribution: Distribution = "uniform"


class NetemEngine(Engine):
    """Everything that netem can do, per sender and receiver."""

    name = "netem"
    has_queues = True

    def __init__(self, fabric: Fabric) -> None:
        super().__init__(fabric)
        self._netlink: Netlink = fabric.netlink
        self._ports = {vehicle: TrafficControl(fabric.port_index(vehicle)) for vehicle in self._vehicles}
        self._gone = {vehicle: _Totals() for vehicle in self._vehicles}
        self._kinds: _Numbers = {}
        self._groups: _Numbers = {}
        self._figured: NetworkConditions | None = None  # what the classes stand for; None if nobody knows
        # As the kernel has them: the kind and group of each sender, and the groups that each receiver hears.
        self._marks: dict[int, tuple[int, int] | None] = dict.fromkeys(self._vehicles)
        self._hears: dict[int, set[int]] = {vehicle: set() for vehicle in self._vehicles}
        self._classes: dict[int, dict[int, _Holds]] = {vehicle: {} for vehicle in self._vehicles}
        first = self._ports[self._vehicles[0]]
        try:
            # One port first: a kernel that cannot is left as it was.
            try:
                self._netlink.send([*first.install(), *first.add_class(1, LinkConditions())])
                self._netlink.send([*first.guard(), first.hear(1), first.mark(1, group=1)])
            finally:
                self._remove(first)
            for port in self._ports.values():
                self._netlink.send([*port.install(), *port.guard()])
        except NetlinkError as error:
            raise EngineError(f"this kernel cannot {error}") from error
        self.change(NetworkConditions())

    def _remove(self, port: TrafficControl) -> None:
        for request in port.uninstall():
            try:
                self._netlink.send([request])
            except NetlinkError:
                continue  # it never came to be

    def change(self, conditions: NetworkConditions) -> None:
        try:
            self._change(conditions)
        except NetlinkError as error:
            self._marks, heard = self._filters()
            self._hears = {vehicle: groups for vehicle, (groups, _) in heard.items()}
            raise EngineError(f"The kernel refused a change: {error}") from error

    def _change(self, conditions: NetworkConditions) -> None:
        groups = _number(conditions.groups(self._vehicles), self._groups, self._groups.values())
        figures = conditions.healed()
        if figures == self._figured:
            self._move(self._kinds, groups)  # at once: this is a partition, and nothing else
            return
        self._figured = None
        classes = {kind for held in self._classes.values() for kind in held}
        kinds = _number(_kinds(conditions, self._vehicles), self._kinds, classes)
        wanted = {vehicle: _classes(conditions, kinds, vehicle) for vehicle in self._vehicles}
        alone = []
        for receiver, links in wanted.items():
            held = self._classes[receiver]
            leaving = {kind: holds.link for kind, holds in held.items() if kind not in links and holds.link is not None}
            first = links
            if leaving and any(link.duplicate for link in (*leaving.values(), *links.values())):
                # New classes meet old ones, and a netem that duplicates would have to be alone (see the module):
                # for the moment nobody duplicates, and the old ones do not wait for their last packet.
                alone.append(receiver)
                first = {kind: replace(link, duplicate=0.0) for kind, link in (leaving | links).items()}
            self._set(receiver, first)
        self._move(kinds, groups)
        self._retire(lambda receiver, counted: not counted.waiting or receiver in alone)
        for receiver in alone:
            self._set(receiver, wanted[receiver])
        self._figured = figures

    def _set(self, receiver: int, links: dict[int, LinkConditions]) -> None:
        """Have the receiver's port treat each kind like this; asks the kernel only for what differs."""
        port, held = self._ports[receiver], self._classes[receiver]
        requests: list[Request] = []
        changed: dict[int, _Holds] = {}
        for kind, link in links.items():
            before = held.get(kind)
            if before is not None and before.link == link:
                continue
            shape = link.delay.distribution if link.delay and link.delay.jitter_s else None
            known = before is not None and before.link is not None
            table = shape is not None and not (before and known and before.distribution == shape)
            request = port.change_class(kind, link, table=table)
            requests += [request] if known else port.add_class(kind, link)
            changed[kind] = _Holds(link, shape or (before.distribution if before else "uniform"))
        held.update({kind: replace(holds, link=None) for kind, holds in changed.items()})
        self._netlink.send(requests)
        held.update(changed)

    def _move(self, kinds: _Numbers, groups: _Numbers) -> None:
        """Bring all senders from their old kinds and groups to the new ones."""
        kind, group = _numbers(kinds), _numbers(groups)
        new = {vehicle: (kind[vehicle], group[vehicle]) for vehicle in self._vehicles}
        hears = [vehicle for vehicle in self._vehicles if group[vehicle] not in self._hears[vehicle]]
        self._netlink.send([self._ports[vehicle].hear(group[vehicle]) for vehicle in hears])
        moved = [vehicle for vehicle in self._vehicles if self._marks[vehicle] != new[vehicle]]
        self._netlink.send([self._ports[vehicle].mark(*new[vehicle]) for vehicle in moved])
        old = [(v, former) for v, heard in self._hears.items() for former in heard if former != group[v]]
        self._netlink.send([self._ports[vehicle].hear_no_more(former) for vehicle, former in old])
        self._kinds, self._groups, self._marks = kinds, groups, {**new}
        self._hears = {vehicle: {group[vehicle]} for vehicle in self._vehicles}

    def _retire(self, gone: Callable[[int, Class], bool]) -> None:
        """Remove classes that nobody uses any more if they are `gone`, and remember what they counted."""
        used = set(self._kinds.values())
        unused = {v: unused for v, held in self._classes.items() if (unused := [k for k in held if k not in used])}
        if not unused:
            return
        classes = self._found()
        for receiver, kinds in unused.items():
            for kind in kinds:
                counted = classes[receiver].get(kind)
                if counted is not None and not gone(receiver, counted):
                    continue
                try:
                    self._netlink.send([self._ports[receiver].remove_class(kind)])
                except NetlinkError as error:
                    if error.errno != ENOENT:  # of a change that was refused, not everything came to be
                        raise
                del self._classes[receiver][kind]
                if counted is not None:
                    self._gone[receiver].passed += counted.passed
                    self._gone[receiver].lost += counted.dropped

    def _found(self) -> dict[int, dict[int, Class]]:
        """What classes each receiver's port has."""
        classes = TrafficControl.classes(self._netlink)
        return {vehicle: classes.get(port.index, {}) for vehicle, port in self._ports.items()}

    def _filters(self) -> tuple[dict[int, tuple[int, int] | None], dict[int, tuple[set[int], int]]]:
        """What each port marks and hears."""
        marks = {vehicle: port.marked(self._netlink) for vehicle, port in self._ports.items()}
        return marks, {vehicle: port.heard(self._netlink) for vehicle, port in self._ports.items()}

    def read(self) -> Applied:
        try:
            self._retire(lambda _, counted: not counted.waiting)
            classes = self._found()
            marks, heard = self._filters()
        except NetlinkError as error:
            raise EngineError(f"The kernel did not report its state: {error}") from error
        return Applied(self.name, {v: self._figures(v, classes[v], marks, *heard[v]) for v in self._vehicles})

    def _figures(
        self,
        receiver: int,
        classes: dict[int, Class],
        marks: dict[int, tuple[int, int] | None],
        groups: set[int],
        cut: int,
    ) -> ReceiverFigures:
        held: dict[int, LinkConditions] = {}
        cut_from = []
        for sender, mark in marks.items():
            if sender == receiver and len(marks) > 1:
                continue
            kind, group = mark or (0, 0)
            if sender != receiver and group not in groups:
                cut_from.append(sender)
            if kind in classes:
                held[sender] = self._with_distribution(classes[kind].link, receiver, kind)
            else:
                held[sender] = LinkConditions()  # an HTB passes what it has no class for
        gone = self._gone[receiver]
        passed = gone.passed + sum(counted.passed for counted in classes.values())
        lost = gone.lost + sum(counted.dropped for counted in classes.values())
        return ReceiverFigures.of(held, tuple(cut_from), passed, lost, cut)

    def _with_distribution(self, link: LinkConditions, receiver: int, kind: int) -> LinkConditions:
        """What the kernel says, and whose table it was given, of which it does not speak."""
        holds = self._classes[receiver].get(kind)
        if link.delay is None or not link.delay.jitter_s or holds is None or holds.distribution == "uniform":
            return link
        return replace(link, delay=replace(link.delay, distribution=holds.distribution))


def _kinds(conditions: NetworkConditions, vehicles: tuple[int, ...]) -> list[frozenset[int]]:
    """Senders whom every receiver treats alike, together."""
    shared = (conditions.default, *conditions.receivers.values())
    own: dict[int, list[object]] = {vehicle: [] for vehicle in vehicles}
    for sender, receiver, link in conditions.differing_links():
        own[sender].append((receiver, link))
    memories = {sender for (sender, _), link in conditions.links.items() if link.remembers}
    if any(link.remembers for link in shared):
        memories = set(vehicles)
    members: dict[object, set[int]] = {}
    for vehicle, differing in own.items():
        key = vehicle if vehicle in memories else tuple(differing)
        members.setdefault(key, set()).add(vehicle)
    return [frozenset(kind) for kind in members.values()]


def _classes(conditions: NetworkConditions, kinds: _Numbers, receiver: int) -> dict[int, LinkConditions]:
    """What a receiver does to each kind that it can hear; alone in the lab, to its own."""
    senders = {number: next((v for v in kind if v != receiver), None) for kind, number in kinds.items()}
    links = {n: conditions.link(sender, receiver) for n, sender in senders.items() if sender is not None}
    return links or {n: conditions.link(receiver, receiver) for n in senders}


def _number(sets: Iterable[frozenset[int]], before: _Numbers, taken: Iterable[int]) -> _Numbers:
    """Numbers for sets of vehicles: a set that stays keeps its number, and no number changes its meaning."""
    used = {*taken, *before.values()}
    free = (number for number in range(1, MAX_KIND) if number not in used)
    return {members: before[members] if members in before else next(free) for members in sets}


def _numbers(sets: _Numbers) -> dict[int, int]:
    return {vehicle: number for members, number in sets.items() for vehicle in members}
