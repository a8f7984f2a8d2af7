"""Bags of version 1, record by record (wiki.ros.org/Bags/Format/2.0). What is damaged is passed over."""

import re
import struct
from collections.abc import Iterator

from harness.field.adapters.bags._decompression import (
    MAX_CHUNK_BYTES,
    MAX_RECORDS,
    MAX_TRIES,
    Broken,
    Buffer,
    Item,
    Topics,
    unpacked,
)

MAGIC = b"#ROSBAG V2.0\n"
_U32, _TIME = struct.Struct("<I"), struct.Struct("<II")
_MESSAGE, _CHUNK, _CONNECTION = 2, 5, 7
_OPERATIONS = range(2, 8)
_LONGEST_HEAD = 64 * 1024
_HEAD_BEFORE = 300
"""Bytes of a record's head before its operation, at most: the other fields that writers put there."""
_OPERATION = re.compile(rb"\x04\0\0\0op=[\x02-\x07]")
_NESTED = 2

_Record = tuple[dict[str, bytes], bytes, int]
"""Fields of the head, data, and where the next begins."""


def items(bag: Buffer) -> Iterator[Item]:
    topics = Topics()
    reader = _Reader(topics)
    yield from reader.items(bag, len(MAGIC), 0)
    if next(reader.records, None) is None:
        yield Broken(f"only the first {MAX_RECORDS} records are read")
    yield from topics.rest()


class _Reader:
    def __init__(self, topics: Topics) -> None:
        self._topics = topics
        self._tries = iter(range(MAX_TRIES))
        self.records = iter(range(MAX_RECORDS))

    def items(self, buffer: Buffer, position: int, depth: int, whole: bool = True) -> Iterator[Item]:
        """Messages of the bag, or of a chunk; a part of a last record is no damage if the chunk is not `whole`."""
        while position < len(buffer) and next(self.records, None) is not None:
            record = _record_at(buffer, position)
            if record is None:
                following = self._next(buffer, position + 1)
                if following is None:
                    if whole:
                        yield Broken("it ends early, or is damaged")
                    return
                yield Broken("it is damaged in the middle; the data after the damage is read")
                position = following
                continue
            fields, data, position = record
            operation = fields["op"][0]
            if operation == _CHUNK and depth < _NESTED:
                content, trouble = unpacked(fields.get("compression", b"none").decode("latin-1"), data)
                sound = not trouble and len(data) == _claimed(buffer, position, data)
                yield from self.items(content, 0, depth + 1, sound)
                if trouble or not sound:
                    yield Broken(trouble or "it ends early")
            elif operation == _CONNECTION:
                self._connection(fields, data)
            elif operation == _MESSAGE and len(fields.get("time", b"")) == _TIME.size:
                seconds, nanoseconds = _TIME.unpack(fields["time"])
                yield from self._topics.message(fields.get("conn", b""), seconds * 10**9 + nanoseconds, data)

    def _connection(self, fields: dict[str, bytes], data: bytes) -> None:
        about = _fields(data) or {}
        topic, kind = about.get("topic") or fields.get("topic", b""), about.get("type", b"")
        known = topic.decode("utf-8", "replace"), kind.decode("utf-8", "replace")
        self._topics.known.setdefault(fields.get("conn", b""), known)

    def _next(self, buffer: Buffer, start: int) -> int | None:
        """Where the next sound record begins."""
        for match in _OPERATION.finditer(buffer, start):
            for begins in range(match.start() - _U32.size, max(start, match.start() - _HEAD_BEFORE) - 1, -1):
                if next(self._tries, None) is None:
                    return None
                if _record_at(buffer, begins) is not None:
                    return begins
        return None


def _claimed(buffer: Buffer, end: int, data: bytes) -> int:
    """How long the data that ends at `end` should be."""
    return int(_U32.unpack_from(buffer, end - len(data) - _U32.size)[0])


def _record_at(buffer: Buffer, position: int) -> _Record | None:
    """The record that begins there, if one does. A chunk may be cut off by the end."""
    if position + _U32.size > len(buffer):
        return None
    (length,) = _U32.unpack_from(buffer, position)
    ends = position + _U32.size + length
    if length > _LONGEST_HEAD or ends + _U32.size > len(buffer):
        return None
    fields = _fields(buffer[position + _U32.size : ends])
    if fields is None or len(fields.get("op", b"")) != 1 or fields["op"][0] not in _OPERATIONS:
        return None
    (claimed,) = _U32.unpack_from(buffer, ends)
    begins, data_ends = ends + _U32.size, ends + _U32.size + claimed
    if data_ends > len(buffer) and fields["op"][0] != _CHUNK:
        return None
    return fields, buffer[begins : min(data_ends, begins + MAX_CHUNK_BYTES)], min(data_ends, len(buffer))


def _fields(head: bytes) -> dict[str, bytes] | None:
    """None if these are none."""
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
