"""Read the UDP counters of a network namespace from /proc/net/snmp and /proc/net/netstat (proc_net(5))."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

_NET = Path("/proc/thread-self/net")


@dataclass(frozen=True)
class UdpCounters:
    """The counts of UDP datagrams in the network of one vehicle, including those of closed sockets.

    `broadcasts` counts the broadcasts that arrived, including those of the vehicle itself. `read` counts the datagrams
    that programs have read. `overflowed` counts those that the kernel discarded because the buffer of their socket was
    full, and `unreachable` those that it discarded because no socket was open. `others` counts the other datagrams that
    arrived, for example on loopback.
    """

    broadcasts: int
    read: int
    overflowed: int
    unreachable: int
    others: int


def read_udp_counters() -> dict[str, int]:
    """Return the counters of the network namespace of the calling thread, as JSON."""
    udp = _counters("snmp", "Udp:")
    unreachable = udp["NoPorts"] + udp["IgnoredMulti"]
    broadcasts = _counters("netstat", "IpExt:")["InBcastPkts"]
    no_datagrams = _counters("snmp", "Tcp:")["InSegs"] + _counters("snmp", "Icmp:")["InMsgs"]
    others = max(0, _counters("snmp", "Ip:")["InDelivers"] - no_datagrams - broadcasts)
    return asdict(UdpCounters(broadcasts, udp["InDatagrams"], udp["RcvbufErrors"], unreachable, others))


def _counters(file: str, group: str) -> dict[str, int]:
    lines = (_NET / file).read_text().splitlines()
    names, values = (line.split()[1:] for line in lines if line.startswith(group))
    return dict(zip(names, map(int, values), strict=True))
