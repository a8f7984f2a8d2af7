"""Messages in a bag, and the bounded decompression of chunks and files."""

import bz2
from collections.abc import Hashable, Iterator
from importlib import import_module
from mmap import mmap
from pathlib import Path
from typing import Any, NamedTuple

from harness.archive.bounded_file import BoundedFile

Buffer = bytes | mmap
"""A file's content, or a chunk's."""

MAX_MESSAGE_BYTES = 64 * 1024 * 1024
"""A chain export of some 35,000 blocks."""
MAX_CHUNK_BYTES = 256 * 1024 * 1024
MAX_FILE_BYTES = 1024 * 1024 * 1024
MAX_RECORDS = 5_000_000
MAX_TRIES = 2_000_000
"""Places at which a record may begin behind a damaged one, of a file."""


class Found(NamedTuple):
    """A message; `time_ns` is that of recording, since the Unix epoch."""

    topic: str
    type_name: str
    time_ns: int
    data: bytes


class Broken(NamedTuple):
    """Here something cannot be read: `why` ends a sentence."""

    why: str


Item = Found | Broken


class Topics:
    """Which messages are on which topic. One whose topic is not known yet waits: an index at the end may tell it.

    Messages of a topic stay in their order.
    """

    def __init__(self) -> None:
        self.known: dict[Hashable, tuple[str, str]] = {}
        self._waiting: list[tuple[Hashable, int, bytes]] = []
        self._wait: set[Hashable] = set()
        self._waiting_bytes = 0

    def message(self, channel: Hashable, time_ns: int, data: bytes) -> Iterator[Item]:
        if channel in self.known and channel not in self._wait:
            yield Found(*self.known[channel], time_ns, data)
        elif self._waiting_bytes < MAX_CHUNK_BYTES:
            self._wait.add(channel)
            self._waiting.append((channel, time_ns, data))
            self._waiting_bytes += len(data)

    def rest(self) -> Iterator[Item]:
        """Those that waited."""
        unknown = 0
        for channel, time_ns, data in self._waiting:
            if channel in self.known:
                yield Found(*self.known[channel], time_ns, data)
            else:
                unknown += 1
        if unknown:
            yield Broken(f"{unknown} messages are left out because their topic is not declared")


ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_AT_ONCE = 1024 * 1024
_STEP_BYTES = 16 * 1024
"""So much is lost of what is packed, at most, before a damaged place."""


def unpacked(compression: str, data: bytes, most_bytes: int = MAX_CHUNK_BYTES) -> tuple[bytes, str]:
    """The content as far as it can be unpacked, and why there is no more of it, if it is not whole."""
    if compression in ("", "none"):
        return data, ""
    unpacker = _unpacker(compression)
    if unpacker is None:
        return b"", f"a part of it has the unknown compression {compression[:20]!r}"
    content = bytearray()
    for start in range(0, len(data), _STEP_BYTES):
        try:
            content += unpacker.decompress(data[start : start + _STEP_BYTES], max(most_bytes - len(content), 0))
        except Exception as error:  # each of the three has errors of its own
            return bytes(content), f"the {compression} data is damaged: {str(error)[:100]}"
        if unpacker.eof:
            return bytes(content), ""
        if len(content) >= most_bytes:
            return bytes(content), f"only the first {most_bytes // 1024 // 1024} MiB of a part are read"
    return bytes(content), f"the {compression} data ends early"


def message_data(data: bytes) -> bytes:
    """The message, which version 2 may have packed by itself. Raises ValueError."""
    if not data.startswith(ZSTD_MAGIC):
        return data
    content, trouble = unpacked("zstd", data, MAX_MESSAGE_BYTES)
    if trouble:
        raise ValueError(trouble)
    return content


def unpacked_file(path: Path, copy: Path) -> str:
    """Unpack what zstd packed; why it is not whole, if so."""
    unpacker: Any = _unpacker("zstd")
    written = 0
    with BoundedFile(path, MAX_FILE_BYTES) as file, copy.open("wb") as unpacked_copy:
        while written < MAX_FILE_BYTES and not unpacker.eof:
            part = file.read(_AT_ONCE) if unpacker.needs_input else b""
            if unpacker.needs_input and not part:
                return "what zstd packed breaks off"
            try:
                written += unpacked_copy.write(unpacker.decompress(part, _AT_ONCE))
            except Exception as error:  # its own, and not everywhere of one class
                return f"the zstd data is damaged: {str(error)[:100]}"
    return "" if unpacker.eof else f"only the first {MAX_FILE_BYTES // 1024 // 1024} MiB are read"


def _unpacker(compression: str) -> Any:
    if compression == "bz2":
        return bz2.BZ2Decompressor()
    if compression == "lz4":
        return import_module("lz4.frame").LZ4FrameDecompressor()
    if compression == "zstd":
        try:
            return import_module("compression.zstd").ZstdDecompressor()
        except ImportError:  # before Python 3.14; it comes with rosbags
            return import_module("backports.zstd").ZstdDecompressor()
    return None
