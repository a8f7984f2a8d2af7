"""Find the mission and the settings of a flight in its records. `OtherRecords` also finds datagrams and events in
packet captures, traces of other agents, and exported blocks.

If no record contains the settings, they are guessed from the sent messages. Messages and blocks reveal some settings:
whether votes name a chain, and the size of a full block. For each other setting, every value is tried, and the value
that explains the most messages is assumed.
"""

import base64
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

from harness.archive.exports import Export
from harness.archive.traces import Trace, TraceHeader
from harness.checker.judgement import agents
from harness.checker.recorded_inputs import decoded, event_of, sealed_of
from harness.checker.reference.state import Settings
from harness.checker.steps.trace_header import CheckedHeader, ImpossibleHeaderError, checked
from harness.errors import CaptureError, FieldError
from harness.field._vehicle_captures import AgentCapture, read_capture
from harness.field.ingest import Flight
from harness.field.reconstruct._inferring import infer
from harness.play.simulation.recorded_seals import RecordedSeals
from ucp.block import MAX_EVENT_DATA_BYTES, Block
from ucp.events import LoggableEvent, MalformedEventsError, decode_events
from ucp.messages import BlockAddResponse, BlockResponse, CommitBlock, MalformedDatagramError, decode
from ucp.sealed import SEAL_BYTES, sealed_to
from ucp.settings import CHOICES

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
        """The reason why event data cannot be divided into events, as the end of a sentence. It is empty unless the
        event data are encrypted.
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


TRIES = 10
"""Maximum number of input orders that are tried for one agent with one combination of settings."""


def likely_settings(
    other_records: OtherRecords, captures: dict[int, AgentCapture], header_of: Callable[[int, Settings], CheckedHeader]
) -> Settings:
    """Return the settings that best fit the packet captures. With these settings, the inferred inputs completely
    explain the captures of the most agents.
    """
    events = {agent_id: other_records.events(agent_id) for agent_id in captures}

    def explained(settings: Settings) -> tuple[int, int]:
        """Return two numbers for these settings: the number of agents whose inputs are completely explained, and the
        number of explained inputs of all agents.
        """
        inferred = [
            infer(header_of(agent_id, settings), capture, events[agent_id], tries=TRIES)
            for agent_id, capture in captures.items()
        ]
        return sum(one.problem is None for one in inferred), sum(one.explained for one in inferred)

    visible = _visible_settings(other_records)
    best, most = visible, explained(visible)
    for settings in _alternatives(visible):
        if most[0] == len(captures):
            break
        if (score := explained(settings)) > most:
            best, most = settings, score
    return best


SHOWN_BY_VOTES = "vote_names_chain"
"""The setting that the votes reveal."""


def _alternatives(visible: Settings) -> Iterator[Settings]:
    for name, choice in reversed(CHOICES.items()):
        if choice.is_reading and name != SHOWN_BY_VOTES:
            for value in choice.values[1:]:
                yield replace(visible, **{name: value})  # type: ignore[arg-type]  # each setting takes its own values
    yield replace(visible, finalize_gap_s=0.0)


def _visible_settings(other_records: OtherRecords) -> Settings:
    """Return the settings that messages and blocks reveal."""
    votes = (decode(datagram).message for datagram in other_records.all_datagrams())
    names_chain = any(isinstance(vote, BlockAddResponse) and vote.chain_hash is not None for vote in votes)
    default = Settings()
    return replace(
        default,
        vote_names_chain=names_chain,
        max_block_bytes=_max_block_bytes(other_records.event_data(), default.max_event_bytes),
    )


def _max_block_bytes(blocks: Iterable[bytes], largest: int) -> int:
    """Return the setting max_block_bytes, which is computed from the sizes of the blocks. A block is full if an event
    of the largest size might not fit into it.
    """
    least, most = largest, MAX_EVENT_DATA_BYTES
    for event_data in blocks:
        last = _last_event_bytes(event_data)
        if last is not None:
            least = max(least, len(event_data) - last + largest + 1)
            most = min(most, len(event_data) + largest)
    default = Settings().max_block_bytes
    return default if least <= default <= most or least > most else most


def _last_event_bytes(event_data: bytes) -> int | None:
    try:
        events = decode_events(event_data)
    except MalformedEventsError:
        return None
    return events[-1].encoded_bytes if events else None


NO_INPUTS = "the records hold no inputs of agents: add traces (*.trace.jsonl), or captures together with exports"


@dataclass(frozen=True)
class MissionConfiguration:
    """The configuration that all agents of a flight share."""

    name: str
    roster: tuple[int, ...]
    initial_data: bytes
    settings: Settings


def known_mission(
    flight: Flight, other_records: OtherRecords, name: str, remarks: list[str]
) -> tuple[MissionConfiguration, dict[int, CheckedHeader]]:
    """Return the mission, and the trace header of each agent that has enough records to be simulated.

    Raises FieldError if no agent has enough records.
    """
    initial_data = _initial_data(flight)
    headers: dict[int, CheckedHeader] = {}
    for agent_id, trace in sorted(flight.traces.items()):
        header = trace.header
        if header.initial_data is None and initial_data is not None:
            header = header.model_copy(update={"initial_data": initial_data})
        try:
            headers[agent_id] = other_records.with_seal(checked(header))
        except ImpossibleHeaderError as error:
            remarks.append(f"agent {agent_id}: {error}")
    roster = {*flight.roster, *flight.agents, *(member for header in headers.values() for member in header.roster)}
    roster |= {*other_records.senders()}
    common = Counter(header.settings for header in headers.values()).most_common(1)
    untraced = sorted({*other_records.captures} & {*flight.exports} - {*headers})
    if untraced and initial_data is not None:
        header_of_agent = partial(_assumed, other_records, roster=roster, initial_data=initial_data)
        captures = {agent_id: other_records.captures[agent_id] for agent_id in untraced}
        settings = common[0][0] if common else likely_settings(other_records, captures, header_of_agent)
        headers |= {agent_id: header_of_agent(agent_id, settings) for agent_id in untraced}
        source = "as the others'" if common else f"the best fit to the records: {_in_words(settings)}"
        remarks.append(f"settings of {agents(untraced)} are not recorded; assumed: {source}")
    settings = Counter(header.settings for header in headers.values()).most_common(1)[0][0] if headers else Settings()
    if not headers:
        raise FieldError("; ".join([*other_records.problems[:1], NO_INPUTS]))
    common_initial_data = Counter(header.initial_data for header in headers.values()).most_common(1)[0][0]
    data = common_initial_data if initial_data is None else base64.b64decode(initial_data)
    return MissionConfiguration(name, tuple(sorted(roster)), data, settings), headers


def _in_words(settings: Settings) -> str:
    default = asdict(Settings())
    changed = [f"{name} {value}" for name, value in asdict(settings).items() if value != default[name]]
    return ", ".join(changed) or "the thesis's"


def _initial_data(flight: Flight) -> str | None:
    """Return the data of the inception block in base64. Return None if the data are unknown."""
    if flight.initial_data is not None:
        return base64.b64encode(flight.initial_data).decode("ascii")
    return next((export.inception.block_data for export in flight.exports.values()), None)


def _assumed(
    other_records: OtherRecords, agent_id: int, settings: Settings, *, roster: Iterable[int], initial_data: str
) -> CheckedHeader:
    header = TraceHeader(agent_id=agent_id, roster=sorted(roster), settings={}, clock={}, initial_data=initial_data)
    return other_records.with_seal(replace(checked(header), settings=settings))
