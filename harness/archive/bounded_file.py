"""Read files of unknown origin with a size limit: whole files, or JSON Lines one line at a time.

A file may come from another person or another machine. It may be damaged, compressed, endless, or not a regular file.
The readers in this package therefore limit the number of bytes that they read, and report each problem as a sentence
instead of an exception.

The module also packs the parts of a file that another process still appends to, and frees their disk space. A packed
part is appended to the gzip file `NAME.gz`. In the file `NAME`, a hole replaces the part. The hole leaves the size of
the file and all positions in it unchanged, so the process that appends to the file is not affected. Any program can
therefore write the file, and all lines of a killed program remain. Two alternatives were rejected. Agents could
compress their own lines, but then every agent in every language would have to compress, and flush after each line.
Agents could write to a pipe, but if the process that reads the pipe and compresses is killed, the lines in the pipe are
lost.

The holes are at the beginning of the file. `BoundedFile` reads them from the gzip file.
"""

import contextlib
import ctypes
import errno
import io
import os
import stat
import zlib
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Any, BinaryIO, Generic, TypeVar

from pydantic import BaseModel

from ucp.plain_file import check_weight, open_plain_file

PART_BYTES = 1024 * 1024
"""Size of a part. It is a multiple of the block size of all file systems."""
KEPT_BYTES = 2 * PART_BYTES
"""Number of bytes at the end of a file that are not packed, because the writer of the file may still remove an
incomplete line.
"""
_TRIED_BYTES = 64 * 1024
_HOLE = bytes(64)
"""The first bytes of a file whose first part is packed. A text file contains no NUL bytes."""
_LEVEL = 1
"""Gzip level of compression. Higher levels take three times as long, and reduce the size only by a tenth."""
_KEEP_SIZE, _PUNCH_HOLE = 1, 2
"""Flags of fallocate(2)."""


def packed_name(path: Path) -> Path:
    """Return the path of the gzip file that contains the packed parts of the file at `path`."""
    return path.with_name(f"{path.name}.gz")


def has_packed_parts(descriptor: int) -> bool:
    """Return true if the first part of a file is packed. In a copy of the file, NUL bytes may replace the hole."""
    return os.pread(descriptor, len(_HOLE), 0) == _HOLE


def hole_at_begin(descriptor: int) -> int:
    """Return the number of bytes of the hole at the beginning of a file. The function does not change the current
    position in the file.
    """
    position = os.lseek(descriptor, 0, os.SEEK_CUR)
    try:
        return os.lseek(descriptor, 0, os.SEEK_DATA)
    except OSError:  # the file is empty
        return 0
    finally:
        os.lseek(descriptor, position, os.SEEK_SET)


def can_free_parts(directory: Path) -> bool:
    """Return true if the file system of the directory can free a part of a file, and can report the hole."""
    try:
        descriptor = os.open(directory, os.O_TMPFILE | os.O_RDWR | os.O_CLOEXEC, 0o600)
    except OSError:
        return False
    try:
        os.pwrite(descriptor, b"\1" * 2 * _TRIED_BYTES, 0)
        _punch_hole(descriptor, 0, _TRIED_BYTES)
        return hole_at_begin(descriptor) == _TRIED_BYTES
    except OSError:
        return False
    finally:
        os.close(descriptor)


def has_finished_part(path: Path) -> bool:
    """Return true if `pack_parts` would pack a part of this file."""
    with contextlib.suppress(OSError), _opened(path, os.O_RDONLY) as file:
        return os.fstat(file.fileno()).st_size - hole_at_begin(file.fileno()) >= PART_BYTES + KEPT_BYTES
    return False


def pack_parts(path: Path) -> None:
    """Pack all parts of a growing file except its end. Raises OSError, for example on a full disk.

    The file system must pass `can_free_parts`.
    """
    with _opened(path, os.O_RDWR) as file, _packed_file(path, file) as packed:
        begin = hole_at_begin(file.fileno())
        while os.fstat(file.fileno()).st_size - begin >= PART_BYTES + KEPT_BYTES:
            _append(packed, os.pread(file.fileno(), PART_BYTES, begin))
            _punch_hole(file.fileno(), begin, PART_BYTES)
            begin += PART_BYTES


