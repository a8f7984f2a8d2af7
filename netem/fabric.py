"""The switch and the cables: bridge `air`, and for every vehicle a network namespace on a veth pair.

A vehicle sees `eth0` with its address and a default route on it (ArduPilot built with CAN needs a route
for its multicast). The other end, `v<ID>`, is a port of the bridge in the lab's own namespace, where the
engines meet every packet on its way to that vehicle. The vehicles' namespaces have no names: they live as
long as this process holds them open or someone lives in them. One that is there already, a container's, can
be a vehicle's too: the cable then ends in it.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any

from pyroute2.netlink.rtnl import RTM_GETLINK, RTM_NEWADDR, RTM_NEWLINK, RTM_NEWROUTE
from pyroute2.netlink.rtnl.ifaddrmsg import ifaddrmsg
from pyroute2.netlink.rtnl.ifinfmsg import ifinfmsg
from pyroute2.netlink.rtnl.rtmsg import rtmsg

from netem import addresses, namespaces
from netem.errors import LabError
from netem.netlink import NEW, Netlink, Request

BRIDGE = "air"

# Interface numbers are ours to choose in a fresh namespace, which saves asking the kernel for them.
_LO = 1
_ETH0 = 2
_BRIDGE_INDEX = 2
_FIRST_PORT_INDEX = 3

_UP = {"flags": 1, "change": 1}  # IFF_UP
_FORWARDING = 3  # BR_STATE_FORWARDING
_CARRIER_DEADLINE_S = 5.0


class Fabric:
    """The lab's network; built in the network namespace that the calling thread is in."""

    def __init__(self, vehicles: Sequence[int], networks: Mapping[int, int]) -> None:
        self.vehicles = tuple(vehicles)
        self.home = namespaces.open_network()
        self.netlink = Netlink()
        self._namespaces = dict(networks)
        _silence_ipv6()
        _bypass_firewall()
        self.netlink.send([_link("lo", index=_LO), _bridge()])
        inside = {vehicle: self._namespace(vehicle) for vehicle in self.vehicles}
        self.netlink.send([self._cable(vehicle) for vehicle in self.vehicles])
        for vehicle, netlink in inside.items():
            netlink.send(_configure(vehicle))
            netlink.close()
        self._await_carrier()

    def port_index(self, vehicle: int) -> int:
        """Interface number of a vehicle's switch port `v<ID>` in the lab's namespace."""
        return _FIRST_PORT_INDEX + self.vehicles.index(vehicle)

    def inside(self, vehicle: int | None) -> AbstractContextManager[None]:
        """Run a block in a vehicle's network, or in the lab's own for None."""
        return namespaces.inside(self.home if vehicle is None else self._namespaces[vehicle], self.home)

    def _namespace(self, vehicle: int) -> Netlink:
        """Make a vehicle's namespace, if there is none yet, and return a netlink socket that stays in it."""
        if vehicle in self._namespaces:
            namespaces.enter_network(self._namespaces[vehicle])
        else:
            namespaces.unshare_network()
            self._namespaces[vehicle] = namespaces.open_network()
        try:
            _silence_ipv6()
            return Netlink()
        finally:
            namespaces.enter_network(self.home)

    def _cable(self, vehicle: int) -> Request:
        far_end = {
            "index": _ETH0,
            "attrs": [
                ("IFLA_IFNAME", "eth0"),
                ("IFLA_ADDRESS", addresses.mac(vehicle)),
                ("IFLA_NET_NS_FD", self._namespaces[vehicle]),
            ],
        }
        name = addresses.port(vehicle)
        data = {"attrs": [("VETH_INFO_PEER", far_end)]}
        kind = {"attrs": [("IFLA_INFO_KIND", "veth"), ("IFLA_INFO_DATA", data)]}
        attributes = [("IFLA_IFNAME", name), ("IFLA_MASTER", _BRIDGE_INDEX), ("IFLA_LINKINFO", kind)]
        return _link(f"create veth pair {name}", self.port_index(vehicle), attributes, NEW)

    def _await_carrier(self) -> None:
        """Wait until the bridge forwards on every port: the kernel notices a cable a moment later."""
        deadline = time.monotonic() + _CARRIER_DEADLINE_S
        while True:
            question = ifinfmsg()
            question["family"] = 7  # AF_BRIDGE: the ports, with their state
            ports = self.netlink.dump("list the ports of the bridge", RTM_GETLINK, question)
            ready = {port["index"] for port in ports if _state(port) == _FORWARDING}
            if missing := [v for v in self.vehicles if self.port_index(v) not in ready]:
                if time.monotonic() > deadline:
                    names = ", ".join(map(addresses.port, missing[:5]))
                    raise LabError(f"The bridge does not forward on port {names} after {_CARRIER_DEADLINE_S} s")
                time.sleep(0.002)
            else:
                return


