"""Read traces (`ucp-trace/2` and `/1`). A trace contains the handler runs of one agent, and the changes of the blocks
that it held.

If a trace ends in the middle of a line, its agent was killed. The lines before the incomplete line are used. Other
damage is reported in `problem`, and the lines before the damage are used.
"""

import json
import re
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate, compress, islice, pairwise
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, model_validator

from harness.archive.trace_files import open_trace
from harness.errors import RunDirectoryError
from ucp.plain_file import check_weight, parse_json
from ucp.trace import CommandEntry, DroppedDatagram, Entry, HandlerRun

MAX_LINE_BYTES = 2 * 1024 * 1024
MAX_LINE_WEIGHT = 100_000
LARGEST = 2**64
"""Limit of integers in a header. A larger integer does not fit into 64 bits, so it cannot be a setting."""
PLACES = ("chain", "deque", "stack")
_HEADER_KEYS = ("schema", "agent_id", "roster", "initial_data", "settings", "clock", "secured")


Version = Literal["ucp-trace/1", "ucp-trace/2"]


Record = TypeVar("Record")


class TraceHeader(BaseModel):
    """The header of a trace. `initial_data` is in base64. It is None in version 1 of the format, which does not record
    complete inputs.

    In a `secured` mission, agents encrypt each datagram, but the trace records the datagram without encryption. The
    datagram on the network was therefore longer. An agent may have dropped a datagram that looks valid in the trace.
    """

    model_config = ConfigDict(extra="ignore", populate_by_name=True, defer_build=True)

    schema_: Version = Field(default="ucp-trace/1", alias="schema")
    agent_id: int
    roster: list[int]
    settings: dict[str, Any]
    clock: dict[str, Any]
    initial_data: str | None = None
    secured: bool | None = None

    @model_validator(mode="after")
    def _complete(self) -> "TraceHeader":
        if self.has_inputs and self.initial_data is None:
            raise ValueError("initial_data is missing")
        if any(
            type(value) is int and abs(value) >= LARGEST for value in (*self.settings.values(), *self.clock.values())
        ):
            raise ValueError("a number is larger than any setting or clock can be")
        return self

    def to_line(self) -> str:
        """Return the header as a line of a trace file."""
        fields = self.model_dump(by_alias=True)
        in_order = {name: fields[name] for name in _HEADER_KEYS if fields[name] is not None}
        return json.dumps(in_order, separators=(",", ":")) + "\n"

    @property
    def has_inputs(self) -> bool:
        """True if the trace records each input of the agent completely."""
        return self.schema_ != "ucp-trace/1"


class _VersionedHeader(TraceHeader):
    schema_: Version = Field(alias="schema")


_ONLY_RECEIVES = re.compile(
    rb"""
    \{"t":(?!0\d)\d{1,6}(?:\.\d+)?,"handler":"receive_\w+","algorithm":(?!0)\d{1,2},
    "trigger":\{"message":"[\w ]+","from":(?!0)\d{1,5},"seq":(?!0\d)\d{1,9}\},(?:"input":"[\w+/=]*",)?
    "branch":"[\w ]*","changes":\[\],
    "sent":\[(?:\{"message":"[\w ]+","seq":(?!0\d)\d{1,9},"block":(?:null|"[0-9a-f]*")
    (?:,"datagram":"[\w+/=]*")?\}(?:,(?!\]))?)*\],
    (?:"tally":\{(?:"(?:yes|no)":(?!0\d)\d{1,9}(?:,(?!\}))?|"[0-9a-f]*":\[(?!0\d)\d{1,9},(?!0\d)\d{1,20}\](?:,(?!\}))?)*\},)?
    "state":\{"chain":(?!0\d)\d{1,9},"deque":(?!0\d)\d{1,9},"stack":(?!0\d)\d{1,9},
    "reconciling":(?:true|false),"idle":(?:true|false),"top":"[0-9a-f]*"\}\}\n""",
    re.VERBOSE,
)
"""A pattern for the line of a handler run that received a message and changed nothing. The pattern matches only lines
in the form that this project's agents write. A line that matches is valid, and is not validated again.
"""

_LOST = re.compile(rb'\{"lost_lines":(\d{1,9}),"lost_bytes":(\d{1,12})\}')

