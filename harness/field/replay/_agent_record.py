"""Read the record of one agent for a replay: its trace lines in order, and the other records of the flight."""

import base64
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Protocol

from harness.archive.exports import Export
from harness.archive.run_record import JudgedRecord
from harness.archive.traces import Trace
from harness.checker.evidence import Evidence
from harness.checker.lost_lines import lacking_traces, lost_lines
from harness.checker.recorded_inputs import decoded
from harness.checker.steps.end_of_record import MessageArrival, sent_to, unfinished
from harness.checker.steps.follower import StepComparer
from harness.checker.steps.trace_header import CheckedHeader, ImpossibleHeaderError, checked
from harness.errors import FieldError
from harness.field._vehicle_captures import AgentCapture, CapturedDatagram
from ucp.clock import MICROSECONDS
from ucp.messages import MalformedDatagramError, Message, NextInSequenceResponse, decode
from ucp.plain_file import open_plain_file
from ucp.trace import CommandEntry, DroppedDatagram, HandlerRun
from ucp.trigger import MessageTrigger

DISK_BLOCK_BYTES = 4096
"""Size of the blocks of usual file systems."""


@dataclass(frozen=True, slots=True)
class RecordEntry:
    """One line of the trace. Line numbers and incarnations count from 1."""

    line: int
    incarnation: int
    content: HandlerRun | DroppedDatagram | CommandEntry
    gap: str | None = None
    """A description of missing lines directly before this line, such as "2 lines are damaged". The value is None if no
    lines are missing.
    """


class FlightRecords(Protocol):
    """The records of a flight. Each record is read when it is first used."""

    @property
    def exports(self) -> Mapping[int, Export]: ...

    @property
    def traces(self) -> Mapping[int, Trace]: ...

    @property
    def record(self) -> JudgedRecord | None:
        """Return the content of run.json. Return None for a real flight."""

    def capture(self, agent_id: int) -> AgentCapture | None:
        """Return the capture of the agent's vehicle. Return None if no capture exists, or if it is not needed."""


