"""Build the netlink requests of the engine "netem" for one switch port.

Numbers come from linux/pkt_sched.h, pkt_cls.h and tc_act/. The engine uses the queueing discipline HTB only to divide
packets into classes. Each class has a rate of 34 Gbit/s, the highest value without the 64-bit attribute. This rate does
not limit packets, because a veth pair is slower.

If a change omits an option, netem keeps the old value of some options (corruption, rate, reordering, distribution
table) and resets others (loss model). Each change therefore contains all options. netem reports all options except the
distribution table.
"""

from __future__ import annotations

import socket
import struct
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

from netem import _distributions
from netem._attributes import attribute, nested, number, parse, parse_number, text
from netem._netlink import (
    NEW,
    NLM_F_CREATE,
    RTM_DELQDISC,
    RTM_DELTCLASS,
    RTM_DELTFILTER,
    RTM_GETQDISC,
    RTM_GETTFILTER,
    RTM_NEWQDISC,
    RTM_NEWTCLASS,
    RTM_NEWTFILTER,
    NetlinkRequest,
    NetlinkSocket,
)
from netem.link import MAX_LIMIT, Delay, Distribution, GilbertElliott, LinkConditions

MAX_KIND = 0x7FFF
"""Highest number of a traffic class. Each class and the netem inside it need a number of their own. With more classes,
no number would be left for their netems.
"""

RELAYED = 0x10000
"""Mark of frames that `netem.relay` delivers. The mark differs from all group numbers. Frames with this mark belong to
no traffic class.
"""

_SET = NLM_F_CREATE | 0x100  # NLM_F_REPLACE: create or replace
_ROOT = 0xFFFFFFFF
_CLSACT = 0xFFFFFFF1
_CLSACT_HANDLE = 0xFFFF0000
_INGRESS = 0xFFFFFFF2
_EGRESS = 0xFFFFFFF3
_HTB = 0x10000  # 1:
_RATE = 0xFFFFFFFF  # bytes/s
_BURST = 15625  # 1 ms in ticks of 64 ns
_QUANTUM = 60000  # bytes
_ETH_P_ALL = socket.htons(3)
_ONLY = 1  # handle of a port's only basic filter in each direction
_ACCEPT_PRIORITY, _DROP_PRIORITY = 1, 2  # priorities of filters at egress
_TICK_NS = 64
_ALWAYS = 0xFFFFFFFF  # netem's probability 1
_NANO = 1_000_000_000
_NO_LIMIT = MAX_LIMIT + 1  # packets: unlimited within available memory
_TABLE_SIZE = 4094  # 8 KB in the kernel, with its length

_KIND, _OPTIONS, _STATISTICS = 1, 2, 7  # TCA_KIND, TCA_OPTIONS, TCA_STATS2
_NETEM_CORR, _NETEM_TABLE, _NETEM_REORDER, _NETEM_CORRUPT, _NETEM_LOSS, _NETEM_RATE = range(1, 7)
_NETEM_RATE64, _NETEM_LATENCY64, _NETEM_JITTER64 = 8, 10, 11
_NETEM_LOSS_GE = 2
_ACT_OK, _ACT_SHOT = 0, 2

_TCMSG = struct.Struct("=BBHiIII")
_NETEM = struct.Struct("=6I")


@dataclass(frozen=True)
class TrafficClass:
    """The network conditions and packet counters of one traffic class. The kernel does not report the distribution of
    the delay.
    """

    link: LinkConditions
    passed: int
    dropped: int
    waiting: int


