"""Build the virtual network: a bridge named `air`, and a network namespace with a cable (veth pair) for each vehicle.

The end of the cable in the vehicle's namespace is the interface `eth0`. It has the vehicle's address and a default
route, because ArduPilot built with CAN needs a route for its multicast packets. The other end, `v<ID>`, is a port of
the bridge in the lab's own namespace. At this port the engines handle each packet for the vehicle. The namespaces of
the vehicles have no names. They exist as long as this process holds them open or a process runs in them. A vehicle can
also use a namespace that already exists, such as the namespace of a container. The cable then ends in this namespace.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager

from netem import _namespaces, addresses
from netem._fabric_requests import address, bridge, default_route, forwarding, set_up, veth_pair
from netem._netlink import NetlinkRequest, NetlinkSocket
from netem.errors import LabError

BRIDGE = "air"

# A fresh namespace lets us choose interface numbers, so we need not ask the kernel for them.
LO = 1
_ETH0 = 2
_BRIDGE_INDEX = 2
_FIRST_PORT_INDEX = 3

_CARRIER_DEADLINE_S = 5.0


class VirtualSwitch:
    """The virtual network, built in the network namespace of the calling thread."""

    def __init__(self, vehicles: Sequence[int], networks: Mapping[int, int]) -> None:
        self.vehicles = tuple(vehicles)
        self.home = _namespaces.open_network()
        self.netlink = NetlinkSocket()
        self._namespaces = dict(networks)
        disable_ipv6()
        _bypass_firewall()
        self.netlink.send([set_up("lo", LO), bridge(BRIDGE, _BRIDGE_INDEX)])
        inside = {vehicle: self._namespace(vehicle) for vehicle in self.vehicles}
        self.netlink.send([self._cable(vehicle) for vehicle in self.vehicles])
        for vehicle, netlink in inside.items():
            netlink.send(configure_vehicle(vehicle, _ETH0))
            netlink.close()
        self._wait_for_carrier()

    def port_index(self, vehicle: int) -> int:
        """Return the interface number of a vehicle's switch port `v<ID>`."""
        return _FIRST_PORT_INDEX + self.vehicles.index(vehicle)

    def inside(self, vehicle: int | None) -> AbstractContextManager[None]:
        """Return a context manager. Code in its context runs in the network namespace of the vehicle. If `vehicle` is
        None, the code runs in the namespace of the switch.
        """
        return _namespaces.inside(self.home if vehicle is None else self._namespaces[vehicle], self.home)

    def inodes(self) -> dict[int, int]:
        """Return vehicle ID -> inode number of the vehicle's network namespace."""
        return {vehicle: os.fstat(namespace).st_ino for vehicle, namespace in self._namespaces.items()}

    def _namespace(self, vehicle: int) -> NetlinkSocket:
        """Return a netlink socket in the network namespace of a vehicle. If the namespace does not exist, create it."""
        if vehicle in self._namespaces:
            _namespaces.enter_network(self._namespaces[vehicle])
        else:
            _namespaces.unshare_network()
            self._namespaces[vehicle] = _namespaces.open_network()
        try:
            disable_ipv6()
            return NetlinkSocket()
        finally:
            _namespaces.enter_network(self.home)

    def _cable(self, vehicle: int) -> NetlinkRequest:
        return veth_pair(
            addresses.port(vehicle),
            self.port_index(vehicle),
            _BRIDGE_INDEX,
            far_name="eth0",
            far_index=_ETH0,
            mac=addresses.mac(vehicle),
            network=self._namespaces[vehicle],
        )

    def _wait_for_carrier(self) -> None:
        """Wait until the bridge forwards packets on each port. After a cable is plugged in, the kernel needs a short
        time to detect it.
        """
        deadline = time.monotonic() + _CARRIER_DEADLINE_S
        while True:
            ready = forwarding(self.netlink)
            if missing := [v for v in self.vehicles if self.port_index(v) not in ready]:
                if time.monotonic() > deadline:
                    names = ", ".join(map(addresses.port, missing[:5]))
                    raise LabError(f"The bridge does not forward on port {names} after {_CARRIER_DEADLINE_S} s")
                time.sleep(0.002)
            else:
                return


def disable_ipv6() -> None:
    """Disable IPv6 on new links. Otherwise the kernel would send IPv6 packets that no program requested."""
    _sysctl("ipv6/conf/default/disable_ipv6", b"1")


def _bypass_firewall() -> None:
    """Prevent br_netfilter from filtering the packets of the bridge. Docker often loads this kernel module."""
    for protocol in ("iptables", "ip6tables", "arptables"):
        _sysctl(f"bridge/bridge-nf-call-{protocol}", b"0")


def _sysctl(name: str, value: bytes) -> None:
    """Set a kernel parameter of the current network namespace. Do nothing if the kernel lacks the parameter."""
    try:
        fd = os.open(f"/proc/sys/net/{name}", os.O_WRONLY | os.O_CLOEXEC)
    except FileNotFoundError:
        return
    try:
        os.write(fd, value)
    finally:
        os.close(fd)


def configure_vehicle(vehicle: int, index: int) -> list[NetlinkRequest]:
    """Return requests that give a vehicle its address. `index` is the number of its interface `eth0`."""
    where = f"vehicle {vehicle}"
    own = addresses.address(vehicle)
    return [
        set_up(f"{where}: lo", LO),
        set_up(f"{where}: eth0", index),
        address(f"{where}: address {own}", index, own, addresses.PREFIX_LENGTH, addresses.BROADCAST),
        default_route(f"{where}: default route", index),
    ]
