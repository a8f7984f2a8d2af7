"""The telemetry log: every MAVLink frame as received, each behind the time of its arrival.

The format of MAVProxy, Mission Planner and pymavlink (`.tlog`): microseconds since the Unix epoch as a big-endian u64
whose two lowest bits number the link, then the raw frame.
"""

from __future__ import annotations

import contextlib
import struct
from pathlib import Path

_STAMP = struct.Struct(">Q")
_LINK_BITS = 3


class TelemetryLog:
    """Appends to a .tlog: a vehicle that is restarted goes on in the same file. Raises OSError as files do."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("ab")

    def write(self, received_us: int, frame: bytes | bytearray) -> None:
        self._file.write(_STAMP.pack(received_us & ~_LINK_BITS) + frame)

    def flush(self) -> None:
        self._file.flush()

    def close(self) -> None:
        self._file.close()

    def abandon(self) -> None:
        """Close what can no longer be written to."""
        with contextlib.suppress(OSError):
            self._file.close()
