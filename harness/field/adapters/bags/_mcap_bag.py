"""Bags of version 2 in MCAP, record by record (mcap.dev/spec). What is damaged is passed over."""

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

MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 2, 3, 4, 5, 6, 15
_OPERATIONS = range(1, 16)
_RECORD = struct.Struct("<BQ")
_U16, _U32 = struct.Struct("<H"), struct.Struct("<I")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_CHUNK_HEAD = struct.Struct("<QQQI")
_BEGINNING = re.compile(rb"(?s)[\x01-\x0f].{4}\0{4}")
_NESTED = 2


def items(bag: Buffer) -> Iterator[Item]:
    topics = Topics()
    reader = _Reader(topics)
    yield from reader.items(bag, len(MAGIC), 0)
    if next(reader.records, None) is None:
        yield Broken(f"only the first {MAX_RECORDS} records are read")
    elif not reader.closed:
        yield Broken("it was not closed, and ends early")
    yield from topics.rest()


class _Reader:
    def __init__(self, topics: Topics) -> None:
        self._topics = topics
        self._tries = iter(range(MAX_TRIES))
        self.records = iter(range(MAX_RECORDS))
        self._types: dict[int, str] = {}
        self.closed = False

    def items(self, buffer: Buffer, position: int, depth: int, whole: bool = True) -> Iterator[Item]:
        """Messages of the bag, or of a chunk; a part of a last record is no damage if the chunk is not `whole`."""
        while (
            position < len(buffer)
            and next(self.records, None) is not None
            and not (self.closed and buffer[position : position + len(MAGIC)] == MAGIC)
        ):
            operation, begins, ends = _record_at(buffer, position)
            if not operation:
                following = self._next(buffer, position + 1)
                if following is None:
                    if whole and depth:
                        yield Broken("it ends early, or is damaged")
                    return
                yield Broken("it is damaged in the middle; the data after the damage is read")
                position = following
                continue
            record = buffer[begins : min(ends, begins + MAX_CHUNK_BYTES)]
            position = ends
            if operation == _CHUNK and depth < _NESTED and not self.closed:
                yield from self._chunk(record, depth, cut_off=ends > len(buffer))
            elif operation in (_DATA_END, _FOOTER):
                self.closed = not depth or self.closed  # what follows repeats what is before, for whoever looks it up
            else:
                yield from self._record(operation, record)

    def _chunk(self, record: bytes, depth: int, *, cut_off: bool) -> Iterator[Item]:
        compression, rest = _string(record, _CHUNK_HEAD.size)
        content, trouble = unpacked(compression, record[rest + 8 :])
        yield from self.items(content, 0, depth + 1, not trouble and not cut_off)
        if trouble:
            yield Broken(trouble)

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
        """Where the next record begins that is followed by one, or by the end."""
        for match in _BEGINNING.finditer(buffer, start):
            if next(self._tries, None) is None:
                return None
            operation, _, ends = _record_at(buffer, match.start())
            if operation and (ends >= len(buffer) or _record_at(buffer, ends)[0]):
                return match.start()
        return None


def _record_at(buffer: Buffer, position: int) -> tuple[int, int, int]:
    """What begins there, where its content does, and where it ends; 0 if there is none. The end may cut off a chunk."""
    if position + _RECORD.size > len(buffer):
        return 0, 0, 0
    operation, length = _RECORD.unpack_from(buffer, position)
    begins = position + _RECORD.size
    if operation not in _OPERATIONS or (begins + length > len(buffer) and operation != _CHUNK):
        return 0, 0, 0
    return operation, begins, begins + length


def _string(record: bytes, position: int) -> tuple[str, int]:
    """A string, and where what follows it begins."""
    if position + _U32.size > len(record):
        return "", len(record)
    (length,) = _U32.unpack_from(record, position)
    begins = position + _U32.size
    return record[begins : begins + length].decode("utf-8", "replace"), begins + length
