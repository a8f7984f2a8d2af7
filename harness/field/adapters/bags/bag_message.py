"""What is found in a bag, whatever its kind."""

from collections.abc import Hashable, Iterator
from mmap import mmap
from typing import NamedTuple

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
            yield Broken(f"{unknown} messages are left out whose topic stands nowhere")
