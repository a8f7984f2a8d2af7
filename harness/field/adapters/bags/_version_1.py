"""Read ROS bags of version 1 (wiki.ros.org/Bags/Format/2.0), and skip damaged records."""

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

MAGIC = b"#ROSBAG V2.0\n"
_U32, _TIME = struct.Struct("<I"), struct.Struct("<II")
_MESSAGE, _CHUNK, _CONNECTION = 2, 5, 7
_OPERATIONS = range(2, 8)
_LONGEST_HEAD = 64 * 1024
_HEAD_BEFORE = 300
"""Maximum number of header bytes before the operation field of a record. Writers put other fields before this field."""
_OPERATION = re.compile(rb"\x04\0\0\0op=[\x02-\x07]")
MAX_DEPTH = 2

_Record = tuple[dict[str, bytes], bytes, int]
"""A record: the fields of its header, its data, and the position of the next record."""


def items(bag: Buffer) -> Iterator[Item]:
    topics = BagTopics()
    reader = _BagVersion1Reader(topics)
    yield from reader.items(bag, len(MAGIC), 0)
    if next(reader.records, None) is None:
        yield UnreadablePart(f"only the first {MAX_RECORDS} records are read")
    yield from topics.pending()


class _BagVersion1Reader:
    def __init__(self, topics: BagTopics) -> None:
        self._topics = topics
        self._tries = iter(range(MAX_TRIES))
        self.records = iter(range(MAX_RECORDS))

    def items(self, buffer: Buffer, position: int, depth: int, whole: bool = True) -> Iterator[Item]:
        """Yield the messages in the file, or in a compressed part of the file (a chunk). `whole` is false if only a
        part of the chunk could be decompressed. In this case, an incomplete last record does not count as damage.
        """
        while position < len(buffer) and next(self.records, None) is not None:
            record = _record_at(buffer, position)
            if record is None:
                next_position = self._next(buffer, position + 1)
                if next_position is None:
                    if whole:
                        yield UnreadablePart("it ends early, or is damaged")
                    return
                yield UnreadablePart("it is damaged in the middle; the data after the damage is read")
                position = next_position
                continue
            fields, data, position = record
            operation = fields["op"][0]
            if operation == _CHUNK and depth < MAX_DEPTH:
                content, problem = decompress(fields.get("compression", b"none").decode("latin-1"), data)
                intact = not problem and len(data) == _declared_length(buffer, position, data)
                yield from self.items(content, 0, depth + 1, intact)
                if problem or not intact:
                    yield UnreadablePart(problem or "it ends early")
            elif operation == _CONNECTION:
                self._connection(fields, data)
            elif operation == _MESSAGE and len(fields.get("time", b"")) == _TIME.size:
                seconds, nanoseconds = _TIME.unpack(fields["time"])
                yield from self._topics.message(fields.get("conn", b""), seconds * 10**9 + nanoseconds, data)

    def _connection(self, fields: dict[str, bytes], data: bytes) -> None:
        connection_fields = _fields(data) or {}
        topic, kind = connection_fields.get("topic") or fields.get("topic", b""), connection_fields.get("type", b"")
        topic_and_type = topic.decode("utf-8", "replace"), kind.decode("utf-8", "replace")
        self._topics.known.setdefault(fields.get("conn", b""), topic_and_type)

    def _next(self, buffer: Buffer, start: int) -> int | None:
        """Return the position of the next undamaged record. Return None if no such record is found."""
        for match in _OPERATION.finditer(buffer, start):
            for candidate in range(match.start() - _U32.size, max(start, match.start() - _HEAD_BEFORE) - 1, -1):
                if next(self._tries, None) is None:
                    return None
                if _record_at(buffer, candidate) is not None:
                    return candidate
        return None


def _declared_length(buffer: Buffer, end: int, data: bytes) -> int:
    """Return the declared length of `data`. The length field is directly before `data`, and `data` ends at the position
    `end` of the buffer.
    """
    return int(_U32.unpack_from(buffer, end - len(data) - _U32.size)[0])


def _record_at(buffer: Buffer, position: int) -> _Record | None:
    """Return the record at a position. Return None if no record begins there. A chunk record may be truncated."""
    if position + _U32.size > len(buffer):
        return None
    (length,) = _U32.unpack_from(buffer, position)
    head_end = position + _U32.size + length
    if length > _LONGEST_HEAD or head_end + _U32.size > len(buffer):
        return None
    fields = _fields(buffer[position + _U32.size : head_end])
    if fields is None or len(fields.get("op", b"")) != 1 or fields["op"][0] not in _OPERATIONS:
        return None
    (declared,) = _U32.unpack_from(buffer, head_end)
    start, data_ends = head_end + _U32.size, head_end + _U32.size + declared
    if data_ends > len(buffer) and fields["op"][0] != _CHUNK:
        return None
    return fields, buffer[start : min(data_ends, start + MAX_CHUNK_BYTES)], min(data_ends, len(buffer))


def _fields(head: bytes) -> dict[str, bytes] | None:
    """Return the header fields in the bytes `head`. Return None if the fields are damaged."""
    fields: dict[str, bytes] = {}
    position = 0
    while position < len(head):
        if position + _U32.size > len(head):
            return None
        (length,) = _U32.unpack_from(head, position)
        position += _U32.size + length
        name, separator, value = head[position - length : position].partition(b"=")
        if not separator or position > len(head):
            return None
        fields[name.decode("latin-1")] = value
    return fields
