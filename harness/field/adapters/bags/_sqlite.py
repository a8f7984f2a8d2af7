"""Read ROS bags of version 2 in SQLite files (rosbag2_storage_sqlite3), in order of time.

If a file is truncated, `SqlitePages` reads the rows directly from its pages, because the index of the pages is lost.
SQLite finds rows through the inner pages of a tree. In a file that grew during a recording, inner pages are often
behind the pages with their rows. If the end of the file is lost, SQLite therefore finds no rows. Each leaf page,
however, contains its rows completely, except for the overflow pages of large ones. The format of pages is described in
https://www.sqlite.org/fileformat2.html.
"""

import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

from harness.field.adapters.bags._decompression import (
    MAX_CHUNK_BYTES,
    MAX_FILE_BYTES,
    MAX_MESSAGE_BYTES,
    Item,
    RawMessage,
    UnreadablePart,
)
from ucp.plain_file import open_plain_file

TABLE_LEAF = 0x0D
FILE_HEADER_BYTES = 100
MAX_PAYLOAD_BYTES = 64 * 1024 * 1024
_INTEGER_BYTES = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8}

Value = int | bytes | str | None
Row = tuple[int, list[Value]]
"""A row of a table: its number, and its values. If a column contains the row number, SQLite stores None in this column.
"""


