"""Store all changes for the live page in a log. Any number of browsers can read the log, each at its own speed.

The log is an unnamed temporary file. Memory use is therefore bounded, and a slow reader does not delay the others.
"""

import json
import os
import tempfile
from collections.abc import Iterable
from functools import partial

from harness.report.live._agent_course import Change

MAX_BYTES = 512 * 1024 * 1024
CHUNK_BYTES = 256 * 1024
FAR_BEHIND_BYTES = 4 * 1024 * 1024
"""If a live reader is behind by more than this number of bytes, it skips frequent changes, such as messages and
positions, to catch up.
"""
_LEFT_OUT = (b'["m"', b'["p"', b'["t"', b'["d"')

_encode = partial(json.dumps, separators=(",", ":"), check_circular=False)


class ChangeLog:
    """A log with one change per line. `size` is its size in bytes."""

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile()  # noqa: SIM115
        self.size = 0
        self._full = False

    def append(self, changes: Iterable[Change]) -> None:
        """Append changes to the log. Raises OSError if the disk is full."""
        lines = "".join([_encode(change) + "\n" for change in changes]).encode()
        if self._full or not lines:
            return
        if self.size + len(lines) > MAX_BYTES:
            self._full = True
            note = f"the page shows only the first {MAX_BYTES >> 20} MiB of changes"
            lines = (_encode(["note", note]) + "\n").encode()
        self._file.write(lines)
        self._file.flush()
        self.size += len(lines)

    def read(self, start: int, *, may_skip: bool = False) -> tuple[int, str]:
        """Return a pair: the position after the returned lines, and the complete lines that follow the position
        `start`.

        If `may_skip` is true and the reader is far behind, frequent changes such as messages and positions are omitted.
        """
        skips = may_skip and self.size - start > FAR_BEHIND_BYTES
        data = self._pread(start, FAR_BEHIND_BYTES if skips else CHUNK_BYTES)
        while b"\n" not in data and start + len(data) < self.size:
            data += self._pread(start + len(data), CHUNK_BYTES)
        whole = data[: data.rfind(b"\n") + 1]
        end = start + len(whole)
        if skips:
            whole = b"".join(line for line in whole.splitlines(keepends=True) if not line.startswith(_LEFT_OUT))
        return end, whole.decode()

    def close(self) -> None:
        self._file.close()

    def _pread(self, start: int, most: int) -> bytes:
        return os.pread(self._file.fileno(), min(most, self.size - start), start)
