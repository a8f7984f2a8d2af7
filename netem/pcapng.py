"""Write packet captures of one Ethernet interface in the pcapng format (draft-ietf-opsawg-pcapng).

The writer only appends, and the file is valid after each `flush`. A crash of the writer therefore loses only unwritten
packets.
"""

from __future__ import annotations

import os
import struct
from pathlib import Path

WRITER = "ucp-harness"

_SECTION, _INTERFACE, _STATISTICS, _PACKET = 0x0A0D0D0A, 1, 5, 6
_BYTE_ORDER_MAGIC = 0x1A2B3C4D
_UNKNOWN_LENGTH = -1
_ETHERNET = 1
_ANY_LENGTH = 0
_INBOUND, _OUTBOUND = 1, 2  # values of epb_flags
_AT_ONCE = 1 << 20  # maximum number of waiting bytes

_COMMENT, _USERAPPL = 1, 4
_IF_NAME, _IF_TSRESOL = 2, 9
_NANOSECONDS = b"\x09"
_EPB_FLAGS = 2
_ISB_IFRECV, _ISB_IFDROP = 4, 5

_PACKET_HEAD = struct.Struct("<IIIIIII")
_BLOCK_LENGTH = struct.Struct("<I")


def _option(code: int, value: bytes) -> bytes:
    return struct.pack("<HH", code, len(value)) + value + bytes(-len(value) % 4)


_END_OF_OPTIONS = _option(0, b"")
_DIRECTIONS = {
    outbound: _option(_EPB_FLAGS, struct.pack("<I", flag)) + _END_OF_OPTIONS
    for outbound, flag in ((False, _INBOUND), (True, _OUTBOUND))
}
_PACKET_BYTES = _PACKET_HEAD.size + len(_DIRECTIONS[True]) + _BLOCK_LENGTH.size  # without the frame and its padding


def header(interface: str, comment: str) -> bytes:
    """Return the beginning of a pcapng file: a section with this comment, and a description of the only interface."""
    section = struct.pack("<IHHq", _BYTE_ORDER_MAGIC, 1, 0, _UNKNOWN_LENGTH)
    about = _option(_COMMENT, comment.encode()) + _option(_USERAPPL, WRITER.encode())
    named = _option(_IF_NAME, interface.encode()) + _option(_IF_TSRESOL, _NANOSECONDS)
    link = struct.pack("<HHI", _ETHERNET, 0, _ANY_LENGTH)
    return _block(_SECTION, section + about + _END_OF_OPTIONS) + _block(_INTERFACE, link + named + _END_OF_OPTIONS)


def _block(kind: int, body: bytes) -> bytes:
    length = _BLOCK_LENGTH.pack(12 + len(body))
    return struct.pack("<I", kind) + length + body + length


class PcapngFile:
    """A pcapng file to which frames are appended. Times are nanoseconds since the Unix epoch.

    `packet`, `flush` and `close` raise OSError with the file's name if writing fails. The file then ends with the last
    complete packet, and waiting packets are lost.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = path.open("ab", buffering=0)
        self._pending: list[bytes] = []
        self._pending_bytes = 0
        self.packets = 0

    def packet(self, at_ns: int, frame: bytes, *, outbound: bool) -> None:
        """Append a frame. `outbound` is true if the vehicle sent the frame, and false if the frame arrived at its
        interface.
        """
        captured = len(frame)
        padding = -captured % 4
        length = _PACKET_BYTES + captured + padding
        head = _PACKET_HEAD.pack(_PACKET, length, 0, at_ns >> 32, at_ns & 0xFFFFFFFF, captured, captured)
        self.packets += 1
        self._append(b"".join((head, frame, bytes(padding), _DIRECTIONS[outbound], _BLOCK_LENGTH.pack(length))))

    def statistics(self, at_ns: int, received: int, dropped: int) -> None:
        """Append two counts: the frames that crossed the interface, and the frames among them that are missing in this
        file.
        """
        counts = _option(_ISB_IFRECV, struct.pack("<Q", received)) + _option(_ISB_IFDROP, struct.pack("<Q", dropped))
        at = struct.pack("<III", 0, at_ns >> 32, at_ns & 0xFFFFFFFF)
        self._append(_block(_STATISTICS, at + counts + _END_OF_OPTIONS))

    def _append(self, block: bytes) -> None:
        self._pending.append(block)
        self._pending_bytes += len(block)
        if self._pending_bytes >= _AT_ONCE:
            self.flush()

    def flush(self) -> None:
        """Write all blocks that wait in memory to the file. If writing fails, write none of these blocks."""
        if not self._pending:
            return
        data = memoryview(b"".join(self._pending))
        self._pending, self._pending_bytes = [], 0
        before = os.fstat(self._file.fileno()).st_size
        try:
            while data:
                data = data[self._file.write(data) :]
        except OSError as error:
            self._file.truncate(before)
            raise OSError(error.errno, error.strerror, str(self._path)) from None

    def close(self) -> None:
        try:
            self.flush()
        finally:
            self._file.close()