class SqlitePages:
    """The pages of an SQLite file."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        size = int.from_bytes(data[16:18], "big")
        self._page_bytes = 65536 if size == 1 else size
        self._usable_bytes = self._page_bytes - data[20]

    def rows(self) -> Iterator[Row]:
        """Yield the complete rows of all tables, one page after another."""
        if self._page_bytes < 512 or self._usable_bytes < 480:
            return
        for begin in range(0, len(self._data) - self._page_bytes + 1, self._page_bytes):
            header = begin + (FILE_HEADER_BYTES if begin == 0 else 0)
            if self._data[header] != TABLE_LEAF:
                continue
            for number in range(int.from_bytes(self._data[header + 3 : header + 5], "big")):
                pointer = header + 8 + 2 * number
                cell = begin + int.from_bytes(self._data[pointer : pointer + 2], "big")
                try:
                    yield self._row(cell)
                except (IndexError, ValueError):
                    continue

    def _row(self, offset: int) -> Row:
        """Return the row that begins at `offset` in a page. Raises IndexError or ValueError if it is damaged."""
        payload_bytes, offset = self._varint(self._data, offset)
        number, offset = self._varint(self._data, offset)
        payload = self._payload(offset, payload_bytes)
        header_bytes, place = self._varint(payload, 0)
        kinds = []
        while place < header_bytes:
            kind, place = self._varint(payload, place)
            kinds.append(kind)
        values: list[Value] = []
        for kind in kinds:
            value, place = _value(payload, place, kind)
            values.append(value)
        return number, values

    def _payload(self, offset: int, payload_bytes: int) -> bytes:
        usable = self._usable_bytes
        if payload_bytes > MAX_PAYLOAD_BYTES:
            raise ValueError("a row is too large")
        local_bytes = payload_bytes
        if payload_bytes > usable - 35:
            least = (usable - 12) * 32 // 255 - 23
            local_bytes = least + (payload_bytes - least) % (usable - 4)
            local_bytes = local_bytes if local_bytes <= usable - 35 else least
        parts = [self._data[offset : offset + local_bytes]]
        missing = payload_bytes - local_bytes
        following = self._data[offset + local_bytes : offset + local_bytes + 4]
        while missing > 0:
            begin = (int.from_bytes(following, "big") - 1) * self._page_bytes
            if begin <= 0 or begin + self._page_bytes > len(self._data):
                raise ValueError("an overflow page is lost")
            following = self._data[begin : begin + 4]
            parts.append(self._data[begin + 4 : begin + 4 + min(missing, usable - 4)])
            missing -= usable - 4
        return b"".join(parts)

    def _varint(self, data: bytes, offset: int) -> tuple[int, int]:
        value = 0
        for count in range(8):
            byte = data[offset + count]
            value = value << 7 | byte & 0x7F
            if byte < 0x80:
                return value, offset + count + 1
        return value << 8 | data[offset + 8], offset + 9


def _value(payload: bytes, place: int, kind: int) -> tuple[Value, int]:
    if kind >= 12:
        end = place + (kind - 12) // 2
        content = payload[place:end]
        if end > len(payload):
            raise ValueError("a row is cut")
        return (content.decode("utf-8", "replace") if kind % 2 else content), end
    if kind in (8, 9):
        return kind - 8, place
    size = _INTEGER_BYTES.get(kind, 8 if kind == 7 else 0)
    return (int.from_bytes(payload[place : place + size], "big", signed=True) if kind in _INTEGER_BYTES else None), (
        place + size
    )


MAGIC = b"SQLite format 3\0"
JOURNAL = "-wal"
MAX_STEPS = 5_000_000_000
_STEPS_PER_CHECK = 10_000_000
_TABLES = ("messages", "topics")
_TOPICS = "SELECT id, name, type FROM topics LIMIT 100000"
_MESSAGES = "SELECT id, topic_id, timestamp, data FROM messages"
_FIRST = -(2**63)


def items(path: Path, scratch: Path) -> Iterator[Item]:
    """Yield the messages in the database. If the recorder did not close the database, the journal file also contains
    messages. SQLite then repairs a copy of the database and the journal.
    """
    journal = path.with_name(f"{path.name}{JOURNAL}")
    if journal.is_file() and 0 < journal.stat().st_size < MAX_FILE_BYTES:
        copy = scratch / "bag.db3"
        shutil.copyfile(path, copy)
        shutil.copyfile(journal, scratch / f"bag.db3{JOURNAL}")
        path, mode = copy, "mode=rw"
    else:
        mode = "mode=ro&immutable=1"
    if mode != "mode=rw" and (pages := _pages_of_truncated(path)) is not None:
        yield from _rows_in_pages(pages)
        return
    try:
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?{mode}", uri=True)) as database:
            yield from _rows(database)
    except sqlite3.Error as error:
        yield UnreadablePart(f"its database cannot be read: {error}")


def _pages_of_truncated(path: Path) -> SqlitePages | None:
    """Return the pages of a file that is shorter than its header states. Return None if the file has the stated
    length.
    """
    with open_plain_file(path) as file:
        header = file.read(FILE_HEADER_BYTES)
        if len(header) < FILE_HEADER_BYTES:
            return None
        page_bytes = int.from_bytes(header[16:18], "big")
        full_bytes = int.from_bytes(header[28:32], "big") * (65536 if page_bytes == 1 else page_bytes)
        size = path.stat().st_size
        return SqlitePages(header + file.read(MAX_FILE_BYTES)) if size < min(full_bytes, MAX_FILE_BYTES) else None


def _rows_in_pages(pages: SqlitePages) -> Iterator[Item]:
    """Yield the messages in the pages in order of time. Then yield an UnreadablePart that describes the damage."""
    topics: dict[Any, tuple[str, str]] = {}
    messages: dict[int, list[Any]] = {}
    for number, values in pages.rows():
        match values:
            case [None, str(name), str(kind), str(), *_]:
                topics[number] = name, kind
            case [None, int(), int(), bytes()]:
                messages.setdefault(number, values)
    if not topics:
        yield UnreadablePart("its database is truncated, and the list of topics is lost")
        return
    for _, (_, topic, time_ns, data) in sorted(messages.items()):
        yield _item(topics, topic, time_ns, data)
    yield UnreadablePart("its database is truncated: later messages cannot be read")


def _rows(database: sqlite3.Connection) -> Iterator[Item]:
    steps = iter(range(MAX_STEPS // _STEPS_PER_CHECK))
    database.set_progress_handler(lambda: next(steps, None) is None, _STEPS_PER_CHECK)
    database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_MESSAGE_BYTES)
    database.execute("PRAGMA trusted_schema = OFF")
    database.text_factory = lambda text: text.decode("utf-8", "replace")
    tables = database.execute("SELECT count(*) FROM sqlite_master WHERE type = 'table' AND name IN (?, ?)", _TABLES)
    if tables.fetchone() != (len(_TABLES),):
        yield UnreadablePart("it is not a ROS bag: the database has no tables messages and topics")
        return
    topics = {number: (str(name), str(kind)) for number, name, kind in database.execute(_TOPICS)}
    last = _FIRST
    try:
        for number, *row in database.execute(f"{_MESSAGES} ORDER BY id"):
            last = number
            yield _item(topics, *row)
        return
    except sqlite3.DatabaseError as error:
        problem = str(error)
    # Pages after a damaged one may be intact. They are read from the end.
    messages_behind: list[Item] = []
    kept_bytes = 0
    try:
        for _, topic, time_ns, data in database.execute(f"{_MESSAGES} WHERE id > ? ORDER BY id DESC", (last,)):
            messages_behind.append(_item(topics, topic, time_ns, data))
            kept_bytes += len(data) if isinstance(data, bytes) else 0
            if kept_bytes > MAX_CHUNK_BYTES:
                break
    except sqlite3.DatabaseError as error:
        problem = str(error)
    yield UnreadablePart(f"messages cannot be read here ({problem})")
    yield from reversed(messages_behind)


def _item(topics: dict[Any, tuple[str, str]], topic: Any, time_ns: Any, data: Any) -> Item:
    """Return the message in a database row. In a damaged file, values may have any type."""
    if topic not in topics or not isinstance(time_ns, int) or not isinstance(data, bytes):
        return UnreadablePart("a message is damaged")
    return RawMessage(*topics[topic], time_ns, data)
