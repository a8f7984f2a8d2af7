"""The engine "netem". It applies all network conditions with the kernel's netem at the switch ports.

A packet gets two numbers at its sender's port: the group of its sender in a partition, and the *kind* of its sender.
Every receiver has the same conditions for all senders of one kind. At the receiver's port the packet passes two stages.
The first stage drops packets of other groups. In the second, an HTB chooses the class of the packet's kind, which
contains one netem:

    v7 ingress  basic   skbedit priority 1:2 mark 1       vehicle 7 has kind 2 and group 1
    v7 egress   fw 1    pass                              vehicle 7 receives group 1
                basic   drop                              and no other group
    v7 root     htb 1:
                  class 1:1     netem loss 15 %           packets of kind 1 to vehicle 7
                  class 1:3     netem delay 100 ms        packets of kind 3 to vehicle 7

A switch handles a packet once per receiver, so random losses and delays are drawn separately for each receiver. On some
links, earlier packets affect later packets (links with memory: bursts, rate, limit). Each sender on such a link is a
kind of its own, because only its own packets may affect its later packets.

If only values change, the engine changes the existing netem. The netem keeps its queue, and other netems are not
affected. If the kinds change, the engine first adds new classes and then moves the senders one by one. The engine
removes an old class after the last packet has left the class. A partition does not change the classes. First, the
receivers accept the new groups in addition to the old ones. Then the senders move to their new groups one by one. At
last, the receivers stop accepting the old groups. At any time, each pair therefore has either the old or the new
conditions. The duration of a change grows with the number of vehicles, not with the number of pairs.

Since 2025 (6.1.148, 6.6.102, 6.12.42, 6.16.1), Linux requires that a netem with duplication is the only one at its
port. Duplication is then refused if a receiver does not treat all senders alike, or on links with memory. Newer kernels
also limit the jitter to 2.1 s. `may_refuse` returns whether some kernels refuse a network, so that it must be tested
before the run. See tc-netem(8), tc-htb(8), tc-skbedit(8), tc-fw(8).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from errno import ENOENT

from netem._fabric import VirtualSwitch
from netem._netlink import NetlinkRequest, NetlinkSocket
from netem._tc_requests import MAX_KIND, TrafficClass, TrafficControl
from netem.conditions import NetworkConditions
from netem.engine import AppliedConditions, Engine, ReceiverFigures
from netem.errors import EngineError, NetlinkError
from netem.link import Distribution, LinkConditions

_Numbers = dict[frozenset[int], int]

_SURE_JITTER_S = (2**31 - 1) / 1e9
"""Maximum jitter in seconds that every kernel with netem supports."""


def may_refuse(conditions: NetworkConditions) -> bool:
    """Return true if some kernels with netem refuse these network conditions. See the docstring of this module for the
    reasons.
    """
    links = (conditions.default, *conditions.receivers.values(), *conditions.links.values())
    return any(link.duplicate or (link.delay and link.delay.jitter_s > _SURE_JITTER_S) for link in links)


@dataclass
class _RemovedTrafficTotals:
    """The counters of packets in traffic classes that were removed."""

    passed: int = 0
    lost: int = 0


@dataclass
class _ClassState:
    """The state of a traffic class. `link` contains the network conditions that the engine last set for the class, or
    None if the kernel refused them. `distribution` is the distribution of the delay.
    """

    link: LinkConditions | None
    distribution: Distribution = "uniform"


class NetemEngine(Engine):
    """An engine that applies all network conditions of netem, for each pair of sender and receiver."""

    name = "netem"
    has_queues = True

    def __init__(self, fabric: VirtualSwitch) -> None:
        super().__init__(fabric)
        self._netlink: NetlinkSocket = fabric.netlink
        self._ports = {vehicle: TrafficControl(fabric.port_index(vehicle)) for vehicle in self._vehicles}
        self._removed = {vehicle: _RemovedTrafficTotals() for vehicle in self._vehicles}
        self._kinds: _Numbers = {}
        self._groups: _Numbers = {}
        self._loss_conditions: NetworkConditions | None = None  # the conditions of the present classes; None if unknown
        # State of the kernel: kind and group of each sender, and accepted groups of each receiver.
        self._marks: dict[int, tuple[int, int] | None] = dict.fromkeys(self._vehicles)
        self._accepted: dict[int, set[int]] = {vehicle: set() for vehicle in self._vehicles}
        self._classes: dict[int, dict[int, _ClassState]] = {vehicle: {} for vehicle in self._vehicles}
        first = self._ports[self._vehicles[0]]
        try:
            # Test one port first, so that an unsuitable kernel is left unchanged.
            try:
                self._netlink.send([*first.install(), *first.add_class(1, LinkConditions())])
                self._netlink.send([*first.guard(), first.accept_group(1), first.mark(1, group=1)])
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
                continue  # it was never created

    def change(self, conditions: NetworkConditions) -> None:
        try:
            self._change(conditions)
        except NetlinkError as error:
            self._marks, accepted_groups = self._filters()
            self._accepted = {vehicle: groups for vehicle, (groups, _) in accepted_groups.items()}
            raise EngineError(f"The kernel refused a change: {error}") from error

    def _change(self, conditions: NetworkConditions) -> None:
        groups = _number(conditions.groups(self._vehicles), self._groups, self._groups.values())
        figures = conditions.healed()
        if figures == self._loss_conditions:
            self._move(self._kinds, groups)  # a change of the partition alone
            return
        self._loss_conditions = None
        classes = {kind for held in self._classes.values() for kind in held}
        kinds = _number(_kinds(conditions, self._vehicles), self._kinds, classes)
        wanted = {vehicle: _classes(conditions, kinds, vehicle) for vehicle in self._vehicles}
        duplicating = []
        for receiver, links in wanted.items():
            held = self._classes[receiver]
            leaving = {kind: holds.link for kind, holds in held.items() if kind not in links and holds.link is not None}
            first = links
            if leaving and any(link.duplicate for link in (*leaving.values(), *links.values())):
                # New classes meet old ones here, but a netem with duplication must be alone (see the module). So
                # duplication is off for the moment, and old classes do not wait for their last packet.
                duplicating.append(receiver)
                first = {kind: replace(link, duplicate=0.0) for kind, link in (leaving | links).items()}
            self._set(receiver, first)
        self._move(kinds, groups)
        self._remove_unused(lambda receiver, counted: not counted.waiting or receiver in duplicating)
        for receiver in duplicating:
            self._set(receiver, wanted[receiver])
        self._loss_conditions = figures

    def _set(self, receiver: int, links: dict[int, LinkConditions]) -> None:
        """Set the network conditions at the receiver's port. Send only the differences from the current state to the
        kernel.
        """
        port, held = self._ports[receiver], self._classes[receiver]
        requests: list[NetlinkRequest] = []
        changed: dict[int, _ClassState] = {}
        for kind, link in links.items():
            before = held.get(kind)
            if before is not None and before.link == link:
                continue
            shape = link.delay.distribution if link.delay and link.delay.jitter_s else None
            known = before is not None and before.link is not None
            table = shape is not None and not (before and known and before.distribution == shape)
            request = port.change_class(kind, link, table=table)
            requests += [request] if known else port.add_class(kind, link)
            changed[kind] = _ClassState(link, shape or (before.distribution if before else "uniform"))
        held.update({kind: replace(holds, link=None) for kind, holds in changed.items()})
        self._netlink.send(requests)
        held.update(changed)

    def _move(self, kinds: _Numbers, groups: _Numbers) -> None:
        """Assign all senders to their new kinds and groups."""
        kind, group = _numbers(kinds), _numbers(groups)
        new = {vehicle: (kind[vehicle], group[vehicle]) for vehicle in self._vehicles}
        accepting = [vehicle for vehicle in self._vehicles if group[vehicle] not in self._accepted[vehicle]]
        self._netlink.send([self._ports[vehicle].accept_group(group[vehicle]) for vehicle in accepting])
        moved = [vehicle for vehicle in self._vehicles if self._marks[vehicle] != new[vehicle]]
        self._netlink.send([self._ports[vehicle].mark(*new[vehicle]) for vehicle in moved])
        old = [
            (v, former)
            for v, accepted_groups in self._accepted.items()
            for former in accepted_groups
            if former != group[v]
        ]
        self._netlink.send([self._ports[vehicle].reject_group(former) for vehicle, former in old])
        self._kinds, self._groups, self._marks = kinds, groups, {**new}
        self._accepted = {vehicle: {group[vehicle]} for vehicle in self._vehicles}

    def _remove_unused(self, gone: Callable[[int, TrafficClass], bool]) -> None:
        """Remove the unused traffic classes for which `gone` returns true, and keep their packet counts."""
        used = set(self._kinds.values())
        unused = {v: unused for v, held in self._classes.items() if (unused := [k for k in held if k not in used])}
        if not unused:
            return
        classes = self._read_classes()
        for receiver, kinds in unused.items():
            for kind in kinds:
                counted = classes[receiver].get(kind)
                if counted is not None and not gone(receiver, counted):
                    continue
                try:
                    self._netlink.send([self._ports[receiver].remove_class(kind)])
                except NetlinkError as error:
                    if error.errno != ENOENT:  # after a refused change, some classes do not exist
                        raise
                del self._classes[receiver][kind]
                if counted is not None:
                    self._removed[receiver].passed += counted.passed
                    self._removed[receiver].lost += counted.dropped

    def _read_classes(self) -> dict[int, dict[int, TrafficClass]]:
        """Return the traffic classes at the port of each receiver."""
        classes = TrafficControl.classes(self._netlink)
        return {vehicle: classes.get(port.index, {}) for vehicle, port in self._ports.items()}

    def _filters(self) -> tuple[dict[int, tuple[int, int] | None], dict[int, tuple[set[int], int]]]:
        """Return two mappings by vehicle. The first contains the mark of the packets that the vehicle sends. The second
        contains the groups whose packets may reach the vehicle, and the number of dropped packets.
        """
        marks = {vehicle: port.read_mark(self._netlink) for vehicle, port in self._ports.items()}
        return marks, {vehicle: port.accepted_groups(self._netlink) for vehicle, port in self._ports.items()}

    def read(self) -> AppliedConditions:
        try:
            self._remove_unused(lambda _, counted: not counted.waiting)
            classes = self._read_classes()
            marks, accepted_groups = self._filters()
        except NetlinkError as error:
            raise EngineError(f"The kernel did not report its state: {error}") from error
        return AppliedConditions(
            self.name, {v: self._figures(v, classes[v], marks, *accepted_groups[v]) for v in self._vehicles}
        )

    def _figures(
        self,
        receiver: int,
        classes: dict[int, TrafficClass],
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
                held[sender] = LinkConditions()  # an HTB passes packets without a class
        gone = self._removed[receiver]
        passed = gone.passed + sum(counted.passed for counted in classes.values())
        lost = gone.lost + sum(counted.dropped for counted in classes.values())
        return ReceiverFigures.of(held, tuple(cut_from), passed, lost, cut)

    def _with_distribution(self, link: LinkConditions, receiver: int, kind: int) -> LinkConditions:
        """Add the distribution of the delay to the network conditions that the kernel reports, because the kernel does
        not report the distribution.
        """
        holds = self._classes[receiver].get(kind)
        if link.delay is None or not link.delay.jitter_s or holds is None or holds.distribution == "uniform":
            return link
        return replace(link, delay=replace(link.delay, distribution=holds.distribution))


def _kinds(conditions: NetworkConditions, vehicles: tuple[int, ...]) -> list[frozenset[int]]:
    """Divide senders into kinds. All senders of a kind have the same network conditions at every receiver. On a link
    with memory, earlier packets affect later ones, so each sender on such a link forms its own kind.
    """
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
    """Return the network conditions of each traffic class at this receiver's port, by the number of the class. Each
    class belongs to one kind of senders. A kind whose only sender is the receiver itself is omitted, unless no other
    kind exists.
    """
    senders = {number: next((v for v in kind if v != receiver), None) for kind, number in kinds.items()}
    links = {n: conditions.link(sender, receiver) for n, sender in senders.items() if sender is not None}
    return links or {n: conditions.link(receiver, receiver) for n in senders}


def _number(sets: Iterable[frozenset[int]], before: _Numbers, taken: Iterable[int]) -> _Numbers:
    """Assign a number to each set of vehicles. Sets in `before` keep their numbers. The numbers in `taken` are not used
    for other sets.
    """
    used = {*taken, *before.values()}
    free = (number for number in range(1, MAX_KIND) if number not in used)
    return {members: before[members] if members in before else next(free) for members in sets}


def _numbers(sets: _Numbers) -> dict[int, int]:
    return {vehicle: number for members, number in sets.items() for vehicle in members}