def _state(port: Any) -> int | None:
    info = port.get_attr("IFLA_PROTINFO")
    return None if info is None else info.get_attr("IFLA_BRPORT_STATE")


def _silence_ipv6() -> None:
    """No IPv6 on links made from here on: an idle link carries nothing that nobody asked for."""
    _sysctl("ipv6/conf/default/disable_ipv6", b"1")


def _bypass_firewall() -> None:
    """Where br_netfilter is loaded (by Docker, often), keep it from judging what our bridge carries."""
    for protocol in ("iptables", "ip6tables", "arptables"):
        _sysctl(f"bridge/bridge-nf-call-{protocol}", b"0")


def _sysctl(name: str, value: bytes) -> None:
    """Set a value of the network namespace that we are in, if its kernel has such a thing."""
    try:
        fd = os.open(f"/proc/sys/net/{name}", os.O_WRONLY | os.O_CLOEXEC)
    except FileNotFoundError:
        return
    try:
        os.write(fd, value)
    finally:
        os.close(fd)


def _link(what: str, index: int, attributes: Sequence[Any] = (), flags: int = 0) -> Request:
    """Create or change a link, and set it up."""
    message = ifinfmsg()
    message.update({"index": index, **_UP, "attrs": list(attributes)})
    return Request(what, RTM_NEWLINK, message, flags)


def _bridge() -> Request:
    # No spanning tree, so that a port forwards at once; no snooping, so that multicast reaches everyone,
    # as it does over the air.
    settings = [("IFLA_BR_STP_STATE", 0), ("IFLA_BR_FORWARD_DELAY", 0), ("IFLA_BR_MCAST_SNOOPING", 0)]
    kind = {"attrs": [("IFLA_INFO_KIND", "bridge"), ("IFLA_INFO_DATA", {"attrs": settings})]}
    attributes = [("IFLA_IFNAME", BRIDGE), ("IFLA_LINKINFO", kind)]
    return _link(f"create bridge {BRIDGE}", _BRIDGE_INDEX, attributes, NEW)


def _configure(vehicle: int) -> list[Request]:
    where = f"vehicle {vehicle}"
    own = addresses.address(vehicle)
    address = ifaddrmsg()
    address.update({"family": 2, "prefixlen": addresses.PREFIX_LENGTH, "index": _ETH0})
    address["attrs"] = [
        ("IFA_LOCAL", own),
        ("IFA_ADDRESS", own),
        ("IFA_BROADCAST", addresses.BROADCAST),
    ]
    route = rtmsg()
    # Main table, static, unicast, on-link: whoever is on the air is next door.
    route.update({"family": 2, "table": 254, "proto": 4, "type": 1, "scope": 253})
    route["attrs"] = [("RTA_OIF", _ETH0)]
    return [
        _link(f"{where}: lo", index=_LO),
        _link(f"{where}: eth0", index=_ETH0),
        Request(f"{where}: address {own}", RTM_NEWADDR, address, NEW),
        Request(f"{where}: default route", RTM_NEWROUTE, route, NEW),
    ]
