"""Build the netlink requests for the links, addresses and routes of the virtual network.

Messages and numbers come from linux/rtnetlink.h, if_link.h, if_addr.h and veth.h. See rtnetlink(7).
"""

from __future__ import annotations

import socket
import struct

from netem._attributes import attribute, nested, number, parse, text
from netem._netlink import (
    NEW,
    RTM_GETLINK,
    RTM_NEWADDR,
    RTM_NEWLINK,
    RTM_NEWROUTE,
    RTM_SETLINK,
    NetlinkRequest,
    NetlinkSocket,
)

_IFINFOMSG = struct.Struct("=BxHiII")  # family, type, index, flags, mask of changed flags
_IFADDRMSG = struct.Struct("=4BI")  # family, prefix length, flags, scope, index
_RTMSG = struct.Struct("=8BI")  # family, two prefix lengths, TOS, table, protocol, scope, type, flags

_IFF_UP = 1
_IFLA_ADDRESS, _IFLA_IFNAME, _IFLA_MTU, _IFLA_MASTER, _IFLA_PROTINFO, _IFLA_LINKINFO = 1, 3, 4, 10, 12, 18
_IFLA_NET_NS_FD = 28
_IFLA_INFO_KIND, _IFLA_INFO_DATA = 1, 2
_IFLA_BR_FORWARD_DELAY, _IFLA_BR_STP_STATE, _IFLA_BR_MCAST_SNOOPING = 1, 5, 23
_IFLA_BRPORT_STATE, _BR_STATE_FORWARDING = 1, 3
_IFLA_BRPORT_BCAST_FLOOD = 30
_VETH_INFO_PEER = 1
_IFA_ADDRESS, _IFA_LOCAL, _IFA_BROADCAST = 1, 2, 4
_RTA_DST, _RTA_OIF = 1, 4
_RT_TABLE_MAIN, _RTPROT_STATIC, _RT_SCOPE_LINK, _RTN_UNICAST = 254, 4, 253, 1


def set_up(what: str, index: int) -> NetlinkRequest:
    return NetlinkRequest(what, RTM_NEWLINK, _IFINFOMSG.pack(0, 0, index, _IFF_UP, _IFF_UP))


def mtu(what: str, index: int, most_bytes: int) -> NetlinkRequest:
    """Return a request that sets the maximum packet size of a link in bytes."""
    return NetlinkRequest(
        f"{what}: MTU", RTM_NEWLINK, _IFINFOMSG.pack(0, 0, index, 0, 0) + number(_IFLA_MTU, most_bytes)
    )


def bridge(name: str, index: int) -> NetlinkRequest:
    """Return a request that creates and activates a bridge.

    Without spanning tree and forward delay, ports forward packets immediately. Without multicast snooping, multicast
    reaches all vehicles, as it does by radio.
    """
    settings = (
        number(_IFLA_BR_STP_STATE, 0),
        number(_IFLA_BR_FORWARD_DELAY, 0),
        attribute(_IFLA_BR_MCAST_SNOOPING, bytes(1)),
    )
    return _link(f"create bridge {name}", index, name, _of_kind("bridge", *settings))


def veth_pair(
    name: str, index: int, bridge: int, *, far_name: str, far_index: int, mac: str, network: int
) -> NetlinkRequest:
    """Return a request that creates a cable from the bridge to another network namespace. The near end becomes an
    active port of the bridge. `network` is a file descriptor of the other namespace. `mac` is the Ethernet address of
    the cable's end in that namespace.
    """
    far_end = (
        _IFINFOMSG.pack(0, 0, far_index, 0, 0),
        text(_IFLA_IFNAME, far_name),
        attribute(_IFLA_ADDRESS, bytes.fromhex(mac.replace(":", ""))),
        number(_IFLA_NET_NS_FD, network),
    )
    kind = _of_kind("veth", nested(_VETH_INFO_PEER, *far_end))
    return _link(f"create veth pair {name}", index, name, number(_IFLA_MASTER, bridge), kind)


def address(what: str, index: int, own: str, prefix_length: int, broadcast: str) -> NetlinkRequest:
    """Return a request that gives a link an IPv4 address."""
    attributes = [
        attribute(kind, socket.inet_aton(each))
        for kind, each in ((_IFA_LOCAL, own), (_IFA_ADDRESS, own), (_IFA_BROADCAST, broadcast))
    ]
    message = _IFADDRMSG.pack(socket.AF_INET, prefix_length, 0, 0, index)
    return NetlinkRequest(what, RTM_NEWADDR, message + b"".join(attributes), NEW)


def default_route(what: str, index: int) -> NetlinkRequest:
    """Return a request that adds a default route without a gateway. With this route, the kernel treats all addresses as
    neighbours on this link.
    """
    return _route(what, 0, number(_RTA_OIF, index))


def multicast_route(what: str, index: int) -> NetlinkRequest:
    """Return a request that adds a route for all multicast addresses."""
    return _route(what, 4, attribute(_RTA_DST, socket.inet_aton("224.0.0.0")) + number(_RTA_OIF, index))


def _route(what: str, prefix_length: int, attributes: bytes) -> NetlinkRequest:
    kind = (_RT_TABLE_MAIN, _RTPROT_STATIC, _RT_SCOPE_LINK, _RTN_UNICAST)
    message = _RTMSG.pack(socket.AF_INET, prefix_length, 0, 0, *kind, 0)
    return NetlinkRequest(what, RTM_NEWROUTE, message + attributes, NEW)


def forwarding(netlink: NetlinkSocket) -> set[int]:
    """Return the interface numbers of the ports through which the bridge forwards packets."""
    ports = netlink.dump("list the ports of the bridge", RTM_GETLINK, _IFINFOMSG.pack(socket.AF_BRIDGE, 0, 0, 0, 0))
    return {_IFINFOMSG.unpack_from(port)[2] for port in ports if _forwards(port)}


def _forwards(port: bytes) -> bool:
    of_bridge = parse(parse(port[_IFINFOMSG.size :]).get(_IFLA_PROTINFO, b""))
    return of_bridge.get(_IFLA_BRPORT_STATE) == bytes([_BR_STATE_FORWARDING])


def flood_broadcasts(port: str, index: int, on: bool) -> NetlinkRequest:
    """Return a request that switches the flooding of broadcasts to one port on or off. While flooding is off, the
    bridge does not forward broadcasts to this port.
    """
    flag = nested(_IFLA_PROTINFO, attribute(_IFLA_BRPORT_BCAST_FLOOD, bytes([on])))
    return NetlinkRequest(
        f"set bcast_flood of {port}", RTM_SETLINK, _IFINFOMSG.pack(socket.AF_BRIDGE, 0, index, 0, 0) + flag
    )


def _link(what: str, index: int, name: str, *attributes: bytes) -> NetlinkRequest:
    message = _IFINFOMSG.pack(0, 0, index, _IFF_UP, _IFF_UP) + text(_IFLA_IFNAME, name)
    return NetlinkRequest(what, RTM_NEWLINK, message + b"".join(attributes), NEW)


def _of_kind(kind: str, *data: bytes) -> bytes:
    return nested(_IFLA_LINKINFO, text(_IFLA_INFO_KIND, kind), nested(_IFLA_INFO_DATA, *data))
