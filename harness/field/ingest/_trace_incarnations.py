"""Read damaged traces from the field. Divide them at restarts of the agent, and use every undamaged line.

A header line begins an incarnation. A file may contain incarnations of several agents and missions, and may begin in
the middle of one.
"""

import base64
import binascii
import re
from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

from harness.archive.bounded_file import BoundedFile
from harness.archive.history import LATEST_S
from harness.archive.traces import MAX_LINE_BYTES, TraceGap, TraceHeader, parse_gap, parse_line
from harness.field.ingest._ingest import UnusedPart
from harness.field.ingest._line_order import in_order
from ucp.messages import HEADER as DATAGRAM_HEADER
from ucp.messages import MAGIC
from ucp.trace import CommandEntry, DroppedDatagram, Entry, HandlerRun

MAX_TRACE_BYTES = 256 * 1024 * 1024
"""Maximum number of bytes that are read from a file. The rest of a larger file is ignored."""
MAX_INCARNATIONS = 1000
MAX_DAMAGED = 1_000_000
MAX_PLACES = 1000
"""Maximum number of damaged places that are listed one by one."""
MAX_RUNS = 1_000_000
"""Maximum number of handler runs in a file. In a swarm of 20 agents without loss, a trace reaches about a tenth of this
number in 2 hours.
"""
MAX_BYTES_BEFORE_TRACE, MAX_LINES_BEFORE_TRACE = 8 * 1024 * 1024, 100_000
"""Maximum number of bytes and of lines before the first valid line of a trace. A file that exceeds one of these limits
is not a trace.
"""
ROUNDING_S = 2e-3
"""Tolerance in seconds for a line whose time is earlier than the time of the previous line. Such times occur because an
agent may round times to milliseconds.
"""
FAR_AHEAD_S = 3600.0
"""Maximum number of seconds between two handler runs of an incarnation. No agent is idle for longer."""
_MAX_LISTED = 3
_BEGINNINGS = (b'{"t":', b'{"schema":', b'{"t" :', b'{"schema" :', b'{ "t":', b'{ "schema":')
_MARKERS = (b'"handler"', b'"ucp-trace/', b'"dropped"', b'"command"')
_NULS = re.compile(rb"(\0+)")
_BOM = b"\xef\xbb\xbf"


@dataclass
class TraceIncarnation:
    """The part of a trace between two restarts of its agent. `header` is None if the header line is lost."""

    path: Path
    header: TraceHeader | None
    first_line: int
    agent: int | None = None
    """The agent ID, if the source of the lines determines it. None otherwise."""
    counts: str = "line"
    """The unit of line numbers, such as "line" or "message"."""
    runs: list[HandlerRun] = field(default_factory=list)
    run_lines: list[int] = field(default_factory=list)
    asides: list[tuple[int, DroppedDatagram | CommandEntry]] = field(default_factory=list)
    aside_lines: list[int] = field(default_factory=list)
    gaps: list[TraceGap] = field(default_factory=list)
    jumps: list[int] = field(default_factory=list)
    cut_off: bool = False

    @property
    def agent_id(self) -> int | None:
        """The ID of the agent. The first known source is used: the header, the source of the lines, the sent datagrams,
        or the file name. The value is None if no source contains the ID.
        """
        if self.header is not None:
            return self.header.agent_id
        if self.agent is not None:
            return self.agent
        if (sender := next(self.senders(), None)) is not None:
            return sender
        name = self.path.name.partition(".")[0]
        return int(name) if name.isascii() and name.isdecimal() and len(name) <= 5 else None

    def senders(self) -> Iterator[int]:
        """Yield the agent ID in each sent datagram."""
        for run in self.runs:
            for sent in run.sent:
                if sent.datagram is not None and (sender := _sender(sent.datagram.text)):
                    yield sender

    def add(self, entry: HandlerRun | DroppedDatagram | CommandEntry, line: int) -> None:
        if isinstance(entry, HandlerRun):
            if self.runs and _jumps(self.runs[-1], entry):
                self.jumps.append(len(self.runs))
            self.runs.append(entry)
            self.run_lines.append(line)
        else:
            self.asides.append((len(self.runs), entry))
            self.aside_lines.append(line)

    def numbered_asides(self) -> Iterator[tuple[tuple[int, DroppedDatagram | CommandEntry], int]]:
        return zip(self.asides, self.aside_lines, strict=True)

    def add_gap(self, lines: int, lost_bytes: int) -> None:
        """Record that lines are lost or damaged. If these lines directly follow other lost lines, both form one gap."""
        position = len(self.runs)
        if self.gaps and self.gaps[-1].position == position:
            last = self.gaps.pop()
            lines, lost_bytes = lines + last.lines, lost_bytes + last.lost_bytes
        self.gaps.append(TraceGap(position, lines, lost_bytes))

    def put_in_order(self) -> Iterator[UnusedPart]:
        """Repair the order of lines, and remove repeated lines. Yield an entry for each repair."""
        order, places = in_order(self.runs)
        if not places:
            return
        for place in places:
            lines = self.run_lines[place.first], self.run_lines[place.last]
            what = place.why if lines[0] == lines[1] else f"{place.why} (up to {self.counts} {lines[1]})"
            yield UnusedPart(self.path, what, lines[0], self.counts)
        kept = sorted(order)
        self.asides = [(bisect_left(kept, position), aside) for position, aside in self.asides]
        self.gaps = [gap._replace(position=bisect_left(kept, gap.position)) for gap in self.gaps]
        self.runs, self.run_lines = [self.runs[n] for n in order], [self.run_lines[n] for n in order]
        self.jumps = jumps_in(self.runs)


