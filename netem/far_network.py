"""The network of a vehicle on another computer. It has one interface (TAP): a program reads the frames that the vehicle
sends, and writes the frames that the vehicle receives.

The vehicle there has the same address, the same broadcast address and the same interface name `eth0` as a vehicle of a
lab. The interface is not connected to a switch. The program behind it carries datagrams between the interface and a
lab, so a datagram arrives with the source address of the vehicle that sent it. The interface takes datagrams of any
length in one frame, so they are never fragmented.
"""

from __future__ import annotations

import fcntl
import os
import socket
import struct
from collections.abc import Sequence

from netem import _namespaces, addresses
from netem._fabric import LO, configure_vehicle, disable_ipv6
from netem._fabric_requests import mtu, multicast_route, set_up
from netem._netlink import NetlinkSocket
from netem.errors import LabUnavailable
from netem.frames import udp_broadcast

MAX_DATAGRAM = 65_000
"""Maximum size of a datagram in bytes. A larger datagram does not fit into a frame of the interface."""

_DEVICE = "/dev/net/tun"
_INTERFACE = "eth0"
_IFF_TAP, _IFF_NO_PI, _TUNSETIFF = 0x0002, 0x1000, 0x400454CA
_MTU = 65_521
_MAX_FRAME = _MTU + 14
_ETHERNET_BYTES, _UDP_BYTES = 14, 8
_IPV4 = b"\x08\x00"


def first_process(argv: Sequence[str]) -> list[str]:
    """Return the command that starts `argv` as the first process of a private network. Raises the errors of
    `needs_user_namespace`.
    """
    return _namespaces.command(argv, user_namespace=needs_user_namespace())


def needs_user_namespace() -> bool:
    """Return true if a private network needs a user namespace of its own on this machine.

    Raises LabUnavailable if this machine has no private networks, or no TAP interfaces.
    """
    possible, message = _namespaces.probe()
    if not possible:
        raise LabUnavailable(f"This machine does not allow private networks ({message})", _namespaces.way_out(message))
    try:
        os.close(os.open(_DEVICE, os.O_RDWR | os.O_CLOEXEC))
    except OSError as error:
        raise LabUnavailable(
            f"This machine has no TAP interfaces ({_DEVICE}: {error.strerror})",
            "As root: modprobe tun, and chmod 666 /dev/net/tun.",
        ) from None
    return message != _namespaces.AS_ROOT


def become_keeper(*, user_namespace: bool) -> None:
    """Prepare this process, so that it can create networks with `create_network`. The kernel kills this process when
    its parent ends. `user_namespace` is the result of `needs_user_namespace`. The process must have one thread.
    """
    if user_namespace:
        _namespaces.become_root()
    _namespaces.die_with_parent()


def create_network() -> int:
    """Move this process into a new network, and return a file descriptor of the network. Programs in the network reach
    each other at 127.0.0.1. Multicast datagrams stay in the network. Raises OSError or NetlinkError.
    """
    _namespaces.unshare_network()
    netlink = NetlinkSocket()
    netlink.send([set_up("lo", LO), multicast_route("multicast route", LO)])
    netlink.close()
    return _namespaces.open_network()


def become_first_process(network: int) -> None:
    """Enter the network that `create_network` returned. Then fork, and return only in the new process, which is PID 1
    of a new PID namespace. The calling process waits until the new process ends. Each of the two processes ends when
    its parent ends.
    """
    _namespaces.become_first_process(network)


def vehicle_at(address: str) -> int | None:
    """Return the vehicle with this address. Return None if the address belongs to no vehicle."""
    packed = socket.inet_aton(address)
    vehicle = int.from_bytes(packed[2:], "big")
    return vehicle if vehicle and addresses.address(vehicle) == address else None


class FarNetwork:
    """The interface of a vehicle in the network namespace of the calling process."""

    def __init__(self, vehicle: int, port: int) -> None:
        """Create and configure the interface. `port` is the UDP port of the mission. Raises OSError or NetlinkError."""
        self.descriptor = os.open(_DEVICE, os.O_RDWR | os.O_CLOEXEC | os.O_NONBLOCK)
        request = struct.pack("16sH22x", _INTERFACE.encode(), _IFF_TAP | _IFF_NO_PI)
        fcntl.ioctl(self.descriptor, _TUNSETIFF, request)
        self._port = port
        disable_ipv6()
        index = socket.if_nametoindex(_INTERFACE)
        netlink = NetlinkSocket()
        netlink.send([mtu(_INTERFACE, index, _MTU), *configure_vehicle(vehicle, index)])
        netlink.close()

    def read(self) -> bytes | None:
        """Return the next datagram that a program sent to the mission's port. Return None for any other frame.

        Raises BlockingIOError if no frame waits.
        """
        frame = os.read(self.descriptor, _MAX_FRAME)
        header = frame[_ETHERNET_BYTES : _ETHERNET_BYTES + 20]
        if frame[12:14] != _IPV4 or len(header) < 20 or header[0] >> 4 != 4 or header[9] != socket.IPPROTO_UDP:
            return None
        begin = _ETHERNET_BYTES + 4 * (header[0] & 0xF)
        udp = frame[begin : begin + _UDP_BYTES]
        if len(udp) < _UDP_BYTES or int.from_bytes(udp[2:4], "big") != self._port:
            return None
        return frame[begin + _UDP_BYTES : begin + int.from_bytes(udp[4:6], "big")]

    def write(self, sender: int, data: bytes) -> None:
        """Deliver a datagram of another vehicle to the programs of this vehicle. Raises OSError."""
        os.write(self.descriptor, udp_broadcast(sender, self._port, data))
