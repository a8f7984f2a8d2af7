"""Reads traces from the field, life by life: whatever stands between damaged lines is used.

A life begins with a header line. A file may hold lives of several agents and missions, and begin in the midst of one.
"""

import base64
import binascii
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

from harness.archive.bounded_file import BoundedFile
from harness.archive.history import LATEST_S
from harness.archive.traces import MAX_LINE_BYTES, Gap, Header, parse_gap, parse_line
from harness.field.ingest._ingest import LeftOut
from ucp.messages import HEADER as DATAGRAM_HEADER
from ucp.messages import MAGIC
from ucp.trace import Commanded, Dropped, Entry, HandlerRun

MAX_TRACE_BYTES = 256 * 1024 * 1024
"""Of a larger file the beginning is read."""
MAX_LIVES = 1000
MAX_LOST = 1_000_000
MAX_PLACES = 1000
"""Damaged places that are kept apart."""
MAX_RUNS = 1_000_000
"""Of one file. Of 20 agents that hear everything, each has about a tenth of it in 2 hours."""
NOTHING_WITHIN_BYTES, NOTHING_WITHIN_LINES = 8 * 1024 * 1024, 100_000
"""A file that holds no line of a trace so far is none."""
ROUNDING_S = 2e-3
"""How far time may go back from line to line: a trace may have its times to the millisecond."""
FAR_AHEAD_S = 3600.0
"""Between two handler runs of a life, longer than any mission's agent stands idle."""
_PLACES_TOLD = 3
_BEGINNINGS = (b'{"t":', b'{"schema":', b'{"t" :', b'{"schema" :', b'{ "t":', b'{ "schema":')
_TELLING = (b'"handler"', b'"ucp-trace/', b'"dropped"', b'"command"')
_NULS = re.compile(rb"(\0+)")
_BOM = b"\xef\xbb\xbf"


@dataclass
class Life:
    """One life of an agent as far as its file has it. `header` is None where the line is lost."""

    path: Path
    header: Header | None
    first_line: int
    agent: int | None = None
    """Whose it is, as its source says."""
    counts: str = "line"
    """What its lines are called."""
    runs: list[HandlerRun] = field(default_factory=list)
    run_lines: list[int] = field(default_factory=list)
    asides: list[tuple[int, Dropped | Commanded]] = field(default_factory=list)
    aside_lines: list[int] = field(default_factory=list)
    gaps: list[Gap] = field(default_factory=list)
    jumps: list[int] = field(default_factory=list)
    cut_off: bool = False

    @property
    def agent_id(self) -> int | None:
        """By its header; else by the datagrams that it sent, or the file's name."""
        if self.header is not None:
            return self.header.agent_id
        if self.agent is not None:
            return self.agent
        for run in self.runs:
            for sent in run.sent:
                if sent.datagram is not None and (sender := _sender(sent.datagram.text)):
                    return sender
        name = self.path.name.partition(".")[0]
        return int(name) if name.isascii() and name.isdecimal() and len(name) <= 5 else None

    def add(self, entry: HandlerRun | Dropped | Commanded, line: int) -> None:
        if isinstance(entry, HandlerRun):
            if self.runs and _jumps(self.runs[-1], entry):
                self.jumps.append(len(self.runs))
            self.runs.append(entry)
            self.run_lines.append(line)
        else:
            self.asides.append((len(self.runs), entry))
            self.aside_lines.append(line)

    def numbered_asides(self) -> Iterator[tuple[tuple[int, Dropped | Commanded], int]]:
        return zip(self.asides, self.aside_lines, strict=True)

    def lose(self, lines: int, lost_bytes: int) -> None:
        """A line that says nothing; what is lost in a row is one gap."""
        position = len(self.runs)
        if self.gaps and self.gaps[-1].position == position:
            last = self.gaps.pop()
            lines, lost_bytes = lines + last.lines, lost_bytes + last.lost_bytes
        self.gaps.append(Gap(position, lines, lost_bytes))


