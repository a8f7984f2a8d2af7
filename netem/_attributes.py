"""Encode and decode netlink attributes (RFC 3549; linux/netlink.h).

The package has its own small codec for speed. For example, a lab of 100 vehicles with different conditions for each
pair of vehicles sends 20,000 requests to set the conditions, and then reads 10,000 answers to check them.
"""

from __future__ import annotations

import struct
import sys

_HEADER = struct.Struct("=HH")
_NESTED = 0x8000
_KIND = 0x3FFF


def attribute(kind: int, payload: bytes) -> bytes:
    return _HEADER.pack(_HEADER.size + len(payload), kind) + payload + bytes(-len(payload) % 4)


def nested(kind: int, *attributes: bytes) -> bytes:
    return attribute(kind | _NESTED, b"".join(attributes))


def number(kind: int, value: int) -> bytes:
    """Return a netlink attribute with a 32-bit number."""
    return attribute(kind, struct.pack("=I", value))


def text(kind: int, value: str) -> bytes:
    return attribute(kind, value.encode() + b"\0")


def parse(data: bytes) -> dict[int, bytes]:
    """Parse netlink attributes. Return their contents by attribute type. If a type occurs twice, the last attribute
    counts.
    """
    payloads = {}
    offset = 0
    while offset + _HEADER.size <= len(data):
        length, kind = _HEADER.unpack_from(data, offset)
        payloads[kind & _KIND] = data[offset + _HEADER.size : offset + length]
        offset += max(_HEADER.size, (length + 3) & ~3)
    return payloads


def parse_number(payload: bytes | None) -> int | None:
    """Return the value of a 32-bit attribute. Return None if the attribute is missing."""
    return None if payload is None else int.from_bytes(payload[:4], sys.byteorder)
