"""Read packet captures independently of the harness, so that tests can compare both readings.

scapy reads the packets, and this module reads the other blocks of a file.
"""

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from scapy.utils import RawPcapNgReader

SECTION, STATISTICS = 0x0A0D0D0A, 5
COMMENT, RECEIVED, DROPPED = 1, 4, 5
PAYLOAD_AT = 42  # bytes of the Ethernet, IPv4 and UDP headers


class CapturedFrame(NamedTuple):
    at_ns: int
    outbound: bool
    data: bytes

    @property
    def payload(self) -> bytes:
        """The data of the UDP datagram in the frame."""
        return self.data[PAYLOAD_AT:]


def frames(path: Path) -> list[CapturedFrame]:
    found = []
    with RawPcapNgReader(str(path)) as reader:
        for data, about in reader:
            assert about.tsresol == 1_000_000_000
            assert about.direction in (1, 2)
            assert about.ifname == f"vehicle {path.stem}".encode()
            found.append(CapturedFrame(about.tshigh << 32 | about.tslow, about.direction == 2, data))
    return found


def comment(path: Path) -> dict[str, Any]:
    """Return the comment in the section header of a capture file."""
    found: dict[str, Any] = json.loads(_options(path, SECTION, 16)[COMMENT])
    return found


def statistics(path: Path) -> dict[str, int]:
    options = _options(path, STATISTICS, 12)
    names = {"received": RECEIVED, "dropped": DROPPED}
    return {name: int.from_bytes(options[code], "little") for name, code in names.items()}


def _options(path: Path, kind: int, fixed: int) -> dict[int, bytes]:
    """Return the options of the only block of this kind. In the block, the options follow `fixed` bytes of other
    data.
    """
    (body,) = (body[fixed:] for found, body in _blocks(path.read_bytes()) if found == kind)
    options = {}
    while len(body) >= 4:
        code, length = struct.unpack_from("<HH", body)
        options[code] = body[4 : 4 + length]
        body = body[4 + length + -length % 4 :]
    assert options.popitem() == (0, b"")
    return options


def _blocks(data: bytes) -> Iterator[tuple[int, bytes]]:
    at = 0
    while at < len(data):
        kind, length = struct.unpack_from("<II", data, at)
        assert length % 4 == 0
        assert struct.unpack_from("<I", data, at + length - 4) == (length,)
        yield kind, data[at + 8 : at + length - 4]
        at += length