def _jumps(before: HandlerRun, after: HandlerRun) -> bool:
    return not before.t - ROUNDING_S <= after.t <= before.t + FAR_AHEAD_S


def jumps_in(runs: list[HandlerRun]) -> list[int]:
    """Before which of these the agent's clock was set, as it seems."""
    return [position for position, pair in enumerate(pairwise(runs), 1) if _jumps(*pair)]


def read_lives(path: Path, left_out: list[LeftOut]) -> list[Life]:
    """The lives that are in a file, in its order; none if it is no trace. Raises OSError if it cannot be read."""
    reader = TraceReader(path)
    with BoundedFile(path, MAX_TRACE_BYTES) as file:
        for number, line, ended in _lines(file):
            reader.take(number, line, ended)
            if reader.hopeless:
                break
    lives = reader.ended(left_out)
    if lives and file.problem:
        left_out.append(LeftOut(path, file.problem))
    return lives


@dataclass
class _Damage:
    first: int
    last: int
    why: str

    def goes_on(self, line: int, why: str) -> bool:
        return line == self.last or (line == self.last + 1 and why == self.why)


class TraceReader:
    """Takes the lines of a trace one after another, whatever they are; `lives` are what they make."""

    def __init__(self, path: Path, agent_id: int | None = None, counts: str = "line") -> None:
        """`agent_id` is whose they are, if their source says it; `counts` what their numbers count."""
        self.path = path
        self._agent_id, self._counts = agent_id, counts
        self.lives: list[Life] = []
        self.hopeless = False
        self._read_bytes = self._lines = self._runs = self._lost = 0
        self._damaged: list[_Damage] = []
        self._cut_off: int | None = None

    def take(self, number: int, line: bytes, ended: bool = True) -> None:
        """The line with this number; one that did not end may be cut off."""
        self._read_bytes += len(line)
        self._lines += 1
        self.hopeless = not self.lives and (
            self._read_bytes > NOTHING_WITHIN_BYTES or self._lines > NOTHING_WITHIN_LINES
        )
        if self._runs == MAX_RUNS or len(self.lives) > MAX_LIVES or self._lost == MAX_LOST:
            if not self.hopeless:
                limit = f"{MAX_RUNS} handler runs, {MAX_LIVES} lives of agents, or {MAX_LOST} damaged lines"
                what = f"it and all later lines are not read: a trace has at most {limit}"
                self._damaged = [*self._damaged[:_PLACES_TOLD], _Damage(number, number, what)]
            self.hopeless = True
            return
        if number == 1:
            line = line.removeprefix(_BOM)
        if entry := _entry(line):
            self._add(entry, number)
            return
        pieces = [piece for piece in _NULS.split(line) if piece.strip()]
        for piece in pieces:
            if piece.startswith(b"\0"):
                self._lose(number, piece, "NUL bytes here, as after a loss of power")
            elif entry := _entry(piece):
                self._add(entry, number)
            elif lost := parse_gap(piece):
                self._was_lost(number, *lost)
            elif rescued := _rescued(piece):
                lost_bytes, at_its_end = rescued
                self._lose(number, piece[:lost_bytes], "it is damaged; its readable end is used")
                self._add(at_its_end, number)
            elif ended or piece is not pieces[-1]:
                self._lose(number, piece, "it is damaged" if _said(piece) is None else "its time cannot be")
            else:
                self._cut_off = number
        if not ended and self.lives and pieces and (self._cut_off or pieces[-1].startswith(b"\0")):
            self.lives[-1].cut_off = True

    def _add(self, entry: Header | Entry, number: int) -> None:
        if isinstance(entry, Header):
            self.lives.append(self._life(entry, number))
            return
        if not self.lives:
            self.lives.append(self._life(None, number))
            self.lives[-1].lose(0, 0)  # nobody knows what was before it
        self._runs += 1
        self.lives[-1].add(entry, number)

    def _life(self, header: Header | None, number: int) -> Life:
        return Life(self.path, header, number, self._agent_id, self._counts)

    def _lose(self, number: int, text: bytes, why: str) -> None:
        if b'"ucp-trace/' in text or b'"initial_data"' in text:
            self.lives.append(self._life(None, number))  # that was a header, whatever else it said
        elif self.lives:
            self.lives[-1].lose(0 if text.startswith(b"\0") else 1, len(text))
        self._lost += 1
        self._say(number, why)

    def _say(self, number: int, why: str) -> None:
        if self._damaged and (self._damaged[-1].goes_on(number, why) or len(self._damaged) > MAX_PLACES):
            self._damaged[-1].last = number
        else:
            self._damaged.append(_Damage(number, number, why))

    def lose_unseen(self) -> None:
        """Here lines may be lost, which nobody has seen."""
        if self.lives:
            self.lives[-1].lose(0, 0)

    def _was_lost(self, number: int, lines: int, lost_bytes: int) -> None:
        """Before this file was made, as an import says."""
        if self.lives:
            self.lives[-1].lose(lines, lost_bytes)
        what = "the part before this" if not lines else "1 line" if lines == 1 else f"{lines} lines"
        self._say(number, f"{what} {'were' if lines > 1 else 'was'} lost before this file was written")

    def ended(self, left_out: list[LeftOut]) -> list[Life]:
        """The lives; what was damaged is told if there are any."""
        lives = [life for life in self.lives if life.runs or life.asides or life.header]
        left_out += self._left_out() if lives else ()
        return lives

    def _left_out(self) -> Iterator[LeftOut]:
        for damage in self._damaged[:_PLACES_TOLD]:
            more = f", and so is the rest up to {self._counts} {damage.last}" if damage.last > damage.first else ""
            yield LeftOut(self.path, f"{damage.why}{more}", damage.first, self._counts)
        if rest := self._damaged[_PLACES_TOLD:]:
            places = "1 more place" if len(rest) == 1 else f"{len(rest)} more places"
            yield LeftOut(
                self.path,
                f"{places} in it {'is' if len(rest) == 1 else 'are'} damaged, the last at "
                f"{self._counts} {rest[-1].last}",
            )
        if self._cut_off is not None:
            yield LeftOut(self.path, "it is truncated at the end of the file", self._cut_off, self._counts)


