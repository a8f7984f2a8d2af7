"""Read records from a CSV file with one record per row. A spreadsheet or a short program can write such a file.

The first row names the columns, in any order:

time_s   seconds since the Unix epoch, such as 1790000000.123456; may be empty for `trace` and `export`
agent    the agent's ID
kind     trace, sent, received, event or export
event    the event's ID, for `event` only
data     for `trace` a line of the agent's trace, and for `export` its chain export, both as JSON;
         for `sent` and `received` the datagram, and for `event` the event's data, in base64

The separator is a comma, a semicolon or a tab. A damaged row is omitted, and does not affect other rows, even if a
quote in it is never closed.
"""

import base64
import binascii
import csv
import re
from collections import deque
from collections.abc import Iterator
from decimal import Decimal, InvalidOperation
from pathlib import Path

from harness.archive.bounded_file import BoundedFile
from harness.archive.traces import MAX_LINE_BYTES
from harness.field.adapters.adapter import Adapter, ChainExport, Datagram, LoggedEvent, Observation, TraceLine, Unusable
from ucp.block import MAX_AGENT_ID

COLUMNS = ("time_s", "agent", "kind", "event", "data")
KINDS = ("trace", "sent", "received", "event", "export")
MAX_BYTES = 1024 * 1024 * 1024
MAX_LINES_OF_A_ROW = 20_000
"""Maximum number of lines that a row may take. A spreadsheet or a person may format an export over many lines."""
MAX_ROW_BYTES = 4 * MAX_LINE_BYTES
LAST_NS = 2**63 - 1
MAX_EVENT_ID = 254
_SEPARATORS = (",", ";", "\t")
_BOM = "\ufeff"


class CsvAdapter(Adapter):
    """The adapter for CSV files."""

    counts = "row"

    def recognises(self, source: Path, beginning: bytes) -> bool:
        return _layout(beginning.partition(b"\n")[0].decode("utf-8", "replace")) is not None

    def observations(self, source: Path) -> Iterator[Observation]:
        layout: _ColumnLayout | None = None
        with BoundedFile(source, MAX_BYTES) as file:
            for number, row in _rows(file):
                if layout is None:
                    layout = _layout(row)
                    if layout is None:
                        layout = _ColumnLayout(",", {name: place for place, name in enumerate(COLUMNS)})
                        yield Unusable(
                            f"it has no header with column names: the columns are read as {','.join(COLUMNS)}", number
                        )
                    else:
                        continue
                if row.strip("\0\r\n "):
                    yield _observation(layout.cells(row), number)
            if file.problem:
                yield Unusable(file.problem)


class _ColumnLayout:
    """The positions of the columns in a CSV file, and the separator."""

    def __init__(self, separator: str, places: dict[str, int]) -> None:
        self._separator = separator
        self._places = places

    def cells(self, row: str) -> dict[str, str] | None:
        """Return the cells of a row by column name. Return None if the row has fewer cells than the row of column
        names.
        """
        last = max(self._places.values())
        try:
            cells = next(csv.reader([row], delimiter=self._separator, strict=True), [])
        except csv.Error:
            cells = []
        if len(cells) != last + 1 and self._places["data"] == last:
            cells = row.rstrip("\r\n").split(self._separator, last)  # JSON without quotes
        if len(cells) <= last:
            return None
        return {name: cells[place] for name, place in self._places.items()}


def _layout(row: str) -> _ColumnLayout | None:
    for separator in _SEPARATORS:
        names = [name.strip(" \"'\r\n").lower() for name in row.removeprefix(_BOM).split(separator)]
        if {"agent", "kind", "data"} <= {*names}:
            return _ColumnLayout(separator, {name: names.index(name) for name in COLUMNS if name in names})
    return None


def _rows(file: BoundedFile) -> Iterator[tuple[int, str]]:
    """Yield each row together with the number of its first line.

    A row may extend over several lines inside a quoted cell.
    """
    read_ahead: deque[str] = deque()  # lines after a quote that did not close
    number = 0
    while line := read_ahead.popleft() if read_ahead else _line(file):
        number += 1
        if line.count('"') % 2 == 0:
            yield number, line
            continue
        row, row_bytes = [line], len(line)
        while len(row) <= MAX_LINES_OF_A_ROW and row_bytes <= MAX_ROW_BYTES:
            next_line = read_ahead.popleft() if read_ahead else _line(file)
            if not next_line:
                break
            row_bytes += len(next_line)
            row.append(next_line)
            if next_line.count('"') % 2:
                break
        if sum(each.count('"') for each in row) % 2 == 0 and not any(map(_starts_like_a_row, row[1:])):
            yield number, "".join(row)
            number += len(row) - 1
        else:
            yield number, line
            read_ahead.extendleft(reversed(row[1:]))


_KIND_CELL = re.compile(
    rf"""(?:^|[{"".join(_SEPARATORS)}])\s*"?(?:{"|".join(KINDS)})"?\s*[{"".join(_SEPARATORS)}]""", re.IGNORECASE
)


def _starts_like_a_row(line: str) -> bool:
    return _KIND_CELL.search(line[:100]) is not None


def _line(file: BoundedFile) -> str:
    return file.readline(MAX_ROW_BYTES).decode("utf-8", "replace")


def _observation(cells: dict[str, str] | None, row: int) -> Observation:
    if cells is None:
        return Unusable("the row is damaged: columns are missing, or a quote in it is not closed", row, of_a_trace=True)
    kind, data = cells["kind"].strip().lower(), cells["data"]
    if kind not in KINDS:
        return Unusable(f"its kind is {kind[:20]!r}: use one of {', '.join(KINDS)}", row, of_a_trace=True)
    if kind == "export":
        return ChainExport(data, row)
    agent = cells["agent"].strip()
    if not (agent.isascii() and agent.isdecimal() and len(agent) <= 6 and 1 <= int(agent) <= MAX_AGENT_ID):
        return Unusable(f"its agent is {agent[:20]!r}: use an ID from 1 to {MAX_AGENT_ID}", row, kind == "trace")
    if kind == "trace":
        return TraceLine(int(agent), data, row)
    time_ns = _time_ns(cells.get("time_s", ""))
    if time_ns is None:
        return Unusable(f"its time_s is {cells.get('time_s', '')[:20]!r}: use seconds since the Unix epoch", row)
    try:
        content = base64.b64decode(data.strip(), validate=True)
    except (binascii.Error, ValueError):
        return Unusable("its data is not base64", row)
    if kind != "event":
        return Datagram(int(agent), time_ns, kind == "sent", content, row)
    event = cells.get("event", "").strip()
    if not (event.isascii() and event.isdecimal() and len(event) <= 3 and 1 <= int(event) <= MAX_EVENT_ID):
        return Unusable(f"its event is {event[:20]!r}: use an ID from 1 to {MAX_EVENT_ID}", row)
    return LoggedEvent(int(agent), time_ns, int(event), content, row)


def _time_ns(text: str) -> int | None:
    if len(text) > 40:
        return None
    try:
        time_ns = Decimal(text.strip()) * 1_000_000_000
        return int(time_ns) if time_ns.is_finite() and 0 <= time_ns <= LAST_NS else None
    except InvalidOperation:
        return None