class RecordedTrace:
    """The trace of one agent. Raises FieldError if no part of the trace can be replayed."""

    def __init__(self, path: Path, argument: str, trace: Trace, flight: FlightRecords, problems: list[str]) -> None:
        self.path = path
        """The file of the trace."""
        self.argument = argument
        """The name of the file or directory that the user gave on the command line."""
        self.trace = trace
        self.flight = flight
        self.problems = problems
        self.agent_id = trace.header.agent_id
        self.incarnations = len(trace.starts) + 1
        self.doubts: dict[int, str] | None = None
        """The damage to a single line that explains a deviation, by the position of the deviation. The value is None
        before the search for such explanations.
        """
        self.clock_changes: dict[int, str] = {}
        """The changes of the agent's clock that explain deviations, by the position of the first entry that may have
        the new clock.
        """
        if not trace.header.has_inputs:
            raise FieldError(
                f"{path}: it has the version ucp-trace/1, which lacks received messages; agents must write ucp-trace/2"
            )
        try:
            self.header: CheckedHeader = checked(trace.header)
        except ImpossibleHeaderError as error:
            raise FieldError(f"{path}: {error}; it cannot be played") from None
        self.entries = list(_entries(trace))
        if not self.entries:
            raise FieldError(f"{path}: it has no handler runs of agent {self.agent_id}, so there is nothing to play")

    def position_of_line(self, line: int) -> int:
        """Return the number of entries before this line of the file."""
        return next((number for number, entry in enumerate(self.entries) if entry.line >= line), len(self.entries))

    def position_of_second(self, at_s: float) -> int:
        """Return the number of entries before this mission second."""
        return next((number for number, entry in enumerate(self.entries) if entry.content.t >= at_s), len(self.entries))

    @cached_property
    def unrecorded(self) -> dict[int, str]:
        """Position of an entry -> a description of the lost lines directly before it, such as "lines are missing ...".
        These lost lines may explain a deviation of the entry.
        """
        lost = {} if self.is_counted else lost_lines(self.trace)
        of_runs = [position for position, entry in enumerate(self.entries) if isinstance(entry.content, HandlerRun)]
        return {of_runs[position]: why for position, why in lost.items()}

    @property
    def doubtful_runs(self) -> dict[int, str]:
        """Position of a handler run -> damage to one trace line, or a change of the agent's clock. Either may explain
        why the handler run deviates.
        """
        of_entries = [number for number, entry in enumerate(self.entries) if isinstance(entry.content, HandlerRun)]
        doubts = {**self.clock_changes, **(self.doubts or {})}
        return {bisect_left(of_entries, entry): why for entry, why in doubts.items()}

    @property
    def is_counted(self) -> bool:
        """True if run.json proves that no line of the trace is missing. run.json contains the number of handler runs
        that the agent counted.
        """
        run = self.flight.record
        recorded = run.agents.get(str(self.agent_id)) if run is not None else None
        counts = recorded.handler_runs if recorded is not None else []
        counted = [count.counted for count in counts if count is not None]
        return bool(counted) and len(counted) == self.incarnations and sum(counted) <= len(self.trace.runs)

    def datagrams(self, sender: int, sequence: int) -> list[bytes]:
        """Return the datagrams with this sender and sequence number, from the traces of other agents."""
        return self._datagrams.get((sender, sequence), [])

    @cached_property
    def _datagrams(self) -> dict[tuple[int, int], list[bytes]]:
        found: dict[tuple[int, int], list[bytes]] = {}
        for agent_id, trace in self.flight.traces.items():
            for run in trace.runs if agent_id != self.agent_id else ():
                records = [((agent_id, sent.seq), sent.datagram) for sent in run.sent]
                if isinstance(run.trigger, MessageTrigger) and run.trigger.sender == self.agent_id:
                    records.append(((self.agent_id, run.trigger.sequence), run.input))
                for key, datagram in records:
                    if datagram is not None:
                        with suppress(ValueError):
                            found.setdefault(key, []).append(base64.b64decode(datagram.text, validate=True))
        return found

    def sent_by_others(self, kind: str) -> Iterable[tuple[int, Message]]:
        """Return the recorded messages of this type from other agents, with their senders. Equal messages
        occur once.
        """
        return self._sent_by_others.get(kind, ())

    @cached_property
    def _sent_by_others(self) -> dict[str, list[tuple[int, Message]]]:
        """The recorded messages of other agents, each with its sender, by the type of the message."""
        found: dict[str, dict[tuple[int, Message], None]] = {}
        for (sender, _), datagrams in self._datagrams.items():
            for data in datagrams if sender != self.agent_id else ():
                with suppress(MalformedDatagramError):
                    message = decode(data).message
                    found.setdefault(message.NAME, {})[sender, message] = None
        return {kind: [*messages] for kind, messages in found.items()}

    def may_have_arrived(self, sender: int, message: Message, at_s: float) -> bool:
        """Return false if the records prove that this message did not reach the agent before `at_s`. A capture of the
        vehicle, or a complete trace of the sender, can prove this.
        """
        if self.arrivals and self.arrivals[0].at_s < at_s < self.arrivals[-1].at_s:
            return any(
                seen.sender == sender and _are_alike(decode(seen.datagram).message, message) for seen in self.arrivals
            )
        sent = self._sent_by_complete_traces.get(sender)
        return sent is None or any(_are_alike(other, message) for other in sent)

    def was_reconciling(self, at_s: float) -> bool:
        """Return true if the last trace line before this mission second shows a reconcile."""
        earlier = [entry.content for entry in self.entries if entry.content.t < at_s]
        runs = (content for content in reversed(earlier) if isinstance(content, HandlerRun))
        return any(run.state.reconciling for run in islice(runs, 1))

    def beginnings(self, number: int) -> Iterator[str]:
        """Yield the possible truncated forms of line `number` of the trace file. A file system stores a file in blocks,
        and a damaged disk loses whole blocks. Each yielded text therefore begins at the start of the line and ends
        where a disk block begins.
        """
        begin, line = 0, b""
        with suppress(OSError), open_plain_file(self.path) as file:
            for read in islice(file, number):
                begin, line = begin + len(line), read
        for end in range(DISK_BLOCK_BYTES - begin % DISK_BLOCK_BYTES, len(line), DISK_BLOCK_BYTES):
            yield line[:end].decode("utf-8", "replace")

    @cached_property
    def _sent_by_complete_traces(self) -> dict[int, list[Message]]:
        """The messages that each agent sent, by agent ID. Agents whose traces lack lines are not included."""
        sent = {}
        lacking = {agent_id for agent_id, _ in lacking_traces(self.flight.traces)}
        for agent_id, trace in self.flight.traces.items():
            if agent_id in lacking or trace.problem or trace.cut_off or trace.gaps or trace.jumps or lost_lines(trace):
                continue
            datagrams = [each.datagram for run in trace.runs for each in run.sent]
            with suppress(MalformedDatagramError):
                sent[agent_id] = [decoded(datagram).message for datagram in datagrams]
        return sent

    @cached_property
    def arrivals(self) -> list[CapturedDatagram] | None:
        """The datagrams that reached the vehicle of the agent, in order, or None if it has no capture."""
        capture = self.flight.capture(self.agent_id)
        return None if capture is None else [seen for seen in capture.sightings if not seen.outbound]

    @property
    def end_s(self) -> float:
        """The mission second of the last line."""
        return self.entries[-1].content.t

    @cached_property
    def present_until_s(self) -> float | None:
        """A mission second at which the agent certainly still ran after its last trace line. None if no such time is
        known. If a step was due before this time, but the trace has no line for the step, the line was lost.
        """
        if self.trace.cut_off or self.trace.problem or self.agent_id not in self.flight.exports:
            return None
        if self.flight.record is not None:
            return self.flight.record.end_of(self.agent_id)
        last = next((entry.content for entry in reversed(self.entries) if isinstance(entry.content, HandlerRun)), None)
        if last is None or last.state.top != self.flight.exports[self.agent_id].top_chain_hash:
            return None  # The last lines are lost.
        if any(gap.position == len(self.trace.runs) for gap in self.trace.gaps):
            return None
        epoch_us = self.trace.header.clock.get("epoch_us")
        if not isinstance(epoch_us, int):
            return None
        exported_s = (self.flight.exports[self.agent_id].exported_at_us - epoch_us) / MICROSECONDS
        exported_s = (exported_s - self.header.offset_s) / self.header.rate
        return exported_s if exported_s >= self.end_s else None

    def ends_open(self, follower: StepComparer) -> str | None:
        """Return a sentence if the record ends early: the agent left no export, and other agents continued after its
        last line. If no agent left an export, the agents may have been stopped at different times. In this case, the
        record ends early only if a timer of the agent was due. `follower` contains the state of the agent after the
        last line.
        """
        trace, flight = self.trace, self.flight
        if trace.cut_off or trace.problem or self.agent_id in flight.exports:
            return None
        if any(position == len(trace.runs) for position in (*(gap.position for gap in trace.gaps), *trace.jumps)):
            return None
        others = [other.runs[-1].t for agent, other in flight.traces.items() if agent != self.agent_id and other.runs]
        others_until_s = max(others, default=0.0) - self.header.late_s
        return unfinished(follower, trace, others_until_s, self._arrivals() if flight.exports else None)

    def _arrivals(self) -> Iterator[MessageArrival]:
        """Yield the messages that reached the vehicle of the agent. Without a capture, yield the messages that other
        agents sent to the agent.
        """
        if self.arrivals is None:
            yield from sent_to(self.agent_id, self.flight.traces)
        for seen in self.arrivals or ():
            yield MessageArrival(
                seen.at_s, decode(seen.datagram).message.NAME, seen.sender, seen.sequence, arrived=True
            )

    def was_paused(self, since: float, until: float) -> bool:
        """Return true if the agent was paused, or may have been paused, between two mission seconds.

        If there is a run.json, it contains the pauses. Otherwise, a long time without lines suggests a pause. This time
        must nearly fill the interval between the two mission seconds, because a running agent handles an overdue timer
        soon.
        """
        if self.flight.record is not None:
            return Evidence({}, record=self.flight.record).was_paused(self.agent_id, since, until)
        tolerated_s = self.header.late_s
        after = bisect_right(self._times, since + tolerated_s)
        begins_s = max(since, self._times[after - 1]) if after else since
        ends_s = min(until, self._times[after]) if after < len(self._times) else until
        return ends_s - begins_s > tolerated_s and (begins_s - since) + (until - ends_s) <= tolerated_s

    @cached_property
    def _times(self) -> list[float]:
        return sorted(entry.content.t for entry in self.entries)


