"""The requests of engine "netem": what it says to the kernel about one switch port, and what it reads there.

Numbers are those of linux/pkt_sched.h. HTB is here for its classes alone: their rate is the highest that
the interface takes without its 64-bit attribute (34 Gbit/s), beyond what a veth pair carries.
"""

from __future__ import annotations

import socket
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from pyroute2.netlink.rtnl import (
    RTM_DELQDISC,
    RTM_DELTCLASS,
    RTM_DELTFILTER,
    RTM_GETQDISC,
    RTM_GETTFILTER,
    RTM_NEWQDISC,
    RTM_NEWTCLASS,
    RTM_NEWTFILTER,
)
from pyroute2.netlink.rtnl.tcmsg import act_skbedit, tcmsg

from netem.conditions import LinkConditions
from netem.netlink import NEW, NLM_F_CREATE, Netlink, Request

CUT = 0x7FFE  # the class of senders that the receiver does not hear; smaller numbers are kinds

_SET = NLM_F_CREATE | 0x100  # NLM_F_REPLACE: make it so, whether it is there or not
_ROOT = 0xFFFFFFFF
_INGRESS = 0xFFFFFFF1
_INGRESS_HANDLE = 0xFFFF0000
_HTB = 0x10000  # 1:
_ALWAYS = 0xFFFFFFFF  # netem's probability 1
_RATE = 0xFFFFFFFF  # bytes/s
_BURST = 15625  # 1 ms in ticks of 64 ns
_QUANTUM = 60000  # bytes
_LIMIT = 1000  # packets in a netem's queue, tc's own default
_ETH_P_ALL = 3


@dataclass(frozen=True)
class Counters:
    """What one class does and has counted; `loss` as a probability, the rest in packets."""

    loss: float = 0.0
    passed: int = 0
    dropped: int = 0


class TrafficControl:
    """Speaks of one switch port, by its interface number."""

    def __init__(self, index: int) -> None:
        self.index = index

    def install(self) -> list[Request]:
        """An HTB whose only class loses everything, and the place for marks."""
        settings = {"version": 3, "rate2quantum": 10, "defcls": CUT, "debug": 0, "direct_pkts": 0}
        root = self._message("htb", _ROOT, _HTB, {"attrs": [("TCA_HTB_INIT", settings)]})
        entrance = self._message("ingress", _INGRESS, _INGRESS_HANDLE)
        return [
            Request("add qdisc htb", RTM_NEWQDISC, root, NEW),
            *self.add_class(CUT, LinkConditions(loss=1.0)),
            Request("add qdisc ingress", RTM_NEWQDISC, entrance, NEW),
        ]

    def uninstall(self) -> list[Request]:
        return [
            Request("delete qdisc htb", RTM_DELQDISC, self._message("htb", _ROOT, _HTB)),
            Request("delete qdisc ingress", RTM_DELQDISC, self._message("ingress", _INGRESS, _INGRESS_HANDLE)),
        ]

    def add_class(self, kind: int, link: LinkConditions) -> list[Request]:
        rate = {"rate": _RATE, "ceil": _RATE, "buffer": _BURST, "cbuffer": _BURST, "quantum": _QUANTUM}
        message = self._message("htb", _HTB, _HTB | kind, {"attrs": [("TCA_HTB_PARMS", rate)]})
        return [Request("set class of htb", RTM_NEWTCLASS, message, _SET), self.change_class(kind, link)]

    def change_class(self, kind: int, link: LinkConditions) -> Request:
        """Set the netem of a class, in place if there is one."""
        loss = round(link.independent_loss * _ALWAYS)
        if 0.0 < link.independent_loss < 1.0:  # what is neither 0 nor 1 must not become it by rounding
            loss = min(max(loss, 1), _ALWAYS - 1)
        options = {"limit": _LIMIT, "loss": loss}
        message = self._message("netem", _HTB | kind, (0x8000 | kind) << 16, options)
        return Request(f"set qdisc netem to loss {link.independent_loss:g}", RTM_NEWQDISC, message, _SET)

    def remove_class(self, kind: int) -> Request:
        return Request("delete class of htb", RTM_DELTCLASS, self._message("htb", _HTB, _HTB | kind))

    def mark(self, kind: int, priority: int) -> Request:
        """From here on, packets that enter at this port are of a kind (the filter of priority 1 wins)."""
        action = {
            "attrs": [
                ("TCA_ACT_KIND", "skbedit"),
                ("TCA_ACT_OPTIONS", act_skbedit.get_parameters({"priority": _HTB | kind})),
            ]
        }
        options = {"attrs": [("TCA_MATCHALL_ACT", {"attrs": [("TCA_ACT_PRIO_1", action)]})]}
        message = self._filter(priority, options)
        return Request("add filter matchall with action skbedit", RTM_NEWTFILTER, message, NEW)

    def unmark(self, priority: int) -> Request:
        return Request("delete filter matchall", RTM_DELTFILTER, self._filter(priority))

    def marked(self, netlink: Netlink) -> int | None:
        """The kind that the kernel gives to packets that enter at this port."""
        question = self._message(None, _INGRESS_HANDLE, 0)
        found: dict[int, int] = {}
        for entry in netlink.dump("list filters", RTM_GETTFILTER, question):
            value: Any = entry
            for name in ("OPTIONS", "MATCHALL_ACT", "ACT_PRIO_1", "ACT_OPTIONS", "SKBEDIT_PRIORITY"):
                value = value.get_attr(f"TCA_{name}")
                if value is None:
                    break
            else:
                found[entry["info"] >> 16] = value & 0xFFFF
        return found[min(found)] if found else None

    @staticmethod
    def classes(netlink: Netlink) -> dict[int, dict[int, Counters]]:
        """For every port by interface number, what its classes do: one question for the whole switch."""
        found: dict[int, dict[int, Counters]] = {}
        for entry in netlink.dump("list qdiscs", RTM_GETQDISC, tcmsg()):
            if entry.get_attr("TCA_KIND") != "netem":
                continue
            statistics = entry.get_attr("TCA_STATS2")
            found.setdefault(entry["index"], {})[entry["parent"] & 0xFFFF] = Counters(
                # Nine digits: the kernel's own steps are a quarter of the last one.
                loss=round(entry.get_attr("TCA_OPTIONS")["loss"] / _ALWAYS, 9),
                passed=statistics.get_attr("TCA_STATS_BASIC")["packets"],
                dropped=statistics.get_attr("TCA_STATS_QUEUE")["drops"],
            )
        return found

    def _filter(self, priority: int, options: Any = None) -> Any:
        message = self._message("matchall", _INGRESS_HANDLE, 0, options)
        message["info"] = priority << 16 | socket.htons(_ETH_P_ALL)
        return message

    def _message(self, kind: str | None, parent: int, handle: int, options: Any = None) -> Any:
        message = tcmsg()
        message.update({"index": self.index, "parent": parent, "handle": handle})
        attributes: Sequence[tuple[str, Any]] = [("TCA_KIND", kind)] if kind else []
        message["attrs"] = [*attributes, *([("TCA_OPTIONS", options)] if options is not None else [])]
        return message