HEADER: TypeAdapter[TraceHeader] = TypeAdapter(_VersionedHeader)
HANDLER_RUN = TypeAdapter(HandlerRun)
ASIDE = TypeAdapter(DroppedDatagram | CommandEntry)


def read_clock(path: Path) -> dict[str, object]:
    """Return the clock in the header of a trace. Return an empty clock if the header cannot be read."""
    try:
        with open_trace(path) as file:
            return _validate(HEADER, file.readline(MAX_LINE_BYTES)).clock
    except (OSError, ValueError):
        return {}


class TraceGap(NamedTuple):
    """A place in a trace at which lines are missing or damaged. `position` is the number of handler runs before this
    place. `lines` is the number of unreadable lines in the file, and `lost_bytes` is the size of their unreadable
    parts. The number of lines that were never written is unknown.
    """

    position: int
    lines: int
    lost_bytes: int


@dataclass
class Trace:
    """The trace of one agent, including all its restarts.

    `starts` contains, for each incarnation after the first, the index in `runs` of its first handler run. `asides`
    contains the entries that are no handler runs. Each aside is stored with the number of handler runs that precede it.
    A trace from the field (`harness.field.ingest`) may have `gaps`. The trace of a run has no gaps, because reading
    ends at the first damaged line.
    """

    header: TraceHeader
    runs: list[HandlerRun] = field(default_factory=list)
    starts: list[int] = field(default_factory=list)
    asides: list[tuple[int, DroppedDatagram | CommandEntry]] = field(default_factory=list)
    problem: str | None = None
    cut_off: bool = False
    """True if the file ends in the middle of a line. This line is not read."""
    gaps: list[TraceGap] = field(default_factory=list)
    jumps: list[int] = field(default_factory=list)
    """Indices in `runs` of the handler runs before which the time decreases, or increases by a large amount. The
    agent's clock was probably set before these handler runs.
    """
    lines: tuple[Sequence[int], Sequence[int]] | None = None
    """The line numbers in the file: those of the entries in `runs`, and those of the entries in `asides`. None if the
    line numbers follow from the positions, because each line of the file is a header or one of these entries.
    """

    def incarnations(self) -> Iterator[Iterator[tuple[int, HandlerRun]]]:
        """Yield the handler runs of each incarnation (the time between two restarts), together with their line numbers,
        counted from 1.

        Each incarnation begins with a header line.
        """
        bounds = [0, *self.starts, len(self.runs)]
        for incarnation, (start, end) in enumerate(pairwise(bounds), 1):
            yield self._numbered(start, end, incarnation)

    def _numbered(self, start: int, end: int, incarnation: int) -> Iterator[tuple[int, HandlerRun]]:
        if self.lines is not None:
            return zip(islice(self.lines[0], start, end), islice(self.runs, start, end), strict=True)
        if not self.asides:
            return enumerate(islice(self.runs, start, end), start + incarnation + 1)
        before = [position for position, _ in self.asides]
        return (
            (number + incarnation + 1 + bisect_right(before, number), run)
            for number, run in enumerate(islice(self.runs, start, end), start)
        )

    def numbered_asides(self) -> Iterator[tuple[int, DroppedDatagram | CommandEntry]]:
        """Yield the lines about dropped datagrams and about commands, with their line numbers."""
        if self.lines is not None:
            yield from zip(self.lines[1], (aside for _, aside in self.asides), strict=True)
            return
        for count, (position, aside) in enumerate(self.asides, 1):
            yield position + 1 + bisect_right(self.starts, position) + count, aside

    def dropped(self) -> Counter[str]:
        """Return the number of dropped datagrams by reason. The numbers include datagrams that the agent only counted
        and did not write to the trace.
        """
        counts: Counter[str] = Counter()
        for _, aside in self.asides:
            if isinstance(aside, DroppedDatagram):
                counts[aside.dropped] += aside.count
        return counts

    def extend(self, entries: Iterable[Entry]) -> None:
        """Append further entries to the trace."""
        for entry in entries:
            if isinstance(entry, HandlerRun):
                self.runs.append(entry)
            else:
                self.asides.append((len(self.runs), entry))

    def entries(self) -> Iterator[TraceHeader | TraceGap | Entry]:
        """Yield all entries of the trace in order.

        The header is repeated for each incarnation. A gap stands for missing lines.
        """
        starts = Counter([0, *self.starts])
        gaps = {gap.position: gap for gap in self.gaps}
        positions = [position for position, _ in self.asides]
        next_aside = 0
        for position in range(len(self.runs) + 1):
            yield from [self.header] * starts[position]
            if position in gaps:
                yield gaps[position]
            until = bisect_left(positions, position + 1, next_aside)
            yield from (aside for _, aside in self.asides[next_aside:until])
            next_aside = until
            if position < len(self.runs):
                yield self.runs[position]

    def skimmed(self) -> "Trace":
        """Return the trace without the handler runs that only received a message.

        Do not use line numbers of the returned trace, because its method `incarnations` yields wrong ones.
        """
        kept = [not only_receives(run) for run in self.runs]
        before = [0, *accumulate(kept)]
        return replace(
            self,
            runs=[run for run, keep in zip(self.runs, kept, strict=True) if keep],
            starts=[before[start] for start in self.starts],
            asides=[(before[position], aside) for position, aside in self.asides],
            gaps=[gap._replace(position=before[gap.position]) for gap in self.gaps],
            jumps=[before[position] for position in self.jumps],
            lines=self.lines and ([*compress(self.lines[0], kept)], self.lines[1]),
        )

    def completed(self) -> list[str]:
        """Return the hashes of the blocks that the agent completed, in order."""
        return [block for run in self.runs for operation, block in run.changes if operation == "complete"]

    def chain_changed_at(self) -> float:
        """Return the mission second of the last change of the chain. Return 0 if the chain never changed."""
        return max(
            (run.t for run in self.runs if any("chain" in operation for operation, _ in run.changes)), default=0.0
        )


