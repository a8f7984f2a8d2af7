"""What a trace does not have and others have on record: datagrams in captures and traces, events in blocks."""

import base64
from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from harness.archive.exports import Export
from harness.archive.packets.capture_reader import Capture
from harness.archive.packets.datagram import NotUcpError, unwrap
from harness.archive.packets.pcap import OUTBOUND, CaptureFile
from harness.archive.traces import Trace
from harness.checker.judgement import agents
from harness.checker.recorded_inputs import decoded, event_of, sealed_of
from harness.checker.steps.trace_header import CheckedHeader
from harness.errors import CaptureError
from harness.field.ingest import Flight
from harness.play.simulation.seals import SealsOnRecord
from ucp.block import MAX_EVENT_DATA_BYTES, Block
from ucp.clock import MICROSECONDS
from ucp.events import LoggableEvent, MalformedEventsError, decode_events
from ucp.messages import HEADER, BlockResponse, CommitBlock, MalformedDatagramError, decode
from ucp.sealed import SEAL_BYTES, sealed_to
from ucp.secure.envelope import REVOCATION
from ucp.secure.envelope import VERSION as SECURED

if TYPE_CHECKING:
    from ucp.secure.opening import Opener
    from ucp.secure.sealing import Depot

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
    closed: int = 0
    """Datagrams that are sealed, and that nobody here can open."""


class Elsewhere:
    """All that the files of a flight say of datagrams and blocks."""

    def __init__(self, flight: Flight, opener: "Opener | None" = None, depot: "Depot | None" = None) -> None:
        """Of a secured mission `opener` opens captures, and `depot` what was sealed to it."""
        self.sealed: dict[int, dict[bytes, bytes]] = defaultdict(dict)
        """What each agent sealed, by the event that filled the block, encoded."""
        self._depot = depot
        self.captured: dict[int, Captured] = {}
        self.problems: list[str] = []
        self._exports = flight.exports
        self._datagrams: dict[tuple[int, int], dict[bytes, None]] = defaultdict(dict)
        self._blocks: dict[str, Block] = {}
        for agent_id, path in sorted(flight.captures.items()):
            try:
                self.captured[agent_id] = _read(path, agent_id, flight.epoch_us, opener)
            except CaptureError as error:
                self.problems.append(str(error))
        closed = {agent_id: captured.closed for agent_id, captured in self.captured.items() if captured.closed}
        self.captured = {agent_id: captured for agent_id, captured in self.captured.items() if captured.seen}
        if closed:
            why = "are not read without --bundle" if opener is None else "are not authentic according to that bundle"
            self.problems.append(f"{sum(closed.values())} datagrams in captures of {agents([*closed])} {why}")
        for captured in self.captured.values():
            for seen in captured.seen:
                self._datagrams[seen.sender, seen.sequence][seen.datagram] = None
        for agent_id, trace in flight.traces.items():
            for sequence, datagram in _sent(trace):
                self._datagrams[agent_id, sequence][datagram] = None
            self.sealed[agent_id].update(_seals(trace))
        self._learn_blocks(flight.exports.values())
        self._opened = {block_hash: self._open(block) for block_hash, block in self._blocks.items()}

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
        """The data of all blocks that are known, opened if it is sealed and the depot's key is here."""
        return [*self._opened.values()]

    def with_seal(self, header: CheckedHeader) -> CheckedHeader:
        """What the agent was told, and how it sealed, if its mission does."""
        if sealed_to(header.initial_data) is None:
            return header
        most = min(header.settings.max_block_bytes, MAX_EVENT_DATA_BYTES - SEAL_BYTES)
        settings = replace(
            header.settings, max_block_bytes=most, max_event_bytes=min(most, header.settings.max_event_bytes)
        )
        return replace(header, settings=settings, seal=SealsOnRecord(self.sealed[header.agent_id]))

    def events(self, agent_id: int) -> list[LoggableEvent]:
        """The events of an agent as far as they are known, in order: those of its blocks, and of the one it builds."""
        export = self._exports.get(agent_id)
        own = [block for block in self._blocks.values() if block.agent_id == agent_id]
        data = [self._opened[block.block_hash.hex()] for block in sorted(own, key=lambda block: block.timestamp_us)]
        if export is not None:
            known = [self._opened[block] for block in export.completed if block in self._opened]
            data = known if len(known) == len(export.completed) >= len(own) else data
            data.append(base64.b64decode(export.current_block.event_data))
        events: list[LoggableEvent] = []
        for event_data in data:
            try:
                events += decode_events(event_data)
            except MalformedEventsError:
                why = f"cannot be told apart{self._why_closed}"
                self.problems.append(f"agent {agent_id}: the events of a block {why}")
        return events

    def _open(self, block: Block) -> bytes:
        """The events of a block; as they are if they are not sealed, or cannot be opened."""
        if self._depot is None:
            return block.event_data
        from ucp.secure.sealing import NotOpenedError

        try:
            events = self._depot.open(block.event_data, block.agent_id, block.timestamp_us)
            self.sealed[block.agent_id][decode_events(events)[-1].encode()] = block.event_data
        except (NotOpenedError, MalformedEventsError, IndexError):
            return block.event_data
        return events

    @property
    def _why_closed(self) -> str:
        """Why event data may be no events, if the mission seals it."""
        exports = self._exports.values()
        if not any(sealed_to(base64.b64decode(export.inception.block_data)) for export in exports):
            return ""
        return ": they are sealed, and --depot-key opens them" if self._depot is None else ", or are not of that depot"

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


def _seals(trace: Trace) -> Iterator[tuple[bytes, bytes]]:
    """What the agent sealed, by the event that filled the block."""
    for run in trace.runs:
        if (sealed := sealed_of(run.sealed)) is not None and run.input is not None:
            with suppress(ValueError, MalformedEventsError):
                yield event_of(run.input).encode(), sealed


def _sent(trace: Trace) -> Iterator[tuple[int, bytes]]:
    for run in trace.runs:
        for sent in run.sent:
            if sent.datagram is not None:
                try:
                    decoded(sent.datagram)
                except MalformedDatagramError:
                    continue
                yield sent.seq, base64.b64decode(sent.datagram.text)


def _read(path: Path, agent_id: int, epoch_us: int | None, opener: "Opener | None") -> Captured:
    """Raises CaptureError."""
    glance = Capture(0, path)
    glance.read({}, most_frames=1)
    frames = [*CaptureFile(path)]
    if glance.comment is not None:
        captured = Captured(float(glance.comment.epoch_us), glance.comment.speedup)
    else:
        first_ns = min((frame.time_ns for frame in frames), default=0)
        captured = Captured(float(epoch_us if epoch_us is not None else first_ns // 1000), 1.0)
    epoch_ns = captured.epoch_us * 1000
    for frame in frames:
        try:
            datagram, direction = unwrap(frame)
            is_sealed = len(datagram) >= HEADER.size and datagram[2] == SECURED
            if is_sealed and opener is not None:
                datagram = opener.open(datagram).said.encode()
            sender, sequence, _ = decode(datagram)
        except NotUcpError:
            continue
        except MalformedDatagramError:
            captured.closed += is_sealed and datagram[3] != REVOCATION
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
