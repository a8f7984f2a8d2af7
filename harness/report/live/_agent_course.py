"""Follow the trace of one agent line by line, and convert it to changes for the live page.

A change is a list that becomes a line of JSON: its kind, its mission second, and further values.
`harness.report.live.feed` lists all kinds. Most lines of a trace only record that a message was received. A regular
expression recognizes these lines, so the JSON parser is not needed for them.

The trace file can grow, and its agent can restart. An agent that is a process writes the trace of each incarnation into
its own directory (`7.trace.jsonl`, then `7-2/7.trace.jsonl`). At the end of the run, the traces of all incarnations are
joined in the first file. In virtual time, all incarnations use one file from the start.
"""

import re
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from harness.archive.bounded_file import BoundedFile
from harness.archive.history import (
    COMMITTED_BY,
    LATEST_S,
    ActivityStart,
    AgentReconcile,
    AgentVote,
    HistoryReader,
    Phase2Tie,
)
from harness.archive.trace_files import open_trace, trace_file
from harness.archive.traces import MAX_LINE_BYTES, HeldBlocks, TraceHeader, parse_line
from ucp.trace import CommandEntry, DroppedDatagram, Entry, HandlerRun
from ucp.trigger import MessageTrigger

_CHUNK_BYTES = 256 * 1024


class GrowingFile:
    """The complete lines of a file that still grows. The file may be created after this object.

    `trouble` is the reason why no further lines can be read, or None.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.trouble: str | None = None
        self._file: BoundedFile | None = None
        self._lines: deque[bytes] = deque()
        self._partial_line = b""

    def next(self) -> bytes | None:
        """Return the next line without its line end. Return None if the next line is not complete yet."""
        while not self._lines:
            if not self._read():
                return None
        return self._lines.popleft()

    def drop_while(self, can_be_dropped: Callable[[bytes], bool]) -> bytes | None:
        """Drop lines that were read but not returned yet. Stop at the first line for which `can_be_dropped` returns
        false. Return the last dropped line.
        """
        dropped, lines = None, self._lines
        while lines and can_be_dropped(lines[0]):
            dropped = lines.popleft()
        return dropped

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None

    def _read(self) -> bool:
        """Read the next part of the file. Return true if the file contained new data."""
        if self.trouble is not None:
            return False
        try:
            if self._file is None:
                self._file = open_trace(self.path)
            data = self._file.read(_CHUNK_BYTES)
        except FileNotFoundError:
            return False
        except OSError as error:
            self.trouble = f"cannot be read: {error.strerror}"
            return False
        if not data:
            if self._file.problem:
                self.trouble = f"breaks off: {self._file.problem}"
            return False
        *complete, self._partial_line = (self._partial_line + data).split(b"\n")
        self._lines.extend(complete)
        if len(self._partial_line) > MAX_LINE_BYTES:
            self.trouble, self._partial_line = f"has a line of more than {MAX_LINE_BYTES // 1024 // 1024} MiB", b""
        return True


class AgentTrace:
    """A reader for the lines of one agent's trace, in all incarnations of the agent."""

    def __init__(self, agents: Path, agent_id: int) -> None:
        self._agents, self._agent_id = agents, agent_id
        self._incarnation = 1
        self._headers = 0
        self._file = GrowingFile(trace_file(agents, agent_id))

    @property
    def trouble(self) -> str | None:
        return self._file.trouble and f"{self._file.path.name} {self._file.trouble}"

    def next(self) -> bytes | None:
        """Return the next line without its line end. Return None if the next line is not complete yet."""
        while True:
            line = self._file.next()
            if line is None:
                if not self._later.is_dir():
                    return None
                line = self._file.next()  # the next incarnation has begun, so this one writes nothing more
            elif b'"schema"' in line:
                self._headers += 1
                if self._headers > 1 and self._later.is_dir():
                    line = None  # the run has ended: the rest of this file repeats the later incarnations
            if line is not None:
                return line
            self._file.close()
            self._file = GrowingFile(trace_file(self._later, self._agent_id))
            self._incarnation, self._headers = self._incarnation + 1, 0

    def drop_while(self, can_be_dropped: Callable[[bytes], bool]) -> bytes | None:
        """Drop lines of the current incarnation. Stop at the first line for which `can_be_dropped` returns false.
        Return the last dropped line.
        """
        return self._file.drop_while(can_be_dropped)

    @property
    def _later(self) -> Path:
        return self._agents / f"{self._agent_id}-{self._incarnation + 1}"

    def close(self) -> None:
        self._file.close()