class HeldBlocks:
    """The blocks that an agent holds: for each block, its places, the number of copies, and whether the agent completed
    it.
    """

    def __init__(self) -> None:
        self.places: dict[str, Counter[str]] = {place: Counter() for place in PLACES}
        self.size = dict.fromkeys(PLACES, 0)
        """Name of a place, such as the chain -> number of blocks in this place."""
        self.copies: Counter[str] = Counter()
        self.completed: dict[str, None] = {}
        self.not_in_chain: set[str] = set()
        """Completed blocks that are not in the chain."""
        self.impossible: str | None = None
        """A description of an impossible change in the last handler run, for example the removal of a block that the
        agent did not hold. None if all changes were possible.
        """

    def replay(self, run: HandlerRun) -> None:
        """Apply the changes of the next handler run to the blocks. Use a separate object for each incarnation."""
        self.impossible = None
        for operation, block in run.changes:
            if operation == "complete":
                self.completed[block] = None
                self.not_in_chain.add(block)
                continue
            place, sign = operation[:-1], operation[-1:]
            if place not in self.places or sign not in ("+", "-"):
                self.impossible = f"unknown operation {operation!r}"
                continue
            if sign == "+":
                self.places[place][block] += 1
                self.size[place] += 1
                self.copies[block] += 1
                if place == "chain":
                    self.not_in_chain.discard(block)
            elif self.places[place][block] < 1:
                self.impossible = f"{block[:12]} leaves the {place}, but was not in it"
            else:
                self.places[place][block] -= 1
                self.size[place] -= 1
                self.copies[block] -= 1
                if place == "chain" and block in self.completed and not self.places[place][block]:
                    self.not_in_chain.add(block)


def parse_line(line: bytes) -> TraceHeader | Entry:
    """Return the content of a trace line. Raises ValueError if the line is invalid."""
    if b'"handler"' in line:
        return _validate(HANDLER_RUN, line)
    return _validate(ASIDE, line) if b'"schema"' not in line else _validate(HEADER, line)


def _validate(kind: TypeAdapter[Record], line: bytes) -> Record:
    """Return the record in a line. Raises ValueError if the line is invalid."""
    check_weight(line, MAX_LINE_WEIGHT)
    return kind.validate_json(line)


def gap_line(gap: TraceGap) -> str:
    """Return the line that replaces lost lines in an imported trace.

    Programs that read only handler runs stop at this line.
    """
    return f'{{"lost_lines":{gap.lines},"lost_bytes":{gap.lost_bytes}}}\n'


