"""The files of ROS bags, message by message in the order of recording: version 1, and the two storages of version 2.

An index is not asked for, nor `metadata.yaml`: a bag whose recorder was killed, or whose vehicle lost power, has none,
and is read up to where it breaks off. Sizes that a file claims are believed up to a bound.
Formats: wiki.ros.org/Bags/Format/2.0, mcap.dev/spec, and the tables of rosbag2_storage_sqlite3.
"""

import bz2
import io
import shutil
import sqlite3
import struct
from collections.abc import Iterator
from contextlib import closing
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, BinaryIO, NamedTuple

from harness.archive.opened import Opened

ROS1_MAGIC = b"#ROSBAG V2.0\n"
MCAP_MAGIC = b"\x89MCAP0\r\n"
SQLITE_MAGIC = b"SQLite format 3\0"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
MAX_MESSAGE_BYTES = 64 * 1024 * 1024
"""A chain export of some 35,000 blocks."""
MAX_CHUNK_BYTES = 256 * 1024 * 1024
MAX_FILE_BYTES = 1024 * 1024 * 1024
_STEPS_AT_ONCE, MAX_STEPS = 10_000_000, 5_000_000_000
_COPIED_AT_ONCE = 1024 * 1024


class BagMessage(NamedTuple):
    """`number` counts the messages of the file from 1; `time_ns` is that of recording, since the Unix epoch."""

    number: int
    topic: str
    type_name: str
    time_ns: int
    data: bytes


class BrokenBagError(Exception):
    """What follows cannot be read: a sentence's end."""


def messages(path: Path) -> Iterator[BagMessage]:
    """All messages up to where the file breaks off, where it raises BrokenBagError. Raises OSError."""
    with TemporaryDirectory(prefix="ucp-bag-") as directory:
        found = _found_in(path, Path(directory))
        yield from (BagMessage(number, *each) for number, each in enumerate(found, 1))


def _found_in(path: Path, scratch: Path) -> Iterator["_Found"]:
    trouble = ""
    with Opened(path, MAX_FILE_BYTES) as file:
        magic = file.peek(16)[:16]
        if magic.startswith(ROS1_MAGIC):
            yield from _ros1(file)
        elif magic.startswith(MCAP_MAGIC):
            yield from _mcap(file)
        elif magic.startswith(ZSTD_MAGIC):
            unpacked, trouble = _from_zstd_file(path, scratch)
            with Opened(unpacked) as inner:
                again = inner.peek(4)[:4] == ZSTD_MAGIC
            yield from () if again else _found_in(unpacked, scratch)
        elif magic.startswith(SQLITE_MAGIC):
            yield from _sqlite3(_copied(path, scratch) if file.packed else path, scratch)
        else:
            raise BrokenBagError("it is no ROS bag")
        if trouble := trouble or file.trouble:
            raise BrokenBagError(trouble)


_Found = tuple[str, str, int, bytes]
"""Topic, type, time in ns, data."""

# Version 1

_U32, _TIME = struct.Struct("<I"), struct.Struct("<II")
_MESSAGE, _CHUNK, _CONNECTION = 2, 5, 7


def _ros1(file: BinaryIO) -> Iterator[_Found]:
    file.read(len(ROS1_MAGIC))
    connections: dict[bytes, tuple[str, str]] = {}
    for fields, data in _records(file, MAX_CHUNK_BYTES):
        operation = fields.get("op", b"\0")[0]
        if operation == _CHUNK:
            content, trouble = _unpacked(fields.get("compression", b"none").decode("latin-1"), data)
            for inner, message in _records(io.BytesIO(content), MAX_MESSAGE_BYTES, whole=not trouble):
                yield from _ros1_record(inner, message, connections)
            if trouble:
                raise BrokenBagError(trouble)
        else:
            yield from _ros1_record(fields, data, connections)


def _ros1_record(fields: dict[str, bytes], data: bytes, connections: dict[bytes, tuple[str, str]]) -> Iterator[_Found]:
    operation, connection = fields.get("op", b"\0")[0], fields.get("conn", b"")
    if operation == _CONNECTION:
        about = _fields(data)
        topic = about.get("topic") or fields.get("topic", b"")
        connections[connection] = topic.decode("utf-8", "replace"), about.get("type", b"").decode("utf-8", "replace")
    elif operation == _MESSAGE and connection in connections and len(fields.get("time", b"")) == _TIME.size:
        seconds, nanoseconds = _TIME.unpack(fields["time"])
        yield *connections[connection], seconds * 1_000_000_000 + nanoseconds, data


