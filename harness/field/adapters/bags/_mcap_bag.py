"""Read ROS bags of version 2 in MCAP files (mcap.dev/spec). Damaged records are skipped."""

import re
import struct
from collections.abc import Iterator

from harness.field.adapters.bags._decompression import (
    MAX_CHUNK_BYTES,
    MAX_RECORDS,
    MAX_TRIES,
    BagTopics,
    Buffer,
    Item,
    UnreadablePart,
    decompress,
)

MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 2, 3, 4, 5, 6, 15
_OPERATIONS = range(1, 16)
_RECORD = struct.Struct("<BQ")
_U16, _U32 = struct.Struct("<H"), struct.Struct("<I")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_CHUNK_HEAD = struct.Struct("<QQQI")
_BEGINNING = re.compile(rb"(?s)[\x01-\x0f].{4}\0{4}")
MAX_DEPTH = 2


def items(bag: Buffer) -> Iterator[Item]:
    topics = BagTopics()
    reader = _McapReader(topics)
    yield from reader.items(bag, len(MAGIC), 0)
    if next(reader.records, None) is None:
        yield UnreadablePart(f"only the first {MAX_RECORDS} records are read")
    elif not reader.closed:
        yield UnreadablePart("it was not closed, and ends early")
    yield from topics.pending()


class _McapReader:
    def __init__(self, topics: BagTopics) -> None:
        self._topics = topics
        self._tries = iter(range(MAX_TRIES))
        self.records = iter(range(MAX_RECORDS))
        self._types: dict[int, str] = {}
        self.closed = False

    def items(self, buffer: Buffer, position: int, depth: int, whole: bool = True) -> Iterator[Item]:
        """Yield the messages in the file, or in a compressed part of the file (a chunk). `whole` is false if only a
        part of the chunk could be decompressed. In this case, an incomplete last record does not count as damage.
        """
        while (
            position < len(buffer)
            and next(self.records, None) is not None
            and not (self.closed and buffer[position : position + len(MAGIC)] == MAGIC)
        ):
            operation, start, end = _record_at(buffer, position)
            if not operation:
                next_position = self._next(buffer, position + 1)
                if next_position is None:
                    if whole and depth:
                        yield UnreadablePart("it ends early, or is damaged")
                    return
                yield UnreadablePart("it is damaged in the middle; the data after the damage is read")
                position = next_position
                continue
            record = buffer[start : min(end, start + MAX_CHUNK_BYTES)]
            position = end
            if operation == _CHUNK and depth < MAX_DEPTH and not self.closed:
                yield from self._chunk(record, depth, cut_off=end > len(buffer))
            elif operation in (_DATA_END, _FOOTER):
                self.closed = not depth or self.closed  # The summary after this record repeats earlier records.
            else:
                yield from self._record(operation, record)

    def _chunk(self, record: bytes, depth: int, *, cut_off: bool) -> Iterator[Item]:
        compression, position_after = _string(record, _CHUNK_HEAD.size)
        content, problem = decompress(compression, record[position_after + 8 :])
        yield from self.items(content, 0, depth + 1, not problem and not cut_off)
        if problem:
            yield UnreadablePart(problem)

    def _record(self, operation: int, record: bytes) -> Iterator[Item]:
        if operation == _SCHEMA and len(record) >= _U16.size:
            self._types.setdefault(_U16.unpack_from(record)[0], _string(record, 2)[0])
        elif operation == _CHANNEL and len(record) >= 2 * _U16.size:
            number, schema = struct.unpack_from("<HH", record)
            self._topics.known.setdefault(number, (_string(record, 4)[0], self._types.get(schema, "")))
        elif operation == _MESSAGE and len(record) >= _MESSAGE_HEAD.size and not self.closed:
            number, _, log_time, _ = _MESSAGE_HEAD.unpack_from(record)
            yield from self._topics.message(number, log_time, record[_MESSAGE_HEAD.size :])

    def _next(self, buffer: Buffer, start: int) -> int | None:
        """Return the position of the next undamaged record. A record counts as undamaged if another record or the end
        of the buffer follows it. Return None if no such record is found.
        """
        for match in _BEGINNING.finditer(buffer, start):
            if next(self._tries, None) is None:
                return None
            operation, _, end = _record_at(buffer, match.start())
            if operation and (end >= len(buffer) or _record_at(buffer, end)[0]):
                return match.start()
        return None


def _record_at(buffer: Buffer, position: int) -> tuple[int, int, int]:
    """Return the operation code of the record at a position in an MCAP file, and the start and end of its content.
    Return three zeros if no record begins there. The content of a chunk may extend beyond the end of a truncated file.
    """
    if position + _RECORD.size > len(buffer):
        return 0, 0, 0
    operation, length = _RECORD.unpack_from(buffer, position)
    start = position + _RECORD.size
    if operation not in _OPERATIONS or (start + length > len(buffer) and operation != _CHUNK):
        return 0, 0, 0
    return operation, start, start + length


def _string(record: bytes, position: int) -> tuple[str, int]:
    """Return the string at a position, and the position after it."""
    if position + _U32.size > len(record):
        return "", len(record)
    (length,) = _U32.unpack_from(record, position)
    start = position + _U32.size
    return record[start : start + length].decode("utf-8", "replace"), start + length