def pack_whole(path: Path) -> None:
    """Pack the rest of a file that no process appends to any more, and remove the file. Raises OSError.

    After an error or Ctrl-C, the rest is still in the file.
    """
    with _opened(path, os.O_RDONLY) as file, _packed_file(path, file) as packed:
        file.seek(hole_at_begin(file.fileno()))
        before = packed.tell()
        try:
            while data := file.read(PART_BYTES):
                _append(packed, data)
            path.unlink()
        except (OSError, KeyboardInterrupt):
            packed.truncate(before)
            if not before:
                packed_name(path).unlink()
            raise


def _opened(path: Path, flags: int) -> BinaryIO:
    """Open a file of an agent. Raises OSError if it is not a regular file.

    If agents run in containers, `path` is a symbolic link that the harness made, and this function follows it. The
    agent could replace its own file by a second link. The function does not follow the second link, because it could
    lead to any file on this machine.
    """
    own = path.parent / path.readlink() if path.is_symlink() else path
    descriptor = os.open(own, flags | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "is not a regular file")
    return os.fdopen(descriptor, "r+b" if flags == os.O_RDWR else "rb", buffering=0)


def _packed_file(path: Path, file: BinaryIO) -> BinaryIO:
    """Open the gzip file of the packed parts for appending. If `file` has no packed parts yet, also remove any old
    content of the gzip file.
    """
    packed = packed_name(path).open("ab", buffering=0)
    if not hole_at_begin(file.fileno()):
        packed.truncate(0)
    return packed


def _append(packed: BinaryIO, data: bytes) -> None:
    packer = zlib.compressobj(_LEVEL, zlib.DEFLATED, 16 + zlib.MAX_WBITS)
    member = packer.compress(data) + packer.flush()
    end = packed.tell()
    try:
        while member:
            member = member[packed.write(member) :]
    except OSError:
        packed.truncate(end)
        raise


def _punch_hole(descriptor: int, begin: int, length: int) -> None:
    """Free the disk space of a part of a file. The size and the rest of the file do not change."""
    fallocate = ctypes.CDLL(None, use_errno=True).fallocate
    fallocate.argtypes = (ctypes.c_int, ctypes.c_int, ctypes.c_int64, ctypes.c_int64)
    if fallocate(descriptor, _PUNCH_HOLE | _KEEP_SIZE, begin, length) != 0:
        code = ctypes.get_errno() or errno.EOPNOTSUPP
        raise OSError(code, os.strerror(code))


GZIP_MAGIC = b"\x1f\x8b"
MAX_BYTES = 1024 * 1024 * 1024
_CHUNK_BYTES = 256 * 1024


class BoundedFile(io.BufferedReader):
    """The content of a file as a binary stream.

    Gzip data is decompressed. If parts of the file were packed (`harness.archive.bounded_file`), the stream reads them
    from the gzip file.

    `problem` is the reason why the content ends early, or an empty text. Read `problem` only after the end of the
    stream.
    """

    def __init__(self, path: Path, most_bytes: int = MAX_BYTES) -> None:
        """Open the file to read at most `most_bytes` of content. Raises OSError if it is not a readable regular
        file.
        """
        self._content = _LimitedContent(path, most_bytes)
        super().__init__(self._content, 16 * 1024)

    @property
    def packed(self) -> bool:
        """True if the file is gzip data."""
        return self._content.packed

    @property
    def problem(self) -> str:
        return self._content.problem


class _LimitedContent(io.RawIOBase):
    def __init__(self, path: Path, most_bytes: int) -> None:
        self.problem = ""
        self._left = self._most = most_bytes
        self._file = open_plain_file(path).detach()
        self.packed: bool = self._file.read(2) == GZIP_MAGIC
        self._file.seek(0)
        self._parts = _PackedParts(packed_name(path))
        self._unpacker = _unpacker()
        self._input = b""

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any, /) -> int:
        most = min(len(buffer), self._left)
        if not most:
            if self._next(1):
                self.problem = f"only the first {self._most // 1024 // 1024} MiB are read"
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
            self._parts.close()
        super().close()

    def _next(self, most: int) -> bytes:
        """Return up to `most` bytes of content, or no bytes at the end."""
        return self._unpacked(most) if self.packed else self._read(most)

    def _read(self, most: int) -> bytes:
        """Return up to `most` bytes of a file that is not gzip data. If the next part of the file was packed, the file
        has only NUL bytes at this place. The method then returns the content of the part from the gzip file, if the
        gzip file contains this part.
        """
        begin = self._file.tell()
        data: bytes = self._file.read(most)
        plain = data.find(b"\0")
        if plain < 0 or not has_packed_parts(self._file.fileno()):
            return data
        part = data[:plain] or self._parts.read(begin, len(data) - len(data.lstrip(b"\0"))) or data
        self._file.seek(begin + len(part))
        return part

    def _unpacked(self, most: int) -> bytes:
        while not self.problem:
            if self._unpacker.eof:
                self._input = self._unpacker.unused_data.lstrip(b"\0") or self._file.read(_CHUNK_BYTES).lstrip(b"\0")
                if not self._input:
                    break
                self._unpacker = _unpacker()
            self._input = self._input or self._file.read(_CHUNK_BYTES)
            if not self._input:
                self.problem = "the gzip data ends early"
                break
            try:
                data: bytes = self._unpacker.decompress(self._input, most)
            except zlib.error:
                self.problem = "the gzip data is damaged"
                break
            self._input = self._unpacker.unconsumed_tail
            if data:
                return data
        return b""