def _records(file: BinaryIO, most_bytes: int, *, whole: bool = True) -> Iterator[tuple[dict[str, bytes], bytes]]:
    """Header fields and data of each record. A part of a last one is an error, if the file should be `whole`.

    A chunk that is cut is given as far as it is there, and is then the last.
    """
    while size := file.read(_U32.size):
        head = file.read(min(_U32.unpack(size)[0], 1024 * 1024)) if len(size) == _U32.size else b""
        length = file.read(_U32.size)
        if len(length) < _U32.size or len(head) < _U32.unpack(size)[0]:
            if whole:
                raise BrokenBagError("the bag breaks off in the middle of a record")
            return
        fields, (claimed,) = _fields(head), _U32.unpack(length)
        if "op" not in fields or not fields["op"] or claimed > most_bytes:
            raise BrokenBagError("the bag is damaged here")
        data = file.read(claimed)
        if len(data) == claimed:
            yield fields, data
            continue
        if fields["op"][0] == _CHUNK:
            yield fields, data
        if whole:
            raise BrokenBagError("the bag breaks off in the middle of a record")
        return


def _fields(head: bytes) -> dict[str, bytes]:
    fields: dict[str, bytes] = {}
    position = 0
    while position + _U32.size <= len(head):
        (length,) = _U32.unpack_from(head, position)
        position += _U32.size
        name, separator, value = head[position : position + length].partition(b"=")
        if separator:
            fields[name.decode("latin-1")] = value
        position += length
    return fields


# MCAP

_MCAP_SCHEMA, _MCAP_CHANNEL, _MCAP_MESSAGE, _MCAP_CHUNK = 3, 4, 5, 6
_MCAP_DATA_END = 15
_RECORD = struct.Struct("<BQ")
_MCAP_MESSAGE_HEAD = struct.Struct("<HIQQ")
_MCAP_CHUNK_HEAD = struct.Struct("<QQQI")


def _mcap(file: BinaryIO) -> Iterator[_Found]:
    file.read(len(MCAP_MAGIC))
    types: dict[int, str] = {}
    channels: dict[int, tuple[str, int]] = {}
    for operation, record in _mcap_records(file, MAX_CHUNK_BYTES):
        if operation == _MCAP_DATA_END:
            return  # what follows repeats what is before, for whoever looks something up
        if operation != _MCAP_CHUNK:
            yield from _mcap_record(operation, record, types, channels)
            continue
        if len(record) < _MCAP_CHUNK_HEAD.size:
            raise BrokenBagError("the bag breaks off in the middle of a record")
        compression, rest = _string(record, _MCAP_CHUNK_HEAD.size)
        content, trouble = _unpacked(compression, record[rest + 8 :])
        for inner, message in _mcap_records(io.BytesIO(content), MAX_MESSAGE_BYTES, whole=not trouble):
            yield from _mcap_record(inner, message, types, channels)
        if trouble:
            raise BrokenBagError(trouble)
    raise BrokenBagError("the bag was not closed, and breaks off")


def _mcap_record(
    operation: int, record: bytes, types: dict[int, str], channels: dict[int, tuple[str, int]]
) -> Iterator[_Found]:
    try:
        if operation == _MCAP_SCHEMA:
            types[int.from_bytes(record[:2], "little")] = _string(record, 2)[0]
        elif operation == _MCAP_CHANNEL:
            number, schema = struct.unpack_from("<HH", record)
            channels[number] = _string(record, 4)[0], schema
        elif operation == _MCAP_MESSAGE:
            number, _, log_time, _ = _MCAP_MESSAGE_HEAD.unpack_from(record)
            if number in channels:
                topic, schema = channels[number]
                yield topic, types.get(schema, ""), log_time, record[_MCAP_MESSAGE_HEAD.size :]
    except struct.error:
        raise BrokenBagError("the bag is damaged here") from None


def _mcap_records(file: BinaryIO, most_bytes: int, *, whole: bool = True) -> Iterator[tuple[int, bytes]]:
    while head := file.read(_RECORD.size):
        if len(head) < _RECORD.size:
            if whole and head != MCAP_MAGIC:
                raise BrokenBagError("the bag breaks off in the middle of a record")
            return
        operation, length = _RECORD.unpack(head)
        if length > most_bytes or not operation:
            raise BrokenBagError("the bag is damaged here")
        data = file.read(length)
        if len(data) == length or operation == _MCAP_CHUNK:
            yield operation, data
        if len(data) < length:
            if whole:
                raise BrokenBagError("the bag breaks off in the middle of a record")
            return


def _string(record: bytes, position: int) -> tuple[str, int]:
    """A string, and where what follows it begins."""
    if position + _U32.size > len(record):
        raise BrokenBagError("the bag is damaged here")
    (length,) = _U32.unpack_from(record, position)
    begins = position + _U32.size
    return record[begins : begins + length].decode("utf-8", "replace"), begins + length


# Packed chunks and messages


def _unpacked(compression: str, data: bytes, most_bytes: int = MAX_CHUNK_BYTES) -> tuple[bytes, str]:
    """The content as far as it can be unpacked, and why there is no more of it, if it is not whole."""
    try:
        if compression in ("", "none"):
            return data, ""
        if compression == "bz2":
            packed: Any = bz2.BZ2Decompressor()
            content = packed.decompress(data, most_bytes)
        elif compression == "lz4":
            packed = import_module("lz4.frame").LZ4FrameDecompressor()
            content = packed.decompress(data, most_bytes)
        elif compression == "zstd":
            packed = _zstd().ZstdDecompressor()
            content = packed.decompress(data, most_bytes)
        else:
            return b"", f"what follows is packed by {compression[:20]!r}, which no bag is"
    except Exception as error:  # each of the three has errors of its own
        return b"", f"what is packed here is damaged: {error}"
    return content, "" if packed.eof else "what is packed here breaks off"


