"""What a trace does not have and others have on record: datagrams in captures and traces, events in blocks."""

import base64
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from harness.archive.exports import Export
from harness.archive.traces import Trace
from harness.checker.steps.inputs import decoded
from harness.errors import CaptureError
from harness.field.homecoming import Flight
from harness.packets.capture import Capture
from harness.packets.datagram import NotUcpError, unwrap
from harness.packets.pcap import OUTBOUND, CaptureFile
from ucp.block import Block
from ucp.clock import MICROSECONDS
from ucp.events import LoggableEvent, MalformedEventsError, decode_events
from ucp.messages import BlockResponse, CommitBlock, MalformedDatagramError, decode

NANOSECONDS = 1_000_000_000


@dataclass(slots=True)
class Seen:
    """A datagram at a vehicle's interface, at seconds by the vehicle's clock, from its mission second 0 on."""

    at_s: float
    leaving: bool
    sender: int
    sequence: int
    datagram: bytes


@dataclass
class Captured:
    """What a vehicle's capture saw, in order. Its mission second 0 is `epoch_us`."""

    epoch_us: float
    speedup: float
    seen: list[Seen] = field(default_factory=list)


class Elsewhere:
    """All that the files of a flight say of datagrams and blocks."""

    def __init__(self, flight: Flight) -> None:
        self.captured: dict[int, Captured] = {}
        self.problems: list[str] = []
        self._exports = flight.exports
        self._datagrams: dict[tuple[int, int], dict[bytes, None]] = defaultdict(dict)
        self._blocks: dict[str, Block] = {}
        for agent_id, path in sorted(flight.captures.items()):
            try:
                self.captured[agent_id] = _read(path, agent_id, flight.epoch_us)
            except CaptureError as error:
                self.problems.append(str(error))
        for captured in self.captured.values():
            for seen in captured.seen:
                self._datagrams[seen.sender, seen.sequence][seen.datagram] = None
        for agent_id, trace in flight.traces.items():
            for sequence, datagram in _sent(trace):
                self._datagrams[agent_id, sequence][datagram] = None
        self._learn_blocks(flight.exports.values())

    def datagrams(self, sender: int, sequence: int) -> list[bytes]:
        """What the sender sent with this number; several if it started anew, or was imitated."""
        return [*self._datagrams.get((sender, sequence), ())]

    def senders(self) -> set[int]:
        """Whose datagrams there are."""
        return {sender for sender, _ in self._datagrams}

    def all_datagrams(self) -> Iterator[bytes]:
        """All that there are, each once."""
        for datagrams in self._datagrams.values():
            yield from datagrams

    def event_data(self) -> list[bytes]:
        """The data of all blocks that are known."""
        return [block.event_data for block in self._blocks.values()]

    def events(self, agent_id: int) -> list[LoggableEvent]:
        """The events of an agent as far as they are known, in order: those of its blocks, and of the one it builds."""
        export = self._exports.get(agent_id)
        own = [block for block in self._blocks.values() if block.agent_id == agent_id]
        data = [block.event_data for block in sorted(own, key=lambda block: block.timestamp_us)]
        if export is not None:
            known = [self._blocks[block].event_data for block in export.completed if block in self._blocks]
            data = known if len(known) == len(export.completed) >= len(own) else data
            data.append(base64.b64decode(export.current_block.event_data))
        events: list[LoggableEvent] = []
        for event_data in data:
            try:
                events += decode_events(event_data)
            except MalformedEventsError:
                self.problems.append(f"agent {agent_id}: the events of a block cannot be told apart")
        return events

    def _learn_blocks(self, exports: Iterable[Export]) -> None:
        for export in exports:
            for block in export.blocks():
                made = Block(block.agent_id, block.timestamp_us, block.event_bytes)
                self._blocks[made.block_hash.hex()] = made
        for datagrams in self._datagrams.values():
            for datagram in datagrams:
                message = decode(datagram).message
                if isinstance(message, CommitBlock | BlockResponse):
                    self._blocks[message.block.block_hash.hex()] = message.block


def _sent(trace: Trace) -> Iterator[tuple[int, bytes]]:
    for run in trace.runs:
        for sent in run.sent:
            if sent.datagram is not None:
                try:
                    decoded(sent.datagram)
                except MalformedDatagramError:
                    continue
                yield sent.seq, base64.b64decode(sent.datagram.text)


def _read(path: Path, agent_id: int, epoch_us: int | None) -> Captured:
    """Raises CaptureError."""
    glance = Capture(0, path)
    glance.read({}, most_frames=1)
    frames = [*CaptureFile(path)]
    if glance.about is not None:
        captured = Captured(float(glance.about.epoch_us), glance.about.speedup)
    else:
        first_ns = min((frame.time_ns for frame in frames), default=0)
        captured = Captured(float(epoch_us if epoch_us is not None else first_ns // 1000), 1.0)
    epoch_ns = captured.epoch_us * 1000
    for frame in frames:
        try:
            datagram, direction = unwrap(frame)
            sender, sequence, _ = decode(datagram)
        except (NotUcpError, MalformedDatagramError):
            continue
        leaving = direction == OUTBOUND or (not direction and sender == agent_id)
        if leaving == (sender == agent_id):
            at_s = (frame.time_ns - epoch_ns) / NANOSECONDS * captured.speedup
            captured.seen.append(Seen(at_s, leaving, sender, sequence, datagram))
    captured.seen.sort(key=lambda seen: seen.at_s)
    return captured


def seconds_of(event: LoggableEvent, captured: Captured) -> float:
    """When it was logged, by the clock of the capture: an event's time runs at the mission's speed."""
    return (event.timestamp_us - captured.epoch_us) / MICROSECONDS
