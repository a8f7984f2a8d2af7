"""Parse the address of a ground station, and open a socket to it."""

from __future__ import annotations

import ipaddress
import socket
from dataclasses import dataclass
from typing import Self

from sitl.vehicle import VehicleError


@dataclass(frozen=True)
class ListenAddress:
    """The address at which a ground station listens."""

    host: str
    port: int

    @classmethod
    def parse(cls, text: str) -> Self:
        """Parse HOST:PORT, or [HOST]:PORT for IPv6. Raises VehicleError."""
        host, _, port = text.rpartition(":")
        bracketed = host.startswith("[") and host.endswith("]")
        host = host[1:-1] if bracketed else host
        odd = ":" in host and not bracketed  # without brackets, the beginning of the port is ambiguous
        if not host or odd or bracketed != _is_ipv6(host) or not (port.isascii() and port.isdigit()):
            raise VehicleError(f"a ground station is HOST:PORT, for example 127.0.0.1:14550, not {text!r:.80}")
        if len(host) > 253 or any(not letter.isprintable() or letter.isspace() for letter in host):
            raise VehicleError(f"{host!r:.80} is not a host: name a host, for example 127.0.0.1:14550")
        if not 1 <= int(port[:6]) <= 65535:
            raise VehicleError(f"a ground station's port is 1 to 65535, usually 14550, not {port:.20}")
        return cls(host, int(port))

    def __str__(self) -> str:
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


def connected(address: ListenAddress) -> socket.socket:
    """Return a UDP socket that is connected to this address. The function sends nothing. Raises VehicleError if the
    address cannot be reached.

    If a host name has IPv4 and IPv6 addresses, the IPv4 address is used, because ground stations listen on it.
    """
    try:
        ways = socket.getaddrinfo(address.host, address.port, type=socket.SOCK_DGRAM)
        family, kind, protocol, _, place = min(ways, key=lambda way: way[0] != socket.AF_INET)
        sock = socket.socket(family, kind, protocol)
        try:
            sock.connect(place)
        except OSError:
            sock.close()
            raise
    except (OSError, UnicodeError) as error:
        raise _no_way_to(address, error) from None
    return sock


def _no_way_to(address: ListenAddress, error: OSError | UnicodeError) -> VehicleError:
    """Return the error for an unreachable address."""
    reason = "it is not a valid name" if isinstance(error, UnicodeError) else error.strerror or str(error)
    return VehicleError(
        f"datagrams to the ground station at {address} cannot be sent ({reason}): name an address that this machine "
        "can reach, for example 127.0.0.1:14550"
    )


def _is_ipv6(host: str) -> bool:
    try:
        return ipaddress.ip_address(host.partition("%")[0]).version == 6
    except ValueError:
        return False
