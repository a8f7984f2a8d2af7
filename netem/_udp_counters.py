"""The counters of UDP datagrams in a network namespace, from /proc/net/snmp (proc_net(5))."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

_SNMP = Path("/proc/thread-self/net/snmp")


@dataclass(frozen=True)
class UdpCounters:
    """Datagrams of all UDP sockets in the network of one vehicle, also of sockets that are closed.

    `read` counts the datagrams that programs have read. `overflowed` counts those that the kernel discarded because
    the buffer of their socket was full. A broadcast reaches its sender, too, and counts there.
    """

    read: int
    overflowed: int


def read_udp_counters() -> dict[str, int]:
    """Return the counters of the network namespace of the calling thread, as JSON."""
    names, values = (line.split()[1:] for line in _SNMP.read_text().splitlines() if line.startswith("Udp:"))
    counted = dict(zip(names, map(int, values), strict=True))
    return asdict(UdpCounters(counted["InDatagrams"], counted["RcvbufErrors"]))
