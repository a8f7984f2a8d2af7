"""A file of lines that somebody may still be writing, read as far as it goes."""

import os
from collections import deque
from pathlib import Path

from harness.archive.bounded_file import open_plain_file
from harness.archive.traces import MAX_LINE_BYTES

_CHUNK_BYTES = 256 * 1024


class GrowingFile:
    """The whole lines of a file, one after another; one that is not there yet has none so far.

    `trouble` says why there will be no more of it, if that is so.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.trouble: str | None = None
        self._file: int | None = None
        self._lines: deque[bytes] = deque()
        self._begun = b""

    def next(self) -> bytes | None:
        """The next line, its end included; None if it is not written yet."""
        while not self._lines:
            if not self._read():
                return None
        return self._lines.popleft()

    def close(self) -> None:
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def _read(self) -> bool:
        """Whether there was more."""
        if self.trouble is not None:
            return False
        try:
            if self._file is None:
                self._file = open_plain_file(self.path)
            data = os.read(self._file, _CHUNK_BYTES)
        except FileNotFoundError:
            return False
        except OSError as error:
            self.trouble = f"cannot be read: {error.strerror}"
            return False
        if not data:
            return False
        *whole, self._begun = (self._begun + data).split(b"\n")
        self._lines.extend(line + b"\n" for line in whole)
        if len(self._begun) > MAX_LINE_BYTES:
            self.trouble, self._begun = f"has a line of more than {MAX_LINE_BYTES // 1024 // 1024} MiB", b""
        return True
