"""Read the rows of a truncated SQLite file directly from its pages, because the index of the pages is lost.

SQLite finds rows through the inner pages of a tree. In a file that grew during a recording, inner pages are often
behind the pages with their rows. If the end of the file is lost, SQLite therefore finds no rows. Each leaf page,
however, contains its rows completely, except for the overflow pages of large ones. The format of pages is described in
https://www.sqlite.org/fileformat2.html.
"""

from collections.abc import Iterator

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