def parse_gap(line: bytes) -> tuple[int, int] | None:
    """Return the numbers of lost lines and lost bytes if this line replaces lost lines. Return None for any
    other line.
    """
    match = _LOST.fullmatch(line.strip())
    return None if match is None else (int(match[1]), int(match[2]))


def only_receives(run: HandlerRun) -> bool:
    """Return true if the handler received a message and changed nothing."""
    return not run.changes and run.handler.startswith("receive_")


def why_not_a_trace(path: Path) -> str:
    """Return the reason why the beginning of a file is not that of a readable trace."""
    try:
        with open_trace(path) as file:
            header = parse_json(file.readline(MAX_LINE_BYTES))
    except OSError as error:
        return f"cannot be read: {error.strerror}"
    except ValueError:
        return "not a trace"
    schema = header.get("schema") if isinstance(header, dict) else None
    if not isinstance(schema, str) or schema in get_args(Version):
        return "not a trace"
    return f"its schema is {schema[:40]!r}, and this version reads {' and '.join(map(repr, get_args(Version)))}"


def read_trace(path: Path, *, skim: bool = False) -> Trace | None:
    """Read the trace at `path`. Return None if the file does not exist, or does not begin like a trace.

    If `skim` is true, handler runs that only received a message are skipped without validation. The line numbers that
    `incarnations` yields are then wrong.
    """
    trace: Trace | None = None
    try:
        with open_trace(path) as file:
            number = 0
            while line := file.readline(MAX_LINE_BYTES):
                number += 1
                if not line.endswith(b"\n"):
                    if trace is not None and len(line) == MAX_LINE_BYTES:
                        trace.problem = f"line {number} is too long"
                    elif trace is not None:
                        trace.cut_off = True
                    break
                if skim and trace is not None and _ONLY_RECEIVES.fullmatch(line):
                    continue
                try:
                    entry = parse_line(line) if trace else _validate(HEADER, line)
                    if trace is None:
                        assert isinstance(entry, TraceHeader)
                        trace = Trace(entry)
                    elif not isinstance(entry, TraceHeader):
                        trace.extend((entry,))
                    elif entry == trace.header:
                        trace.starts.append(len(trace.runs))
                    else:
                        trace.problem = f"line {number} is the header of another agent, or of another run"
                        break
                except ValueError:
                    if trace is not None:
                        lost = parse_gap(line)
                        trace.problem = f"line {number} is damaged" if lost is None else f"lines are lost at {number}"
                    break
            if trace is not None and file.problem:
                trace.problem, trace.cut_off = file.problem, False
    except OSError:
        return None
    return trace


class HandlerRunLine(NamedTuple):
    """A trace line with a handler run. Line numbers and restarts count from 1."""

    path: Path
    number: int
    agent_id: int
    incarnation: int
    text: bytes

    def parse(self) -> HandlerRun:
        """Return the handler run in the line. Raises RunDirectoryError if the line is invalid."""
        return _validated(HANDLER_RUN, self.path, self.number, self.text)


def read_trace_lines(path: Path) -> Iterator[HandlerRunLine]:
    """Yield the lines with handler runs. An incomplete last line is skipped, because the agent was killed while it
    wrote the line.

    Raises RunDirectoryError at an invalid line, or if the file cannot be read or is empty.
    """
    incarnation = number = agent_id = 0
    try:
        with open_trace(path) as file:
            while text := file.readline(MAX_LINE_BYTES):
                number += 1
                if not text.endswith(b"\n") and len(text) < MAX_LINE_BYTES:
                    break
                if incarnation and b'"handler"' in text:
                    yield HandlerRunLine(path, number, agent_id, incarnation, text)
                elif incarnation and b'"schema"' not in text:
                    _validated(ASIDE, path, number, text)
                else:
                    agent_id = _validated(HEADER, path, number, text).agent_id
                    incarnation += 1
    except OSError as error:
        raise RunDirectoryError(
            f"{path}: cannot be read ({error.strerror}), and a comparison needs it: play the run again"
        ) from None
    if not incarnation:
        raise RunDirectoryError(f"{path}: it is empty, and a comparison needs it: play the run again")


def _validated(kind: TypeAdapter[Record], path: Path, number: int, text: bytes) -> Record:
    try:
        return _validate(kind, text)
    except ValueError:
        raise RunDirectoryError(
            f"{path}: line {number} is damaged, or of another version of traces: play the run again"
        ) from None
