"""Build Ethernet frames with UDP broadcasts and their checksums, exactly as Linux does."""

from __future__ import annotations

import socket
import struct

from netem import addresses

_EVERYONE = bytes.fromhex("ffffffffffff")
_IPV4 = b"\x08\x00"
_IP = struct.Struct("!BBHHHBBH4s4s")
_UDP = struct.Struct("!HHHH")
_DONT_FRAGMENT = 0x4000
_TTL = 64


def checksum(data: bytes) -> int:
    """Return the Internet checksum (RFC 1071). If the checksum is 0, return 0xFFFF, as UDP requires.

    The checksum is a sum of 16-bit words with end-around carry. This sum equals the remainder of a division by 0xFFFF,
    which is faster to compute.
    """
    return 0xFFFF - (int.from_bytes(data, "big") << 8 * (len(data) % 2)) % 0xFFFF


def udp_broadcast(sender: int, port: int, data: bytes) -> bytes:
    """Return the Ethernet frame in which a vehicle broadcasts a datagram. The source port and the destination port are
    both `port`.
    """
    source, everyone = (socket.inet_aton(address) for address in (addresses.address(sender), addresses.BROADCAST))
    length = _UDP.size + len(data)
    pseudo_header = source + everyone + struct.pack("!HH", socket.IPPROTO_UDP, length)
    whole = checksum(pseudo_header + _UDP.pack(port, port, length, 0) + data)
    udp = _UDP.pack(port, port, length, whole)
    fields = (0x45, 0, _IP.size + length, 0, _DONT_FRAGMENT, _TTL, socket.IPPROTO_UDP)
    # The checksum of an IP header may be 0.
    ip = _IP.pack(*fields, checksum(_IP.pack(*fields, 0, source, everyone)) % 0xFFFF, source, everyone)
    return _EVERYONE + bytes.fromhex(addresses.mac(sender).replace(":", "")) + _IPV4 + ip + udp + data
