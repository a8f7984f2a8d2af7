"""Read packet capture files frame by frame, in the formats pcapng and pcap with any byte order. The files may come from
any source.

The package scapy is not used to read these files. The reader of scapy ignores the comment and the statistics of a
section, does not report where a file is damaged, and does not limit the lengths in a file. Formats:
draft-ietf-opsawg-pcapng, draft-ietf-opsawg-pcap.
"""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from harness.archive.bounded_file import BoundedFile
from harness.errors import CaptureError

INBOUND, OUTBOUND = 1, 2
"""Directions of a frame, as in the flags of pcapng. The direction 0 is unknown."""

MAX_BLOCK_BYTES = 1024 * 1024
"""Maximum size of a block in bytes. It is four times the longest frame that tcpdump captures."""
MAX_INTERFACES = 1024

_SECTION, _INTERFACE, _STATISTICS, _PACKET = b"\x0a\x0d\x0d\x0a", 1, 5, 6
_ORDERS = {b"\x1a\x2b\x3c\x4d": ">", b"\x4d\x3c\x2b\x1a": "<"}
_COMMENT, _FLAGS, _RESOLUTION, _OFFSET = 1, 2, 9, 14
_STARTED, _ENDED, _DROPPED = 2, 3, 5
_PCAP = {  # magic -> byte order, nanoseconds in a unit of the fraction
    b"\xa1\xb2\xc3\xd4": (">", 1000),
    b"\xd4\xc3\xb2\xa1": ("<", 1000),
    b"\xa1\xb2\x3c\x4d": (">", 1),
    b"\x4d\x3c\xb2\xa1": ("<", 1),
}
PCAPNG_MAGIC = _SECTION
MAGICS = (_SECTION, *_PCAP)
"""The possible first bytes of capture files."""


class Frame(NamedTuple):
    """A network frame in a packet capture file.

    `time_ns` counts from the Unix epoch. `length` is the length on the wire. `data` is shorter if the frame was
    truncated.
    """

    time_ns: int
    direction: int
    link_type: int
    data: bytes
    length: int


class _CaptureInterface(NamedTuple):
    link_type: int
    units_per_second: int
    offset_ns: int

    def time_ns(self, units: int) -> int:
        return units * 1_000_000_000 // self.units_per_second + self.offset_ns


class _BrokenCaptureError(Exception):
    """An error: the rest of the packet capture file cannot be read."""


class CaptureFile:
    """A packet capture file. Iterate over the object to read its frames. The iteration also sets the attributes.

    `comment` is the comment of the first section. `started_ns`, `ended_ns` and `dropped` (the number of frames that the
    capture missed) come from the statistics of the file, and are None without them. If reading ended early, `problem`
    describes the place.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.comment: bytes | None = None
        self.started_ns: int | None = None
        self.ended_ns: int | None = None
        self.problem = ""
        self._dropped: dict[int, int] = {}

    @property
    def dropped(self) -> int | None:
        return sum(self._dropped.values()) if self._dropped else None

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames. Raises CaptureError if the file cannot be read or is not a packet capture."""
        try:
            with BoundedFile(self.path) as file:
                magic = file.peek(4)[:4]
                if not magic:
                    why = file.problem or "the capture ended before it began"
                    raise CaptureError(f"{self.path}: empty: {why}")
                if magic not in MAGICS:
                    raise CaptureError(
                        f"{self.path}: not a pcapng or pcap file; `ucp-harness run --capture` and `tcpdump -w` write "
                        "such files"
                    )
                broken = ""
                try:
                    yield from self._pcapng(file) if magic == _SECTION else self._pcap(file, *_PCAP[magic])
                except _BrokenCaptureError as error:
                    broken = str(error)
                if file.problem or broken:
                    self.problem = f"{file.problem or broken}; the part before is read"
        except OSError as error:
            raise CaptureError(f"{self.path}: cannot be read: {error.strerror}") from None

    def _pcap(self, file: BinaryIO, order: str, fraction_ns: int) -> Iterator[Frame]:
        head = _read(file, 24, 0)
        (network,) = struct.unpack_from(order + "I", head, 20)
        record, offset = struct.Struct(order + "4I"), 24
        while packed := file.read(record.size):
            if len(packed) < record.size:
                raise _breaks_off(offset)
            seconds, fraction, captured, length = record.unpack(packed)
            if captured > MAX_BLOCK_BYTES:
                raise _damaged(offset)
            data = _read(file, captured, offset)
            offset += record.size + captured
            yield Frame(seconds * 1_000_000_000 + fraction * fraction_ns, 0, network & 0xFFFF, data, length)

    def _pcapng(self, file: BinaryIO) -> Iterator[Frame]:
        interfaces: list[_CaptureInterface] = []
        packet = struct.Struct("<5I")
        for offset, order, kind, body in _blocks(file):
            try:
                if kind == _PACKET:
                    number, high, low, captured, length = packet.unpack_from(body)
                    end = packet.size + captured
                    if end > len(body):
                        raise _damaged(offset)
                    interface = interfaces[number]
                    direction = _direction(order, body[end + -captured % 4 :])
                    data = body[packet.size : end]
                    yield Frame(interface.time_ns(high << 32 | low), direction, interface.link_type, data, length)
                elif kind == _INTERFACE:
                    interfaces.append(_interface(order, body))
                    if len(interfaces) > MAX_INTERFACES:
                        raise _damaged(offset)
                elif kind == _STATISTICS:
                    self._statistics(order, body, interfaces)
                elif kind == int.from_bytes(_SECTION, "big"):
                    packet = struct.Struct(order + "5I")
                    interfaces.clear()
                    if self.comment is None:
                        self.comment = _options(order, body[16:]).get(_COMMENT)
            except (struct.error, IndexError):
                raise _damaged(offset) from None

    def _statistics(self, order: str, body: bytes, interfaces: list[_CaptureInterface]) -> None:
        number, high, low = struct.unpack_from(order + "3I", body)
        interface, options = interfaces[number], _options(order, body[12:])
        ended = _halves(order, options[_ENDED]) if _ENDED in options else high << 32 | low
        self.ended_ns = max(self.ended_ns or 0, interface.time_ns(ended))
        if _STARTED in options:
            self.started_ns = interface.time_ns(_halves(order, options[_STARTED]))
        if _DROPPED in options:
            (self._dropped[number],) = struct.unpack(order + "Q", options[_DROPPED])


