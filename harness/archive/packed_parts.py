"""Pack the parts of a file that another process still appends to, and free their disk space.

A packed part is appended to the gzip file `NAME.gz`. In the file `NAME`, a hole replaces the part. The hole leaves the
size of the file and all positions in it unchanged, so the process that appends to the file is not affected. Any program
can therefore write the file, and all lines of a killed program remain. Two alternatives were rejected. Agents could
compress their own lines, but then every agent in every language would have to compress, and flush after each line.
Agents could write to a pipe, but if the process that reads the pipe and compresses is killed, the lines in the pipe are
lost.

The holes are at the beginning of the file. `BoundedFile` reads them from the gzip file.
"""

import contextlib
import ctypes
import errno
import os
import stat
import zlib
from pathlib import Path
from typing import BinaryIO

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
    """Return the number of bytes of the hole at the beginning of a file. The position in the file does not change."""
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