def _are_alike(ours: Message, other: Message) -> bool:
    """Return true if two messages have the same content. Timestamps in NextInSequenceResponse messages may differ,
    because the judge does not know all of them.
    """
    if isinstance(ours, NextInSequenceResponse) and isinstance(other, NextInSequenceResponse):
        return (ours.chain_hash, ours.block_hash) == (other.chain_hash, other.block_hash)
    return ours == other


def _entries(trace: Trace) -> Iterator[RecordEntry]:
    """Yield the lines of a trace as entries, in order."""
    missing = {gap.position: _missing(gap.lines) for gap in trace.gaps}
    missing |= dict.fromkeys(trace.jumps, "the agent's clock was set")
    asides = deque(zip((position for position, _ in trace.asides), trace.numbered_asides(), strict=True))
    position = 0
    for incarnation, numbered_runs in enumerate(trace.incarnations(), 1):
        for line, run in numbered_runs:
            while asides and asides[0][0] <= position:
                yield RecordEntry(asides[0][1][0], incarnation, asides.popleft()[1][1])
            yield RecordEntry(line, incarnation, run, missing.get(position))
            position += 1
    for _, (line, aside) in asides:
        yield RecordEntry(line, len(trace.starts) + 1, aside)


def _missing(lines: int) -> str:
    return "lines are missing" if not lines else "a line is damaged" if lines == 1 else f"{lines} lines are damaged"