def message_data(data: bytes) -> bytes:
    """The message that version 2 may have packed by itself. Raises BrokenBagError."""
    if not data.startswith(ZSTD_MAGIC):
        return data
    content, trouble = _unpacked("zstd", data, MAX_MESSAGE_BYTES)
    if trouble:
        raise BrokenBagError(trouble)
    return content


def _zstd() -> Any:
    """The module, which comes with Python from 3.14 on, and with rosbags before."""
    try:
        return import_module("compression.zstd")
    except ImportError:
        return import_module("backports.zstd")


# SQLite


def _sqlite3(path: Path, scratch: Path) -> Iterator[_Found]:
    """A database that was not closed has messages in its journal: of both there is a copy then, which SQLite mends."""
    journal = path.with_name(f"{path.name}-wal")
    if journal.is_file() and 0 < journal.stat().st_size < MAX_FILE_BYTES:
        path = _copied(path, scratch)
        shutil.copyfile(journal, path.with_name(f"{path.name}-wal"))
        how = "mode=rw"
    else:
        how = "mode=ro&immutable=1"
    try:
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?{how}", uri=True)) as database:
            yield from _rows(database)
    except sqlite3.Error as error:
        raise BrokenBagError(f"the bag's database cannot be read: {error}") from None


def _rows(database: sqlite3.Connection) -> Iterator[_Found]:
    steps = iter(range(MAX_STEPS // _STEPS_AT_ONCE))
    database.set_progress_handler(lambda: next(steps, None) is None, _STEPS_AT_ONCE)
    database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_MESSAGE_BYTES)
    database.execute("PRAGMA trusted_schema = OFF")
    database.text_factory = lambda text: text.decode("utf-8", "replace")
    tables = database.execute("SELECT count(*) FROM sqlite_master WHERE type = 'table' AND name IN (?, ?)", _TABLES)
    if tables.fetchone() != (len(_TABLES),):
        raise BrokenBagError("it is no ROS bag: a database without the tables messages and topics")
    topics = {number: (str(name), str(kind)) for number, name, kind in database.execute(_TOPICS)}
    last = -(2**63)
    try:
        for number, *row in database.execute(f"{_MESSAGES} ORDER BY id"):
            last = number
            yield _found(topics, *row)
        return
    except sqlite3.DatabaseError as error:
        trouble = str(error)
    # Pages behind a damaged one may be sound: they are read from the end.
    behind: list[_Found] = []
    kept_bytes = 0
    try:
        for _, *row in database.execute(f"{_MESSAGES} WHERE id > ? ORDER BY id DESC", (last,)):
            behind.append(_found(topics, *row))
            kept_bytes += len(behind[-1][-1])
            if kept_bytes > MAX_CHUNK_BYTES:
                break
    except sqlite3.DatabaseError as error:
        trouble = str(error)
    yield from reversed(behind)
    raise BrokenBagError(f"some messages before the last {len(behind)} cannot be read ({trouble})")


_TABLES = ("messages", "topics")
_TOPICS = "SELECT id, name, type FROM topics LIMIT 100000"
_MESSAGES = "SELECT id, topic_id, timestamp, data FROM messages"


def _found(topics: dict[Any, tuple[str, str]], topic: Any, time_ns: Any, data: Any) -> _Found:
    """A row; its values may be of any type, if the file is damaged."""
    name, kind = topics.get(topic, ("", ""))
    sound = isinstance(time_ns, int) and isinstance(data, bytes)
    return (name, kind, time_ns, data) if sound else (name, "", 0, b"")


def _copied(path: Path, scratch: Path) -> Path:
    """The file as it is once it is unpacked."""
    copy = scratch / "bag"
    with Opened(path, MAX_FILE_BYTES) as file, copy.open("wb") as unpacked:
        shutil.copyfileobj(file, unpacked)
    return copy


def _from_zstd_file(path: Path, scratch: Path) -> tuple[Path, str]:
    """What zstd packed, unpacked, and why it is not whole, if so."""
    copy = scratch / "unpacked"
    packed = _zstd().ZstdDecompressor()
    written = 0
    with Opened(path, MAX_FILE_BYTES) as file, copy.open("wb") as unpacked:
        while written < MAX_FILE_BYTES and not packed.eof:
            part = file.read(_COPIED_AT_ONCE) if packed.needs_input else b""
            if packed.needs_input and not part:
                return copy, "what zstd packed breaks off"
            try:
                content = packed.decompress(part, _COPIED_AT_ONCE)
            except Exception as error:  # its own, and not everywhere of one class
                return copy, f"what zstd packed is damaged: {error}"
            written += unpacked.write(content)
    return copy, "" if packed.eof else f"what is beyond {MAX_FILE_BYTES // 1024 // 1024} MiB is not read"
