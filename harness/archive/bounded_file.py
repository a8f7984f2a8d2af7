"""Opens a file that came from anywhere: a file and nothing else, unpacked if gzip packed it, up to a bound."""

import errno
import io
import os
import stat
import zlib
from pathlib import Path
from typing import Any

GZIP_MAGIC = b"\x1f\x8b"
MAX_BYTES = 1024 * 1024 * 1024
_CHUNK_BYTES = 256 * 1024


class Opened(io.BufferedReader):
    """The content, from its beginning. `trouble` says, once it was read to its end, why there is no more."""

    def __init__(self, path: Path, most_bytes: int = MAX_BYTES) -> None:
        """Raises OSError if there is no such file, it may not be read, or is a fifo, a device or a socket."""
        self._content = _Content(path, most_bytes)
        super().__init__(self._content, _CHUNK_BYTES)

    @property
    def packed(self) -> bool:
        """Whether gzip packed the file."""
        return self._content.packed

    @property
    def trouble(self) -> str:
        return self._content.trouble


class _Content(io.RawIOBase):
    def __init__(self, path: Path, most_bytes: int) -> None:
        self.trouble = ""
        self._left = self._most = most_bytes
        self._file = open(open_plain_file(path), "rb", buffering=0)  # noqa: SIM115
        self.packed = self._file.read(2) == GZIP_MAGIC
        self._file.seek(0)
        self._unpacker = _unpacker()
        self._input = b""

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any, /) -> int:
        most = min(len(buffer), self._left)
        if not most:
            if self._next(1):
                self.trouble = f"what is beyond {self._most // 1024 // 1024} MiB is not read"
                self.packed, self._input = False, b""
                self._file.seek(0, os.SEEK_END)
            return 0
        data = self._next(most)
        buffer[: len(data)] = data
        self._left -= len(data)
        return len(data)

    def close(self) -> None:
        if not self.closed:
            self._file.close()
        super().close()

    def _next(self, most: int) -> bytes:
        """Up to so many bytes; none at the end."""
        return self._unpacked(most) if self.packed else self._file.read(most)

    def _unpacked(self, most: int) -> bytes:
        while not self.trouble:
            if self._unpacker.eof:
                self._input = self._unpacker.unused_data.lstrip(b"\0") or self._file.read(_CHUNK_BYTES).lstrip(b"\0")
                if not self._input:
                    break
                self._unpacker = _unpacker()
            self._input = self._input or self._file.read(_CHUNK_BYTES)
            if not self._input:
                self.trouble = "what gzip packed breaks off"
                break
            try:
                data: bytes = self._unpacker.decompress(self._input, most)
            except zlib.error:
                self.trouble = "what gzip packed is damaged"
                break
            self._input = self._unpacker.unconsumed_tail
            if data:
                return data
        return b""


def open_plain_file(path: Path) -> int:
    """A descriptor to read the file by. Raises OSError if there is none, it may not be read, or is none (a fifo)."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)  # a fifo would wait for its writer
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        is_directory = stat.S_ISDIR(os.fstat(descriptor).st_mode)
        os.close(descriptor)
        raise OSError(errno.EISDIR, "is a directory") if is_directory else OSError(errno.EINVAL, "is not a file")
    return descriptor


def _unpacker() -> Any:
    return zlib.decompressobj(wbits=16 + zlib.MAX_WBITS)
