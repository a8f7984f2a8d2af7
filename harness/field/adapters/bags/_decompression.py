"""Represent messages in a ROS bag, and decompress data within a size limit."""

import bz2
from collections.abc import Hashable, Iterator
from importlib import import_module
from mmap import mmap
from pathlib import Path
from typing import Any, NamedTuple

from harness.archive.bounded_file import BoundedFile

Buffer = bytes | mmap
"""The content of a file or of a chunk."""

MAX_MESSAGE_BYTES = 64 * 1024 * 1024
"""Maximum size of a message in bytes. A chain export of about 35,000 blocks has this size."""
MAX_CHUNK_BYTES = 256 * 1024 * 1024
MAX_FILE_BYTES = 1024 * 1024 * 1024
MAX_RECORDS = 5_000_000
MAX_TRIES = 2_000_000
"""Maximum number of positions in a file at which the reader searches for the next undamaged record."""


class RawMessage(NamedTuple):
    """A message in the form in which the ROS bag stores it. `time_ns` is the time of the recording in nanoseconds since
    the Unix epoch.
    """

    topic: str
    type_name: str
    time_ns: int
    data: bytes


class UnreadablePart(NamedTuple):
    """A part of a file that cannot be read. `why` is the reason as a text that completes a sentence."""

    why: str


Item = RawMessage | UnreadablePart


class BagTopics:
    """The topic of each channel in a ROS bag. If the topic of a channel is not known yet, the object stores the
    messages of this channel until the end of the file, because the end of the file may declare the topic. Messages of
    one channel keep their order.
    """

    def __init__(self) -> None:
        self.known: dict[Hashable, tuple[str, str]] = {}
        self._waiting: list[tuple[Hashable, int, bytes]] = []
        self._waiting_channels: set[Hashable] = set()
        self._waiting_bytes = 0

    def message(self, channel: Hashable, time_ns: int, data: bytes) -> Iterator[Item]:
        """Yield the message. If the topic of its channel is still unknown, store the message for later."""
        if channel in self.known and channel not in self._waiting_channels:
            yield RawMessage(*self.known[channel], time_ns, data)
        elif self._waiting_bytes < MAX_CHUNK_BYTES:
            self._waiting_channels.add(channel)
            self._waiting.append((channel, time_ns, data))
            self._waiting_bytes += len(data)

    def pending(self) -> Iterator[Item]:
        """Yield the messages that were stored because their topic was unknown."""
        unknown = 0
        for channel, time_ns, data in self._waiting:
            if channel in self.known:
                yield RawMessage(*self.known[channel], time_ns, data)
            else:
                unknown += 1
        if unknown:
            yield UnreadablePart(f"{unknown} messages are left out because their topic is not declared")


ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_READ_BYTES = 1024 * 1024
_STEP_BYTES = 16 * 1024
"""Number of compressed bytes that are decompressed in one step. If data are damaged, at most this number of undamaged
bytes before the damage are lost.
"""


def decompress(compression: str, data: bytes, max_bytes: int = MAX_CHUNK_BYTES) -> tuple[bytes, str]:
    """Decompress as much of the data as possible. Return the content, and the reason why the content is incomplete. The
    reason is "" if the content is complete.
    """
    if compression in ("", "none"):
        return data, ""
    decompressor = _decompressor(compression)
    if decompressor is None:
        return b"", f"a part of it has the unknown compression {compression[:20]!r}"
    content = bytearray()
    for start in range(0, len(data), _STEP_BYTES):
        try:
            content += decompressor.decompress(data[start : start + _STEP_BYTES], max(max_bytes - len(content), 0))
        except Exception as error:  # Each decompressor has its own exceptions.
            return bytes(content), f"the {compression} data is damaged: {str(error)[:100]}"
        if decompressor.eof:
            return bytes(content), ""
        if len(content) >= max_bytes:
            return bytes(content), f"only the first {max_bytes // 1024 // 1024} MiB of a part are read"
    return bytes(content), f"the {compression} data ends early"


def message_data(data: bytes) -> bytes:
    """Return the message data. In version 2, each message may be compressed. Raises ValueError."""
    if not data.startswith(ZSTD_MAGIC):
        return data
    content, problem = decompress("zstd", data, MAX_MESSAGE_BYTES)
    if problem:
        raise ValueError(problem)
    return content


def decompress_file(path: Path, copy: Path) -> str:
    """Decompress a zstd file into the file `copy`. Return the reason why the content is incomplete, or "" if it is
    complete.
    """
    decompressor: Any = _decompressor("zstd")
    written = 0
    with BoundedFile(path, MAX_FILE_BYTES) as file, copy.open("wb") as unpacked_copy:
        while written < MAX_FILE_BYTES and not decompressor.eof:
            part = file.read(_READ_BYTES) if decompressor.needs_input else b""
            if decompressor.needs_input and not part:
                return "what zstd packed breaks off"
            try:
                written += unpacked_copy.write(decompressor.decompress(part, _READ_BYTES))
            except Exception as error:  # The exception class differs between implementations.
                return f"the zstd data is damaged: {str(error)[:100]}"
    return "" if decompressor.eof else f"only the first {MAX_FILE_BYTES // 1024 // 1024} MiB are read"


def _decompressor(compression: str) -> Any:
    if compression == "bz2":
        return bz2.BZ2Decompressor()
    if compression == "lz4":
        return import_module("lz4.frame").LZ4FrameDecompressor()
    if compression == "zstd":
        try:
            return import_module("compression.zstd").ZstdDecompressor()
        except ImportError:  # Python before 3.14; rosbags requires this package.
            return import_module("backports.zstd").ZstdDecompressor()
    return None
