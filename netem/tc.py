"""Engine "netem": Linux netem at the switch ports, over netlink, where the kernel has sch_netem.

On the port that leads to a receiver stands an HTB whose classes hold one netem each; the packet's
priority picks the class. It is set where the packet enters the switch, by an action on its sender's port,
and names the sender's *kind*: senders of one kind are treated alike by everybody. Today a kind is a group
of a partition; conditions per pair would make kinds smaller, down to one per sender, without another
shape. A class only exists for a kind that the receiver hears, and all else falls into the default class,
whose netem loses everything:

    v7 ingress  matchall  skbedit priority 1:2            vehicle 7 is of kind 2
    v7 root     htb 1: default 7ffe
                  class 1:2     netem loss 15 %           what 7 hears of its own group
                  class 1:7ffe  netem loss 100 %          and of the others

A switch sees a packet once per receiver, so each receiver draws its own lot. A change of figures changes
the netem in place. A change of kinds first adds the new classes, then moves the senders over one by one,
then takes the old classes away: nobody is ever in no class.
See tc-netem(8), tc-htb(8), tc-skbedit(8).
"""

from __future__ import annotations

from dataclasses import dataclass

from netem.conditions import LinkConditions, NetworkConditions
from netem.engine import Applied, Engine, ReceiverFigures
from netem.errors import EngineError, NetlinkError
from netem.fabric import Fabric
from netem.netlink import Netlink, Request
from netem.tc_requests import CUT, Counters, TrafficControl


@dataclass
class _Totals:
    """Packets counted by classes that are gone."""

    passed: int = 0
    lost: int = 0


class NetemEngine(Engine):
    """Everything that netem can do, per kind of sender and receiver; today loss and partitions."""

    name = "netem"

    def __init__(self, fabric: Fabric) -> None:
        super().__init__(fabric)
        self._netlink: Netlink = fabric.netlink
        self._ports = {vehicle: TrafficControl(fabric.port_index(vehicle)) for vehicle in self._vehicles}
        self._gone = {vehicle: _Totals() for vehicle in self._vehicles}
        self._kinds: dict[frozenset[int], int] = {}
        self._entrance: dict[int, int] = {}  # sender -> priority of its filter in force, 1 or 2
        first = self._ports[self._vehicles[0]]
        try:
            # One port first: a kernel that cannot is left as it was.
            try:
                self._netlink.send([*first.install(), *first.add_class(1, LinkConditions())])
                self._netlink.send([first.mark(1, priority=1)])
            finally:
                self._remove(first)
            for port in self._ports.values():
                self._netlink.send(port.install())
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
            raise EngineError(f"The kernel refused a change: {error}") from error

    def _change(self, conditions: NetworkConditions) -> None:
        old = {vehicle: kind for group, kind in self._kinds.items() for vehicle in group}
        kinds = self._number(conditions.groups(self._vehicles))
        new = {vehicle: kind for group, kind in kinds.items() for vehicle in group}
        moved = [vehicle for vehicle in self._vehicles if old.get(vehicle) != new[vehicle]]
        figures: list[Request] = []
        for vehicle, port in self._ports.items():
            link = conditions.link(vehicle, vehicle)
            if vehicle in moved:
                figures += port.add_class(new[vehicle], link)
            else:
                figures.append(port.change_class(new[vehicle], link))
        self._netlink.send(figures)
        if not moved:
            return
        for vehicle in moved:
            # The filter of priority 1 wins. Whether it is the new one that comes or the old one that
            # goes, one request moves the sender over.
            port, entrance = self._ports[vehicle], self._entrance.get(vehicle)
            self._entrance[vehicle] = 2 if entrance == 1 else 1
            requests = [port.mark(new[vehicle], self._entrance[vehicle])]
            if entrance is not None:
                requests.append(port.unmark(entrance))
            self._netlink.send(requests)
        self._kinds = kinds
        self._retire({vehicle: old[vehicle] for vehicle in moved if vehicle in old})

    def _number(self, groups: tuple[frozenset[int], ...]) -> dict[frozenset[int], int]:
        """Kinds for groups: a group that stays keeps its number, and no number changes its meaning."""
        taken = set(self._kinds.values())
        free = (number for number in range(1, CUT) if number not in taken)
        return {group: self._kinds[group] if group in self._kinds else next(free) for group in groups}

    def _retire(self, classes: dict[int, int]) -> None:
        """Remove classes that nobody uses any more, and remember what they counted."""
        if not classes:
            return
        counters = self._counters()
        for vehicle, kind in classes.items():
            count = counters[vehicle].get(kind, Counters())
            self._gone[vehicle].passed += count.passed
            self._gone[vehicle].lost += count.dropped
        self._netlink.send([self._ports[vehicle].remove_class(kind) for vehicle, kind in classes.items()])

    def _counters(self) -> dict[int, dict[int, Counters]]:
        found = TrafficControl.classes(self._netlink)
        return {vehicle: found.get(port.index, {}) for vehicle, port in self._ports.items()}

    def read(self) -> Applied:
        try:
            counters = self._counters()
            kinds = {vehicle: port.marked(self._netlink) for vehicle, port in self._ports.items()}
        except NetlinkError as error:
            raise EngineError(f"The kernel did not say what it holds: {error}") from error
        receivers = {}
        for vehicle in self._vehicles:
            heard = {kind: count for kind, count in counters[vehicle].items() if kind != CUT}
            cut_from = tuple(s for s in self._vehicles if s != vehicle and kinds[s] not in heard)
            gone = self._gone[vehicle]
            receivers[vehicle] = ReceiverFigures(
                # One class per receiver while conditions are the receiver's; if there are more, the
                # worst is the one to show.
                loss=max((count.loss for count in heard.values()), default=1.0),
                cut_from=cut_from,
                passed=gone.passed + sum(count.passed for count in heard.values()),
                lost=gone.lost + sum(count.dropped for count in heard.values()),
                cut=counters[vehicle].get(CUT, Counters()).dropped,
            )
        return Applied(self.name, receivers)