def _lines(file: BoundedFile) -> Iterator[tuple[int, bytes, bool]]:
    """Number, text, and whether it ended. Of a line that is too long, what follows its last NUL, or its end."""
    number, kept = 1, b""
    while text := file.readline(MAX_LINE_BYTES):
        if not text.endswith(b"\n") and len(text) == MAX_LINE_BYTES:
            kept = (kept + text)[-MAX_LINE_BYTES:]
            continue
        yield number, kept + text, text.endswith(b"\n")
        number, kept = number + 1, b""
    if kept:
        yield number, kept, False


def _entry(line: bytes) -> Header | Entry | None:
    """What a line says, if it is whole and can be."""
    entry = _said(line)
    return entry if entry is None or isinstance(entry, Header) or 0 <= entry.t <= LATEST_S else None


def _said(line: bytes) -> Header | Entry | None:
    """What a line says, if it is whole, at whatever time."""
    if not any(word in line for word in _TELLING):
        return None
    try:
        entry = parse_line(line)
        if isinstance(entry, Header):
            base64.b64decode(entry.initial_data or "", validate=True)
    except ValueError:
        return None
    return entry


def _rescued(text: bytes) -> tuple[int, Header | Entry] | None:
    """Where a whole line begins in what begins with a part of another, or with nothing readable, and what it says."""
    begins = max(text.rfind(beginning) for beginning in _BEGINNINGS)
    entry = _entry(text[begins:]) if begins > 0 else None
    return None if entry is None else (begins, entry)


def _sender(datagram: str) -> int | None:
    try:
        data = base64.b64decode(datagram, validate=True)
    except (binascii.Error, ValueError):
        return None
    if len(data) < DATAGRAM_HEADER.size or not data.startswith(MAGIC):
        return None
    return int(DATAGRAM_HEADER.unpack_from(data)[3])
