"""Find datagrams and events in other records: packet captures, traces of other agents, and exported blocks."""

import base64
from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

from harness.archive.exports import Export
from harness.archive.traces import Trace
from harness.checker.judgement import agents
from harness.checker.recorded_inputs import decoded, event_of, sealed_of
from harness.checker.steps.trace_header import CheckedHeader
from harness.errors import CaptureError
from harness.field._vehicle_captures import AgentCapture, read_capture
from harness.field.ingest import Flight
from harness.play.simulation.recorded_seals import RecordedSeals
from ucp.block import MAX_EVENT_DATA_BYTES, Block
from ucp.events import LoggableEvent, MalformedEventsError, decode_events
from ucp.messages import BlockResponse, CommitBlock, MalformedDatagramError, decode
from ucp.sealed import SEAL_BYTES, sealed_to

if TYPE_CHECKING:
    from ucp.secure.opening import DatagramOpener
    from ucp.secure.sealing import Depot


class OtherRecords:
    """All datagrams and blocks in the records of a flight."""

    def __init__(self, flight: Flight, opener: "DatagramOpener | None" = None, depot: "Depot | None" = None) -> None:
        """Read the files. In a secured mission, `opener` decrypts datagrams, and `depot` decrypts event data."""
        self.sealed: dict[int, dict[bytes, bytes]] = defaultdict(dict)
        """The encrypted event data of each block. The first key is the agent ID, and the second is the event that
        filled the block, encoded as bytes.
        """
        self._depot = depot
        self.captures: dict[int, AgentCapture] = {}
        self.problems: list[str] = []
        self._exports = flight.exports
        self._datagrams: dict[tuple[int, int], dict[bytes, None]] = defaultdict(dict)
        self._blocks: dict[str, Block] = {}
        for agent_id, path in sorted(flight.captures.items()):
            try:
                self.captures[agent_id] = read_capture(path, agent_id, flight.epoch_us, opener)
            except CaptureError as error:
                self.problems.append(str(error))
        unreadable = {agent_id: capture.unreadable for agent_id, capture in self.captures.items() if capture.unreadable}
        self.captures = {agent_id: capture for agent_id, capture in self.captures.items() if capture.sightings}
        if unreadable:
            reason = "are not read without --bundle" if opener is None else "are not authentic according to that bundle"
            self.problems.append(
                f"{sum(unreadable.values())} datagrams in captures of {agents([*unreadable])} {reason}"
            )
        for capture in self.captures.values():
            for sighting in capture.sightings:
                self._datagrams[sighting.sender, sighting.sequence][sighting.datagram] = None
        for agent_id, trace in flight.traces.items():
            for sequence, datagram in _sent(trace):
                self._datagrams[agent_id, sequence][datagram] = None
            self.sealed[agent_id].update(_seals(trace))
        self._add_blocks(flight.exports.values())
        self._event_data = {block_hash: self._open(block) for block_hash, block in self._blocks.items()}

    def datagrams(self, sender: int, sequence: int) -> list[bytes]:
        """Return the datagrams with this sender and this sequence number.

        The result has several datagrams if the sender restarted, or if an attacker imitated it.
        """
        return [*self._datagrams.get((sender, sequence), ())]

    def senders(self) -> set[int]:
        """Return the agent IDs of all senders of recorded datagrams."""
        return {sender for sender, _ in self._datagrams}

    def all_datagrams(self) -> Iterator[bytes]:
        """Yield each recorded datagram of the flight. Equal datagrams are yielded once."""
        for datagrams in self._datagrams.values():
            yield from datagrams

    def event_data(self) -> list[bytes]:
        """Return the event data of all known blocks, decrypted if the depot's key is given."""
        return [*self._event_data.values()]

    def with_seal(self, header: CheckedHeader) -> CheckedHeader:
        """Return the header of a trace. If the mission encrypts event data, the returned header also contains the
        encrypted data that the agent recorded.
        """
        if sealed_to(header.initial_data) is None:
            return header
        max_block_bytes = min(header.settings.max_block_bytes, MAX_EVENT_DATA_BYTES - SEAL_BYTES)
        settings = replace(
            header.settings,
            max_block_bytes=max_block_bytes,
            max_event_bytes=min(max_block_bytes, header.settings.max_event_bytes),
        )
        return replace(header, settings=settings, seal=RecordedSeals(self.sealed[header.agent_id]))

    def events(self, agent_id: int) -> list[LoggableEvent]:
        """Return the known events of an agent in order, including the events in its block under construction."""
        export = self._exports.get(agent_id)
        own = [block for block in self._blocks.values() if block.agent_id == agent_id]
        data = [self._event_data[block.block_hash.hex()] for block in sorted(own, key=lambda block: block.timestamp_us)]
        if export is not None:
            known = [self._event_data[block] for block in export.completed if block in self._event_data]
            data = known if len(known) == len(export.completed) >= len(own) else data
            data.append(base64.b64decode(export.current_block.event_data))
        events: list[LoggableEvent] = []
        for event_data in data:
            try:
                events += decode_events(event_data)
            except MalformedEventsError:
                reason = f"cannot be decoded{self._reason_unreadable}"
                self.problems.append(f"agent {agent_id}: the event data of a block {reason}")
        return events

    def _open(self, block: Block) -> bytes:
        """Decrypt the event data of a block if the depot's key is given. Otherwise return the event data unchanged."""
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
    def _reason_unreadable(self) -> str:
        """The reason why event data cannot be divided into events. The text is the end of a sentence. It is empty if
        the event data are not encrypted.
        """
        exports = self._exports.values()
        if not any(sealed_to(base64.b64decode(export.inception.block_data)) for export in exports):
            return ""
        return ": they are sealed, and --depot-key opens them" if self._depot is None else ", or are not of that depot"

    def _add_blocks(self, exports: Iterable[Export]) -> None:
        for export in exports:
            for block in export.blocks():
                block_of_export = Block(block.agent_id, block.timestamp_us, block.event_bytes)
                self._blocks[block_of_export.block_hash.hex()] = block_of_export
        for datagrams in self._datagrams.values():
            for datagram in datagrams:
                message = decode(datagram).message
                if isinstance(message, CommitBlock | BlockResponse):
                    self._blocks[message.block.block_hash.hex()] = message.block


def _seals(trace: Trace) -> Iterator[tuple[bytes, bytes]]:
    """Yield each event that completed a block, with the encrypted event data of this block."""
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
