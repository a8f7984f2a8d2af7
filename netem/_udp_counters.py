"""Read the UDP counters of a network namespace from /proc/net/snmp and /proc/net/netstat (proc_net(5))."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

_NET = Path("/proc/thread-self/net")


@dataclass(frozen=True)
class UdpCounters:
    """The counts of UDP datagrams in the network of one vehicle. They include datagrams of sockets that are already
    closed.
    """

    broadcasts: int
    """Number of broadcasts that arrived, including the vehicle's own."""
    read: int
    """Number of datagrams that programs have read."""
    overflowed: int
    """Number of datagrams that the kernel discarded because a socket's receive buffer was full."""
    unreachable: int
    """Number of datagrams that the kernel discarded because no socket was open for them."""
    others: int
    """Number of arrived datagrams that are not broadcasts, for example on loopback."""


def read_udp_counters() -> dict[str, int]:
    """Return the counters of the calling thread's network namespace as a JSON object."""
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