def _jumps(before: HandlerRun, after: HandlerRun) -> bool:
    return not before.t - ROUNDING_S <= after.t <= before.t + FAR_AHEAD_S


def jumps_in(runs: list[HandlerRun]) -> list[int]:
    """Return the positions of handler runs before which the agent's clock was probably changed."""
    return [position for position, pair in enumerate(pairwise(runs), 1) if _jumps(*pair)]


def read_incarnations(path: Path, left_out: list[UnusedPart]) -> list[TraceIncarnation]:
    """Return the parts of a trace between restarts, in order. The list is empty if the file is not a trace. Raises
    OSError.
    """
    reader = TraceReader(path)
    with BoundedFile(path, MAX_TRACE_BYTES) as file:
        for number, line, finish in _lines(file):
            reader.add_line(number, line, finish)
            if reader.gave_up:
                break
    incarnations = reader.finish(left_out)
    if incarnations and file.problem:
        left_out.append(UnusedPart(path, file.problem))
    return incarnations


@dataclass
class _DamagedLines:
    first: int
    last: int
    why: str

    def continues(self, line: int, why: str) -> bool:
        return line == self.last or (line == self.last + 1 and why == self.why)


class TraceReader:
    """A reader for the lines of a trace in any condition. `incarnations` contains the incarnations that were read so
    far.

    `gave_up` is true if a limit is exceeded, so that further lines are not needed.
    """

    def __init__(self, path: Path, agent_id: int | None = None, counts: str = "line") -> None:
        """Create a reader for one trace.

        `agent_id` is the ID of the agent, or None if the source does not determine it. The reader's messages use the
        word `counts` for one entry of the trace, for example "line".
        """
        self.path = path
        self._agent_id, self._counts = agent_id, counts
        self.incarnations: list[TraceIncarnation] = []
        self.gave_up = False
        self._read_bytes = self._lines = self._runs = self._lost = 0
        self._damaged: list[_DamagedLines] = []
        self._cut_off: int | None = None

    def add_line(self, number: int, line: bytes, finish: bool = True) -> None:
        """Read one line. A line without a line end may be truncated."""
        self._read_bytes += len(line)
        self._lines += 1
        self.gave_up = not self.incarnations and (
            self._read_bytes > MAX_BYTES_BEFORE_TRACE or self._lines > MAX_LINES_BEFORE_TRACE
        )
        if self._runs == MAX_RUNS or len(self.incarnations) > MAX_INCARNATIONS or self._lost == MAX_DAMAGED:
            if not self.gave_up:
                limit = f"{MAX_RUNS} handler runs, {MAX_INCARNATIONS} lives of agents, or {MAX_DAMAGED} damaged lines"
                what = f"it and all later lines are not read: a trace has at most {limit}"
                self._damaged = [*self._damaged[:_MAX_LISTED], _DamagedLines(number, number, what)]
            self.gave_up = True
            return
        if number == 1:
            line = line.removeprefix(_BOM)
        if entry := _entry(line):
            self._add(entry, number)
            return
        pieces = [piece for piece in _NULS.split(line) if piece.strip()]
        for piece in pieces:
            if piece.startswith(b"\0"):
                self._add_damaged(number, piece, "NUL bytes here, as after a loss of power")
            elif entry := _entry(piece):
                self._add(entry, number)
            elif lost := parse_gap(piece):
                self._add_earlier_gap(number, *lost)
            elif recovered := _recover_tail(piece):
                lost_bytes, tail_entry = recovered
                self._add_damaged(number, piece[:lost_bytes], "it is damaged; its readable end is used")
                self._add(tail_entry, number)
            elif finish or piece is not pieces[-1]:
                self._add_damaged(number, piece, "it is damaged" if _parse(piece) is None else "its time cannot be")
            else:
                self._cut_off = number
        if not finish and self.incarnations and pieces and (self._cut_off or pieces[-1].startswith(b"\0")):
            self.incarnations[-1].cut_off = True

    def _add(self, entry: TraceHeader | Entry, number: int) -> None:
        if isinstance(entry, TraceHeader):
            self.incarnations.append(self._new_incarnation(entry, number))
            return
        if not self.incarnations:
            self.incarnations.append(self._new_incarnation(None, number))
            self.incarnations[-1].add_gap(0, 0)  # earlier lines may be lost
        self._runs += 1
        self.incarnations[-1].add(entry, number)

    def _new_incarnation(self, header: TraceHeader | None, number: int) -> TraceIncarnation:
        return TraceIncarnation(self.path, header, number, self._agent_id, self._counts)

    def _add_damaged(self, number: int, text: bytes, why: str) -> None:
        if b'"ucp-trace/' in text or b'"initial_data"' in text:
            self.incarnations.append(self._new_incarnation(None, number))  # the damaged line was a header
        elif self.incarnations:
            self.incarnations[-1].add_gap(0 if text.startswith(b"\0") else 1, len(text))
        self._lost += 1
        self._report(number, why)

    def _report(self, number: int, why: str) -> None:
        if self._damaged and (self._damaged[-1].continues(number, why) or len(self._damaged) > MAX_PLACES):
            self._damaged[-1].last = number
        else:
            self._damaged.append(_DamagedLines(number, number, why))

    def add_unknown_gap(self) -> None:
        """Record that lines may be lost at this place."""
        if self.incarnations:
            self.incarnations[-1].add_gap(0, 0)

    def _add_earlier_gap(self, number: int, lines: int, lost_bytes: int) -> None:
        """Record lost lines that an earlier import of this trace already reported at this place."""
        if self.incarnations:
            self.incarnations[-1].add_gap(lines, lost_bytes)
        what = "something here" if not lines else "1 line" if lines == 1 else f"{lines} lines"
        self._report(number, f"{what} {'were' if lines > 1 else 'was'} lost before this file was written")

    def finish(self, left_out: list[UnusedPart]) -> list[TraceIncarnation]:
        """Return the incarnations of the trace. If the trace has incarnations, add descriptions of its damage to
        `left_out`.
        """
        incarnations = [life for life in self.incarnations if life.runs or life.asides or life.header]
        incarnations = self._before_mixed_lines(incarnations, left_out)
        left_out += self._left_out() if incarnations else ()
        places = [place for incarnation in incarnations for place in incarnation.put_in_order()]
        left_out += places[:_MAX_LISTED]
        if len(places) > _MAX_LISTED:
            left_out.append(
                UnusedPart(self.path, f"{len(places) - _MAX_LISTED} more places have lines in the wrong order")
            )
        return incarnations

    def _before_mixed_lines(
        self, incarnations: list[TraceIncarnation], left_out: list[UnusedPart]
    ) -> list[TraceIncarnation]:
        """Return the parts of the trace before the place at which the lines of several agents become mixed in the file.

        Trace lines do not name their agent, so mixed lines cannot be used. Lines are mixed if one part sent datagrams
        with the ID of another agent whose header is also in the file.
        """
        agents = {life.header.agent_id for life in incarnations if life.header is not None}
        for position, life in enumerate(incarnations if len(agents) > 1 else ()):
            others = {*life.senders()} & agents - {life.agent_id}
            if others:
                for earlier in {before.agent_id: before for before in incarnations[:position]}.values():
                    earlier.add_gap(0, 0)
                mixed = ", ".join(map(str, sorted({*others, life.agent_id or 0} - {0})))
                why = f"from here on, the lines of agents {mixed} are mixed, and none of them is used"
                left_out.append(UnusedPart(self.path, why, life.first_line, self._counts))
                return incarnations[:position]
        return incarnations

    def _left_out(self) -> Iterator[UnusedPart]:
        for damage in self._damaged[:_MAX_LISTED]:
            more = f", and so is the rest up to {self._counts} {damage.last}" if damage.last > damage.first else ""
            yield UnusedPart(self.path, f"{damage.why}{more}", damage.first, self._counts)
        if rest := self._damaged[_MAX_LISTED:]:
            places = "1 more place" if len(rest) == 1 else f"{len(rest)} more places"
            yield UnusedPart(
                self.path,
                f"{places} in it {'is' if len(rest) == 1 else 'are'} damaged, the last at "
                f"{self._counts} {rest[-1].last}",
            )
        if self._cut_off is not None:
            yield UnusedPart(self.path, "it is truncated at the end of the file", self._cut_off, self._counts)


