"""Who is who on the air: a vehicle's ID gives its address, its MAC and its port, and nothing is stored.

IDs are free in 1..65535, one more than a /16 has room for: ID 65535 would be its broadcast address.
So the ID is written out in the last two bytes of 10.77.x.y, and the network is the wider
10.76.0.0/14, whose network and broadcast addresses (10.76.0.0, 10.79.255.255) no ID can reach.
"""

from __future__ import annotations

MIN_ID = 1
MAX_ID = 0xFFFF

NETWORK = "10.76.0.0"
PREFIX_LENGTH = 14
BROADCAST = "10.79.255.255"


def address(vehicle: int) -> str:
    """IPv4 address of a vehicle: 258 is 10.77.1.2."""
    return f"10.77.{vehicle >> 8}.{vehicle & 0xFF}"


def mac(vehicle: int) -> str:
    """Ethernet address of a vehicle: locally administered, "UCP" in ASCII, then the ID."""
    return f"02:55:43:50:{vehicle >> 8:02x}:{vehicle & 0xFF:02x}"


def port(vehicle: int) -> str:
    """Name of the switch port that leads to a vehicle."""
    return f"v{vehicle}"