Change = list[Any]

KEY_LENGTH = 16
"""Number of hexadecimal digits that identify a block on the page. A block is identified by the first digits of its
hash.
"""

_RECEIPT_LINE = re.compile(
    rb'\{"t":([\d.]+),"handler":"receive_\w+","algorithm":\d+,'
    rb'"trigger":\{"message":"[\w ]+","from":(\d+),"seq":(\d+)\}'
)
_NO_EFFECT = b'"branch":"no vote running"'
_NO_CHANGES = b'"changes":[],"sent":[]'
_RECEIVES = b'"handler":"receive_'
_TIME = re.compile(rb'\{"t":(\d{1,9}(?:\.\d{1,9})?),')


class MessageReceipt(NamedTuple):
    """A change for the page: the agent received the message with sequence number `seq` from the agent `sender`."""

    t: float
    sender: int
    seq: int


class SentMessage(NamedTuple):
    """A change for the page: the agent broadcast the message with sequence number `seq`. `block` identifies the block
    that the message concerns, or is None.
    """

    t: float
    seq: int
    message: str
    block: str | None


class AgentActions:
    """A reader of one agent's trace, which collects the actions of the agent. Callers read the lists `changes`, `sent`
    and `receipts`, and then empty them.
    """

    def __init__(self, agents: Path, agent_id: int) -> None:
        self.agent_id = agent_id
        self.changes: list[Change] = []
        self.sent: list[SentMessage] = []
        self.receipts: list[MessageReceipt] = []
        self.at_s = 0.0
        """Mission second of the last entry that was read."""
        self.problem: str | None = None
        """The reason why the rest of the trace cannot be read, or None if there is no problem."""
        self.has_messages_without_effect = False
        """True if the trace records any message that had no effect on its receiver. By default, traces of virtual time
        omit such messages.
        """
        self.has_unread = False
        """True if the last call of `read` left lines unread."""
        self.leaves_out_messages = False
        """If true, `read` processes only changes of the agent's state, which is several times as fast."""
        self._trace = AgentTrace(agents, agent_id)
        self._ahead: MessageReceipt | HandlerRun | DroppedDatagram | None = None
        """An entry that was already read, but that is later than the mission second up to which the caller reads."""
        self._has_started = False
        self._held = HeldBlocks()
        self._completed: dict[str, int] = {}
        self._duplicates: set[str] = set()
        self._idle_too_early = False
        self._incarnation = HistoryReader(agent_id)

    def read(self, until_s: float, at_most: int) -> bool:
        """Read the trace up to mission second `until_s`, but at most `at_most` lines. Return true if there are further
        entries up to `until_s`.
        """
        self.has_unread = False
        for _ in range(at_most):
            entry = self._ahead or self._next()
            if entry is None:
                return False
            if entry.t > until_s:
                self._ahead = entry
                return False
            self._ahead = None
            self.at_s = max(self.at_s, entry.t)
            if isinstance(entry, MessageReceipt):
                self.receipts.append(entry)
            elif isinstance(entry, HandlerRun):
                self._handler_run(entry)
            else:
                self.changes.append(["d", entry.t, self.agent_id, str(entry.dropped)[:80]])
        self.has_unread = True
        return True

    @property
    def next_s(self) -> float | None:
        """The mission second of the next entry, which was already read but is not processed yet. The value is None if
        there is no such entry.
        """
        return None if self._ahead is None else self._ahead.t

    def close(self) -> None:
        self._trace.close()

    def _next(self) -> MessageReceipt | HandlerRun | DroppedDatagram | None:
        """Return the next trace entry with a valid time. Return None if the trace does not contain such an
        entry yet.
        """
        while self.problem is None:
            if self.leaves_out_messages and (dropped := self._trace.drop_while(self._has_no_effect)):
                time = _TIME.match(dropped)
                self.at_s = max(self.at_s, float(time[1]) if time else 0.0)
            line = self._trace.next()
            if line is None:
                self.problem = self._trace.trouble
                return None
            self.has_messages_without_effect = self.has_messages_without_effect or _NO_EFFECT in line
            if _NO_CHANGES in line and (match := _RECEIPT_LINE.match(line)) and not self._may_be_idle_too_early(line):
                t, sender, seq = match.groups()
                entry: MessageReceipt | TraceHeader | Entry = MessageReceipt(float(t), int(sender), int(seq))
            else:
                try:
                    entry = parse_line(line)
                except ValueError:
                    self.problem = f"the trace of agent {self.agent_id} is damaged, and is read up to the damage"
                    return None
            if isinstance(entry, TraceHeader):
                self._begin()
            elif not isinstance(entry, CommandEntry) and 0 <= entry.t <= LATEST_S:
                return entry
        return None

    def _has_no_effect(self, line: bytes) -> bool:
        return (
            _NO_CHANGES in line
            and _RECEIVES in line
            and (not self._held.not_in_chain or not self._may_be_idle_too_early(line))
        )

    def _may_be_idle_too_early(self, line: bytes) -> bool:
        return bool(self._held.not_in_chain) and b'"idle":true' in line

    def _begin(self) -> None:
        """Begin an incarnation of the agent that holds no blocks, and forget the state of the previous incarnation."""
        if self._has_started:
            self.changes.append(["z", self.at_s, self.agent_id])
        self._has_started, self._held, self._idle_too_early = True, HeldBlocks(), False
        self._incarnation = HistoryReader(self.agent_id)
        self._duplicates.clear()

    def _handler_run(self, run: HandlerRun) -> None:
        trigger = run.trigger
        if isinstance(trigger, MessageTrigger):
            self.receipts.append(MessageReceipt(run.t, trigger.sender, trigger.sequence))
        for sent in run.sent:
            self.sent.append(SentMessage(run.t, sent.seq, sent.message[:80], sent.block and sent.block[:KEY_LENGTH]))
        if run.changes:
            self._report_changes(run)
        self._report_activity(run)
        self._report_violations(run)

    def _report_changes(self, run: HandlerRun) -> None:
        self._held.replay(run)
        moves = []
        for operation, block in run.changes:
            key = block[:KEY_LENGTH]
            if operation == "complete":
                ordinal = self._completed.setdefault(block, len(self._completed) + 1)
                self.changes.append(["b", run.t, key, self.agent_id, ordinal])
            else:
                moves.append([operation[:6], key])
        if moves:
            how = COMMITTED_BY.get(run.handler, "")
            self.changes.append(["c", run.t, self.agent_id, moves, run.state.top[:KEY_LENGTH], how])

    def _report_activity(self, run: HandlerRun) -> None:
        """Add a change for each vote, reconcile and phase of a reconcile that began or ended in this handler run."""
        for step in self._incarnation.feed(run):
            match step:
                case ActivityStart("vote"):
                    self._add_activity(run.t, "voting", step.detail[:KEY_LENGTH])
                case ActivityStart("reconcile"):
                    self._add_activity(run.t, "reconciling", step.detail)
                case ActivityStart():
                    self._add_activity(run.t, step.detail, "")
                case AgentVote():
                    self._add_activity(run.t, "voted", step.outcome[:80])
                case AgentReconcile():
                    self._add_activity(run.t, "reconciled", "")
                case Phase2Tie():
                    self._add_activity(run.t, "tie", step.branch[:80])

    def _add_activity(self, t: float, activity: str, detail: str) -> None:
        self.changes.append(["s", t, self.agent_id, activity, detail])

    def _report_violations(self, run: HandlerRun) -> None:
        """Add a change for a violation of characteristic 2 or 3 when the violation first occurs."""
        for operation, block in run.changes:
            if operation.endswith("+") and self._held.copies[block] > 1 and block not in self._duplicates:
                self._duplicates.add(block)
                self.changes.append(["x", run.t, self.agent_id, 3, block[:KEY_LENGTH]])
        idle_too_early = run.state.idle and bool(self._held.not_in_chain)
        if idle_too_early and not self._idle_too_early:
            first = next(iter(self._held.not_in_chain))
            self.changes.append(["x", run.t, self.agent_id, 2, first[:KEY_LENGTH]])
        self._idle_too_early = idle_too_early