class TrafficControl:
    """A builder of requests for one switch port. `index` is the interface number of the port."""

    def __init__(self, index: int) -> None:
        self.index = index

    def install(self) -> list[NetlinkRequest]:
        """Return the requests that install the queueing discipline HTB without traffic classes."""
        settings = struct.pack("=5I", 3, 10, 0, 0, 0)  # version, rate2quantum, default class, debug, direct packets
        return [
            NetlinkRequest(
                "add qdisc htb", RTM_NEWQDISC, self._message("htb", _ROOT, _HTB, attribute(2, settings)), NEW
            )
        ]

    def guard(self) -> list[NetlinkRequest]:
        """Return the requests for filters that drop all packets at this port until `accept_group` allows a group.

        The filters let frames with the mark RELAYED pass.
        """
        drop = nested(1, text(1, "gact"), nested(2, attribute(2, struct.pack("=IIiii", 0, 0, _ACT_SHOT, 0, 0))))
        message = self._filter("basic", _EGRESS, _DROP_PRIORITY, _ONLY, nested(3, drop))
        return [
            NetlinkRequest("add qdisc clsact", RTM_NEWQDISC, self._message("clsact", _CLSACT, _CLSACT_HANDLE), NEW),
            NetlinkRequest("add filter basic with action gact", RTM_NEWTFILTER, message, NEW),
            self.accept_group(RELAYED),
        ]

    def uninstall(self) -> list[NetlinkRequest]:
        return [
            NetlinkRequest("delete qdisc htb", RTM_DELQDISC, self._message("htb", _ROOT, _HTB)),
            NetlinkRequest("delete qdisc clsact", RTM_DELQDISC, self._message("clsact", _CLSACT, _CLSACT_HANDLE)),
        ]

    def add_class(self, kind: int, link: LinkConditions) -> list[NetlinkRequest]:
        rate = struct.pack("=BBHhHI", 0, 1, 0, 0, 0, _RATE)  # 1: Ethernet
        figures = attribute(1, rate + rate + struct.pack("=5I", _BURST, _BURST, _QUANTUM, 0, 0))
        message = self._message("htb", _HTB, _HTB | kind, figures)
        return [NetlinkRequest("set class of htb", RTM_NEWTCLASS, message, _SET), self.change_class(kind, link)]

    def change_class(self, kind: int, link: LinkConditions, *, table: bool = True) -> NetlinkRequest:
        """Return the request that sets the network conditions of a traffic class. `table` is the distribution of the
        delay. Without it, the distribution does not change.
        """
        options = _options(link, table)
        message = self._header(_HTB | kind, (0x8000 | kind) << 16) + text(_KIND, "netem") + options
        return NetlinkRequest("set qdisc netem", RTM_NEWQDISC, message, _SET)

    def remove_class(self, kind: int) -> NetlinkRequest:
        return NetlinkRequest("delete class of htb", RTM_DELTCLASS, self._message("htb", _HTB, _HTB | kind))

    def mark(self, kind: int, group: int) -> NetlinkRequest:
        """Return the request that makes the kernel mark each packet that enters the switch at this port. The mark
        contains the kind and the group of the sender (see `netem.tc`).
        """
        parameters = attribute(2, struct.pack("=IIiii", 0, 0, _ACT_OK, 0, 0))
        edit = nested(1, text(1, "skbedit"), nested(2, parameters, number(3, _HTB | kind), number(5, group)))
        message = self._filter("basic", _INGRESS, 1, _ONLY, nested(3, edit))
        return NetlinkRequest("set filter basic with action skbedit", RTM_NEWTFILTER, message, _SET)

    def accept_group(self, group: int) -> NetlinkRequest:
        """Return the request that lets packets of a group leave the switch at this port."""
        return NetlinkRequest(
            "add filter fw", RTM_NEWTFILTER, self._filter("fw", _EGRESS, _ACCEPT_PRIORITY, group), NEW
        )

    def reject_group(self, group: int) -> NetlinkRequest:
        return NetlinkRequest("delete filter fw", RTM_DELTFILTER, self._filter("fw", _EGRESS, _ACCEPT_PRIORITY, group))

    def read_mark(self, netlink: NetlinkSocket) -> tuple[int, int] | None:
        """Return (kind, group) from the mark that the kernel sets on packets that enter the switch at this port. Return
        None if the kernel sets no mark.
        """
        for entry in netlink.dump("list filters", RTM_GETTFILTER, self._header(_INGRESS, 0)):
            edit = _inside(parse(entry[_TCMSG.size :]), _OPTIONS, 3, 1, 2)
            kind, group = parse_number(edit.get(3)), parse_number(edit.get(5))
            if kind is not None and group is not None:
                return kind & 0xFFFF, group
        return None

    def accepted_groups(self, netlink: NetlinkSocket) -> tuple[set[int], int]:
        """Return the groups whose packets may leave the switch at this port, and the number of packets of other groups
        that were dropped at this port.
        """
        groups = set()
        cut = 0
        for entry in netlink.dump("list filters", RTM_GETTFILTER, self._header(_EGRESS, 0)):
            handle = _TCMSG.unpack_from(entry)[4]
            attributes = parse(entry[_TCMSG.size :])
            if attributes.get(_KIND) == b"fw\0" and handle:
                groups.add(handle)
            elif counted := _inside(attributes, _OPTIONS, 3, 1, 4).get(1):
                (cut,) = struct.unpack_from("=8xI", counted)
        return groups - {RELAYED}, cut

    @staticmethod
    def classes(netlink: NetlinkSocket) -> dict[int, dict[int, TrafficClass]]:
        """Return the traffic classes of all ports by interface number. One request to the kernel is enough."""
        classes: dict[int, dict[int, TrafficClass]] = {}
        for entry in netlink.dump("list qdiscs", RTM_GETQDISC, bytes(_TCMSG.size)):
            _, _, _, index, _, parent, _ = _TCMSG.unpack_from(entry)
            attributes = parse(entry[_TCMSG.size :])
            if attributes[_KIND] != b"netem\0":
                continue
            statistics = parse(attributes[_STATISTICS])
            (passed,) = struct.unpack_from("=8xI", statistics[1])
            waiting, _, dropped = struct.unpack_from("=3I", statistics[3])
            link = _link(attributes[_OPTIONS])
            classes.setdefault(index, {})[parent & 0xFFFF] = TrafficClass(link, passed, dropped, waiting)
        return classes

    def _filter(self, kind: str, parent: int, priority: int, handle: int, *options: bytes) -> bytes:
        header = self._header(parent, handle, priority << 16 | _ETH_P_ALL)
        return header + text(_KIND, kind) + nested(_OPTIONS, *options)

    def _message(self, kind: str, parent: int, handle: int, *options: bytes) -> bytes:
        return self._header(parent, handle) + text(_KIND, kind) + (nested(_OPTIONS, *options) if options else b"")

    def _header(self, parent: int, handle: int, info: int = 0) -> bytes:
        return _TCMSG.pack(0, 0, 0, self.index, handle, parent, info)


