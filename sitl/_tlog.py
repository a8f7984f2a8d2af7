"""Write the telemetry log. For each received MAVLink frame, the log contains the time of arrival, followed by the
frame.

The format is that of MAVProxy, Mission Planner and pymavlink (`.tlog`). The time is a big-endian u64 in microseconds
since the Unix epoch. The number of the link replaces the two lowest bits of the time.
"""

from __future__ import annotations

import contextlib
import struct
from pathlib import Path

_STAMP = struct.Struct(">Q")
_LINK_BITS = 3


class TelemetryLog:
    """A .tlog file to which frames are appended. A restarted vehicle continues the same file. Methods raise OSError."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("ab")

    def write(self, received_us: int, frame: bytes | bytearray) -> None:
        self._file.write(_STAMP.pack(received_us & ~_LINK_BITS) + frame)

    def flush(self) -> None:
        self._file.flush()

    def close(self) -> None:
        self._file.close()

    def abandon(self) -> None:
        """Close the file after a write error."""
        with contextlib.suppress(OSError):
            self._file.close()