def _blocks(file: BinaryIO) -> Iterator[tuple[int, str, int, bytes]]:
    """Yield (offset in the file, byte order, type, body) for each pcapng block."""
    offset, order = 0, "<"
    lengths = struct.Struct("<2I")
    while head := file.read(8):
        if len(head) < 8:
            raise _breaks_off(offset)
        begun = b""
        if head[:4] == _SECTION:
            begun = _read(file, 4, offset)
            if begun not in _ORDERS:
                raise _damaged(offset)
            order = _ORDERS[begun]
            lengths = struct.Struct(order + "2I")
        kind, length = lengths.unpack(head)
        if length % 4 or not 12 + len(begun) <= length <= MAX_BLOCK_BYTES:
            raise _damaged(offset)
        rest = _read(file, length - 8 - len(begun), offset)
        if rest[-4:] != head[4:]:
            raise _damaged(offset)
        yield offset, order, kind, begun + rest[:-4]
        offset += length


def _interface(order: str, body: bytes) -> _CaptureInterface:
    (link_type,) = struct.unpack_from(order + "H", body)
    options = _options(order, body[8:])
    exponent = options.get(_RESOLUTION, b"\x06")[0]
    resolution: int = 2 ** (exponent & 127) if exponent & 128 else 10**exponent
    (offset_s,) = struct.unpack(order + "q", options.get(_OFFSET, bytes(8)))
    return _CaptureInterface(link_type, resolution, offset_s * 1_000_000_000)


def _direction(order: str, options: bytes) -> int:
    flags = _options(order, options).get(_FLAGS, bytes(4)) if options else bytes(4)
    return int(struct.unpack(order + "I", flags)[0]) & 3


def _halves(order: str, value: bytes) -> int:
    high, low = struct.unpack(order + "2I", value)
    return int(high << 32 | low)


def _options(order: str, data: bytes) -> dict[int, bytes]:
    """Return the options of a block in a pcapng file, by option code. If a code occurs several times, the first option
    is used.
    """
    options: dict[int, bytes] = {}
    position, head = 0, struct.Struct(order + "2H")
    while position + head.size <= len(data):
        code, length = head.unpack_from(data, position)
        if code == 0:
            break
        position += head.size
        options.setdefault(code, data[position : position + length])
        position += length + -length % 4
    return options


def _read(file: BinaryIO, count: int, offset: int) -> bytes:
    data = file.read(count)
    if len(data) < count:
        raise _breaks_off(offset)
    return data


def _breaks_off(offset: int) -> _BrokenCaptureError:
    return _BrokenCaptureError(f"ends within the block that starts at byte {offset}")


def _damaged(offset: int) -> _BrokenCaptureError:
    return _BrokenCaptureError(f"is damaged at byte {offset}")