def _inside(attributes: Mapping[int, bytes], *path: int) -> Mapping[int, bytes]:
    """Return the attributes that are nested inside other attributes. `path` lists the types of the outer attributes,
    the outermost first. The result is empty if one of them is missing.
    """
    for kind in path:
        attributes = parse(attributes.get(kind, b""))
    return attributes


@lru_cache(maxsize=1 << 12)
def _options(link: LinkConditions, table: bool) -> bytes:
    """Encode network conditions in the format of netem's TCA_OPTIONS."""
    delay = link.delay or Delay(0)
    latency_ns, jitter_ns = _nanoseconds(delay.mean_s), _nanoseconds(delay.jitter_s)
    loss = 0 if isinstance(link.loss, GilbertElliott) else _share(link.loss)
    reorder = _share(link.reorder)
    rate = 0 if link.rate is None else max(1, round(link.rate / 8))
    options = _NETEM.pack(
        min(latency_ns // _TICK_NS, 0xFFFFFFFF),
        link.limit or _NO_LIMIT,
        loss,
        1 if reorder else 0,  # gap: any packet may overtake
        _share(link.duplicate),
        min(jitter_ns // _TICK_NS, 0xFFFFFFFF),
    )
    attributes = [
        attribute(_NETEM_CORR, bytes(12)),
        attribute(_NETEM_REORDER, struct.pack("=2I", reorder, 0)),
        attribute(_NETEM_CORRUPT, struct.pack("=2I", _share(link.corrupt), 0)),
        attribute(_NETEM_RATE, struct.pack("=IiIi", min(rate, 0xFFFFFFFF), 0, 0, 0)),
        attribute(_NETEM_RATE64, struct.pack("=Q", rate)),
        attribute(_NETEM_LATENCY64, struct.pack("=q", latency_ns)),
        attribute(_NETEM_JITTER64, struct.pack("=q", jitter_ns)),
    ]
    if isinstance(link.loss, GilbertElliott):
        bursts = link.loss
        h = _ALWAYS - _share(bursts.loss_bad)
        model = struct.pack("=4I", _share(bursts.p), _share(bursts.r), h, _share(bursts.loss_good))
        attributes.append(nested(_NETEM_LOSS, attribute(_NETEM_LOSS_GE, model)))
    if table and delay.jitter_s:
        attributes.append(attribute(_NETEM_TABLE, _table(delay.distribution)))
    return attribute(_OPTIONS, options + b"".join(attributes))


@lru_cache
def _table(distribution: Distribution) -> bytes:
    return struct.pack(f"={_TABLE_SIZE}h", *_distributions.table(distribution, _TABLE_SIZE))


def _link(options: bytes) -> LinkConditions:
    """Decode netem's options to network conditions. This is the inverse of `_options`, except that the result lacks the
    distribution of the delay.
    """
    _, limit, loss, _, duplicate, _ = _NETEM.unpack_from(options)
    attributes = parse(options[_NETEM.size :])
    shares = (loss, duplicate, *(parse_number(attributes.get(key)) or 0 for key in (_NETEM_REORDER, _NETEM_CORRUPT)))
    times_ns = tuple(struct.unpack("=q", attributes[key])[0] for key in (_NETEM_LATENCY64, _NETEM_JITTER64))
    rate = attributes.get(_NETEM_RATE64) or attributes.get(_NETEM_RATE, b"")[:4]
    bursts = parse(attributes.get(_NETEM_LOSS, b"")).get(_NETEM_LOSS_GE)
    return _conditions(shares, times_ns, int.from_bytes(rate, sys.byteorder), limit, bursts)


@lru_cache(maxsize=1 << 15)
def _conditions(
    shares: tuple[int, ...], times_ns: tuple[int, ...], rate: int, limit: int, bursts: bytes | None
) -> LinkConditions:
    # Nine digits, because a step of the kernel is a quarter of the last one.
    loss, duplicate, reorder, corrupt = (round(share / _ALWAYS, 9) for share in shares)
    model = None
    if bursts is not None:
        p, r, h, loss_good = (round(share / _ALWAYS, 9) for share in struct.unpack("=4I", bursts))
        model = GilbertElliott(p, r, round(1 - h, 9), loss_good)
    latency_s, jitter_s = (time_ns / _NANO for time_ns in times_ns)
    return LinkConditions(
        model or loss,
        Delay(latency_s, jitter_s) if latency_s else None,
        duplicate,
        reorder,
        corrupt,
        8 * rate or None,
        None if limit == _NO_LIMIT or not (latency_s or rate) else limit,
    )


def _share(probability: float) -> int:
    """Convert a probability to netem's units. Rounding never changes the probability to 0 or 1."""
    if not 0.0 < probability < 1.0:
        return _ALWAYS if probability else 0
    return min(max(round(probability * _ALWAYS), 1), _ALWAYS - 1)


def _nanoseconds(seconds: float) -> int:
    """Convert a time from seconds to nanoseconds. Rounding never changes a positive time to 0."""
    return max(round(seconds * _NANO), 1) if seconds else 0
