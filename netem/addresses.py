"""Compute the IP address, the MAC address and the switch port name of a vehicle from its ID.

IDs may be 1 to 65535. A /16 network is too small, because ID 65535 would be its broadcast address. The network is
therefore the larger 10.76.0.0/14. A vehicle has the address 10.77.x.y, and the bytes x and y are its ID. The network
and broadcast addresses 10.76.0.0 and 10.79.255.255 belong to no ID.
"""

from __future__ import annotations

MIN_ID = 1
MAX_ID = 0xFFFF

NETWORK = "10.76.0.0"
PREFIX_LENGTH = 14
BROADCAST = "10.79.255.255"


def address(vehicle: int) -> str:
    """Return the IPv4 address of a vehicle, such as 10.77.1.2 for vehicle 258."""
    return f"10.77.{vehicle >> 8}.{vehicle & 0xFF}"


def mac(vehicle: int) -> str:
    """Return the Ethernet address of a vehicle. It is locally administered, and consists of "UCP" in ASCII and the
    ID.
    """
    return f"02:55:43:50:{vehicle >> 8:02x}:{vehicle & 0xFF:02x}"


def port(vehicle: int) -> str:
    """Return the name of the switch port that leads to a vehicle."""
    return f"v{vehicle}"
