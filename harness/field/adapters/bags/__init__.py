"""Read ROS bags (recordings of ROS messages) in order of time: version 1, and version 2 in MCAP or SQLite files.

The readers need neither an index nor `metadata.yaml`, because a bag has neither if its recorder was killed or its
vehicle lost power. They skip a damaged place and continue after it. They limit every size that a file states. The
package `rosbags` decodes the messages (`harness.field.adapters.rosbag_adapter`).
"""

import mmap
import shutil
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from harness.archive.bounded_file import BoundedFile
from harness.field.adapters.bags import _mcap_bag, _sqlite, _version_1
from harness.field.adapters.bags._decompression import (
    MAX_FILE_BYTES,
    ZSTD_MAGIC,
    Item,
    RawMessage,
    UnreadablePart,
    decompress_file,
)
from ucp.plain_file import open_plain_file

MAGICS = (_version_1.MAGIC, _mcap_bag.MAGIC, _sqlite.MAGIC, ZSTD_MAGIC)
"""The first bytes of bags, including those of files compressed with zstd."""


class BagMessage(NamedTuple):
    """A message in a ROS bag."""

    number: int
    """Number of the message among the readable messages of the bag, counted from 1."""
    topic: str
    type_name: str
    time_ns: int
    """The time at which the bag recorded the message, in nanoseconds since the Unix epoch."""
    data: bytes


def messages(path: Path) -> Iterator[BagMessage | UnreadablePart]:
    """Yield all readable messages in a ROS bag. For each part of the bag that cannot be read, yield an UnreadablePart.
    Raises OSError.
    """
    number = 0
    with TemporaryDirectory(prefix="ucp-bag-") as directory:
        for item in _items(path, Path(directory)):
            if isinstance(item, RawMessage):
                number += 1
                yield BagMessage(number, *item)
            else:
                yield item


def _items(path: Path, scratch: Path) -> Iterator[Item]:
    problem = ""
    with BoundedFile(path, MAX_FILE_BYTES) as file:
        if file.packed:
            path = scratch / "unpacked"
            with path.open("wb") as copy:
                shutil.copyfileobj(file, copy)
            problem = file.problem
    zstd = _magic(path) == ZSTD_MAGIC
    if zstd:
        compressed, path = path, scratch / "unzstd"
        problem = decompress_file(compressed, path)
    magic = _magic(path)
    if magic == _sqlite.MAGIC:
        yield from _sqlite.items(path, scratch)
    elif magic in (_version_1.MAGIC, _mcap_bag.MAGIC):
        with open_plain_file(path) as bag, mmap.mmap(bag.fileno(), 0, access=mmap.ACCESS_READ) as content:
            yield from (_version_1 if magic == _version_1.MAGIC else _mcap_bag).items(content)
    else:
        way_out = ", but another file that is packed with zstd: unpack it first with `zstd -d`" if zstd else ""
        yield UnreadablePart(f"it is no ROS bag{way_out}")
    if problem:
        yield UnreadablePart(problem)


def _magic(path: Path) -> bytes | None:
    with open_plain_file(path) as file:
        beginning = file.read(max(map(len, MAGICS)))
    return next((magic for magic in MAGICS if beginning.startswith(magic)), None)
