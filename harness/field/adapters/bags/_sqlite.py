"""Read ROS bags of version 2 in SQLite files (rosbag2_storage_sqlite3), in order of time."""

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
from harness.field.adapters.bags._sqlite_pages import FILE_HEADER_BYTES, SqlitePages
from ucp.plain_file import open_plain_file

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