def _lines(file: BoundedFile) -> Iterator[tuple[int, bytes, bool]]:
    """Yield each line as a triple: its number, its content, and whether it has a line end. If a line is too long, only
    its last part is yielded.
    """
    number, kept = 1, b""
    while text := file.readline(MAX_LINE_BYTES):
        if not text.endswith(b"\n") and len(text) == MAX_LINE_BYTES:
            kept = (kept + text)[-MAX_LINE_BYTES:]
            continue
        yield number, kept + text, text.endswith(b"\n")
        number, kept = number + 1, b""
    if kept:
        yield number, kept, False


def _entry(line: bytes) -> TraceHeader | Entry | None:
    """Return the entry in a line. Return None if the entry is incomplete or has an impossible time."""
    entry = _parse(line)
    return entry if entry is None or isinstance(entry, TraceHeader) or 0 <= entry.t <= LATEST_S else None


def _parse(line: bytes) -> TraceHeader | Entry | None:
    """Return the entry in a line without a check of its time. Return None if the entry is incomplete."""
    if not any(word in line for word in _MARKERS):
        return None
    try:
        entry = parse_line(line)
        for text in _texts_in_base64(entry):
            base64.b64decode(text, validate=True)
    except ValueError:
        return None
    return entry


def _texts_in_base64(entry: TraceHeader | Entry) -> Iterator[str]:
    if isinstance(entry, TraceHeader):
        yield entry.initial_data or ""
    elif isinstance(entry, HandlerRun):
        yield from (record.text for record in (entry.input, entry.sealed) if record is not None)
        yield from (sent.datagram.text for sent in entry.sent if sent.datagram is not None)


def _recover_tail(text: bytes) -> tuple[int, TraceHeader | Entry] | None:
    """Search for a complete entry at the end of a damaged line. Return its position and content, or None."""
    start = max(text.rfind(beginning) for beginning in _BEGINNINGS)
    entry = _entry(text[start:]) if start > 0 else None
    return None if entry is None else (start, entry)


def _sender(datagram: str) -> int | None:
    try:
        data = base64.b64decode(datagram, validate=True)
    except (binascii.Error, ValueError):
        return None
    if len(data) < DATAGRAM_HEADER.size or not data.startswith(MAGIC):
        return None
    return int(DATAGRAM_HEADER.unpack_from(data)[3])
