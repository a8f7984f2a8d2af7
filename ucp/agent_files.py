"""Write the files of an agent. Each write of the chain export replaces the whole file. The trace and the log grow line
by line.
"""

import contextlib
import errno
import json
import os
import time
from pathlib import Path
from typing import Any, BinaryIO

CHUNK_BYTES = 64 * 1024
RESERVED_BYTES = 1024 * 1024
"""Number of bytes of disk space reserved for the chain export. They are enough for about 700 blocks."""
KEPT_FREE_SHARE = 0.1
"""Share of the file system that traces and logs leave free for stores and chain exports."""
MAX_KEPT_FREE_BYTES = 16 * 1024 * 1024


def write_json_atomically(path: Path, document: dict[str, Any]) -> None:
    """Replace the content of a file by a JSON document, completely or not at all. Raises OSError."""
    write_atomically(path, json.dumps(document, indent=1) + "\n")


def write_atomically(path: Path, text: str) -> None:
    """Replace the content of `path` completely or not at all. Raises OSError, for example if the disk is full. A lone
    surrogate in the text becomes a question mark, because JSON allows it but UTF-8 does not.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("w", encoding="utf-8", errors="replace") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise


class ReservedSpace:
    """Disk space that is reserved for the chain export, so that no other file can use it. A file without a name
    occupies this space. The operating system frees the space when the process ends.
    """

    def __init__(self, directory: Path) -> None:
        self._descriptor: int | None = None
        with contextlib.suppress(OSError):  # the disk is full, or its file system cannot do this
            self._descriptor = os.open(directory, os.O_TMPFILE | os.O_WRONLY | os.O_CLOEXEC, 0o600)
            os.posix_fallocate(self._descriptor, 0, RESERVED_BYTES)

    def release(self) -> bool:
        """Release the reserved space. Return false if it was already released."""
        if self._descriptor is None:
            return False
        os.close(self._descriptor)
        self._descriptor = None
        return True


class LogFile:
    """A log file for human readers. A line that cannot be written is lost."""

    def __init__(self, path: Path) -> None:
        self._file: BinaryIO = path.open("ab", buffering=0)

    def write_line(self, sentence: str) -> None:
        now = time.time()
        at = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(now))
        with contextlib.suppress(OSError):
            leave_space(self._file)
            self._file.write(f"{at},{int(now % 1 * 1000):03d} {sentence}\n".encode(errors="replace"))

    def close(self) -> None:
        self._file.close()


class TraceFile:
    """A trace file. It contains only complete lines. If a line cannot be written, the trace ends before this line.

    An incomplete last line of an earlier incarnation is removed. `problem` is the reason why the trace ends. It
    distinguishes a trace that ended early from an agent that became silent.
    """

    def __init__(self, path: Path) -> None:
        self.problem: str | None = None
        self._file: BinaryIO = path.open("a+b", buffering=0)
        end = end_of_last_line(self._file)
        if self._file.seek(0, os.SEEK_END) > end:
            self._file.truncate(end)
            self._file.seek(end)

    def write(self, lines: str) -> None:
        if self.problem is not None or not lines:
            return
        data = lines.encode("ascii")
        end = self._file.tell()
        try:
            leave_space(self._file)
            while data:
                data = data[self._file.write(data) :]  # the call after a partial one raises the reason
            return
        except OSError as error:
            self.problem = error.strerror or str(error)
        with contextlib.suppress(OSError):
            self._file.truncate(end)

    def close(self) -> None:
        self._file.close()


def leave_space(file: BinaryIO) -> None:
    """Raise OSError if the free space of the file system is only enough for stores and chain exports."""
    system = os.fstatvfs(file.fileno())
    if system.f_bavail * system.f_frsize < min(
        MAX_KEPT_FREE_BYTES, system.f_blocks * system.f_frsize * KEPT_FREE_SHARE
    ):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def end_of_last_line(file: BinaryIO) -> int:
    """Return the number of bytes from the beginning of the file to the end of its last complete line. Return 0 if no
    line is complete.
    """
    end = file.seek(0, os.SEEK_END)
    while end:
        begin = max(0, end - CHUNK_BYTES)
        file.seek(begin)
        newline = file.read(end - begin).rfind(b"\n")
        if newline >= 0:
            return begin + newline + 1
        end = begin
    return 0