class _PackedParts:
    """The content of the gzip file with the packed parts of a growing file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: BoundedFile | None = None
        self._position = 0

    def read(self, begin: int, most: int) -> bytes:
        """Return up to `most` bytes from the position `begin`. Return no bytes if they are missing or damaged."""
        if self._file is not None and self._file.problem:
            self.close()  # parts were added while their file was read
        try:
            self._file = self._file or BoundedFile(self._path)
        except OSError:
            return b""
        while self._position < begin and self._take(min(begin - self._position, _CHUNK_BYTES)):
            pass
        return self._take(most) if self._position == begin else b""

    def _take(self, most: int) -> bytes:
        assert self._file is not None, "the caller opened it"
        data = self._file.read(most)
        self._position += len(data)
        return data

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
        self._file, self._position = None, 0


def _unpacker() -> Any:
    return zlib.decompressobj(wbits=16 + zlib.MAX_WBITS)


MAX_LINES = 50_000
MAX_LINES_BYTES = 32 * 1024 * 1024
"""Maximum size of a JSON Lines file in bytes. The tracks of 50 vehicles take 1.6 MB for a mission of 20 minutes."""
MAX_LINE_BYTES = 4 * 1024 * 1024
MAX_LINE_WEIGHT = 200_000
"""Maximum weight of a line. The weight of a text is a measure of the memory that its JSON values need (see
`ucp.plain_file`). A line with the conditions of 10,000 links has half of this weight.
"""

Record = TypeVar("Record", bound=BaseModel)


class JsonLines(Generic[Record]):
    """The lines of a JSON Lines file that are valid for the type `model`.

    If the file is missing or the path is None, there are no lines. Invalid lines are skipped and counted.
    """

    def __init__(self, path: Path | None, model: type[Record]) -> None:
        self._path, self._model = path, model
        self._left_out = 0
        self._problem = ""

    def __iter__(self) -> Iterator[Record]:
        if self._path is None:
            return
        try:
            with open_plain_file(self._path) as file:
                for number in count(1):
                    if not (line := file.readline(MAX_LINE_BYTES)):
                        return
                    if number > MAX_LINES or file.tell() > MAX_LINES_BYTES:
                        self._problem = (
                            f"only the first {MAX_LINES} lines or {MAX_LINES_BYTES // 1024 // 1024} MiB are read"
                        )
                        return
                    if len(line) == MAX_LINE_BYTES and not line.endswith(b"\n"):
                        self._problem = (
                            f"the part after {MAX_LINE_BYTES // 1024 // 1024} MiB without a line end is left out"
                        )
                        return
                    try:
                        check_weight(line, MAX_LINE_WEIGHT)
                        read = self._model.model_validate_json(line)
                    except ValueError:
                        self.leave_out()
                    else:
                        yield read
        except FileNotFoundError:
            return
        except OSError as error:
            self._problem = f"cannot be read: {error.strerror}"

    def leave_out(self) -> None:
        """Count the line that was read last as unusable. Call this method to reject a line that is valid JSON."""
        self._left_out += 1

    def problems(self) -> list[str]:
        """Return a sentence for each problem that was found while the lines were read."""
        problems = []
        if self._left_out:
            lines = "1 damaged or unknown line is" if self._left_out == 1 else ""
            problems.append(f"{lines or f'{self._left_out} damaged or unknown lines are'} left out")
        if self._problem:
            problems.append(self._problem)
        return [f"{self._path.name if self._path else ''}: {problem}" for problem in problems]
