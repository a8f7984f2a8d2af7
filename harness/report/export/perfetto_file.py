"""Write a run as a trace for https://ui.perfetto.dev, with an arrow for each message.

Each agent has a group of tracks: votes, reconciles with their phases, handler runs, and counters of its blocks. An
arrow leads from the handler run that sent a message to each handler run that the message triggered. The swarm has
counters of losses and chains, and a track of faults and log lines.

The format is Perfetto's own protobuf. Chrome's JSON format is not suitable, because its arrows need slices with a
duration, but a handler run has no duration.
"""

from collections.abc import Callable, Iterable, Iterator
from heapq import merge
from itertools import count
from operator import itemgetter
from pathlib import Path
from typing import IO, Any

from harness.archive.history import BroadcastMessage
from harness.errors import extra
from harness.report.export._exported_run import ExportedRun
from harness.report.export._samples import (
    FieldPosition,
    HandlerRunSample,
    LogLine,
    NetworkSample,
    ReplicationSample,
    Sample,
)
from ucp.trace import HandlerRun
from ucp.trigger import MessageTrigger

with extra("export", "writing a Perfetto trace"):
    from perfetto.protos.perfetto.trace.perfetto_trace_pb2 import (
        BUILTIN_CLOCK_BOOTTIME,
        BUILTIN_CLOCK_REALTIME,
        TracePacket,
        TrackDescriptor,
        TrackEvent,
    )
    from perfetto.trace_builder.proto_builder import StreamingTraceProtoBuilder

SWARM = "swarm"
MAX_TEXT = 500
"""Maximum number of characters of a log line that the trace shows."""
_LARGEST = 2**63 - 1
_SEQUENCE = 1

Event = tuple[int, int, Any]
"""A packet of the trace with its sort key: time, rank, packet. Packets with the same time are sorted by rank, so that a
message is sent before it is received. Handler runs that a message triggered and values of counters have rank 1. All
other packets have rank 0.
"""


def write_perfetto(recording: ExportedRun, path: Path, progress: Callable[[float], None]) -> int:
    """Write a new trace file, and return the number of events in it. `progress` is called repeatedly with the current
    mission second.

    Raises OSError.
    """
    with path.open("xb") as file:
        return _write(recording, file, progress)


def _write(recording: ExportedRun, file: IO[bytes], progress: Callable[[float], None]) -> int:
    trace = _PerfettoTrace(recording)
    builder = StreamingTraceProtoBuilder(file)
    if recording.time.epoch_ns:
        builder.write_packet(trace.clocks())
    events = 0
    streams = [trace.of_samples(), *(trace.votes(agent) for agent in recording.agents)]
    streams += [trace.reconciles(agent) for agent in recording.agents]
    for at_ns, _, packet in merge(*streams, key=itemgetter(0, 1)):
        for descriptor in trace.new_tracks():
            builder.write_packet(descriptor)
        builder.write_packet(packet)
        events += 1
        if events % 1024 == 0:
            progress(recording.time.mission_s(at_ns))
    return events


class _MessageArrows:
    """The numbers of the arrows. A message has one arrow for each of its receivers."""

    def __init__(self, messages: Iterable[BroadcastMessage]) -> None:
        numbers = count(1)
        self._from: dict[tuple[int, int, float], list[int]] = {}
        self._to: dict[tuple[int, int, int, float], int] = {}
        self.backwards = 0
        """Number of messages that seem to be received before they were sent, because the clocks of the agents differ.
        Each receiver counts separately. The trace contains no arrows for these receipts.
        """
        for message in messages:
            for receiver, at_s in message.receipts:
                if at_s < message.at_s:
                    self.backwards += 1
                    continue
                number = self._to[message.sender, message.seq, receiver, at_s] = next(numbers)
                self._from.setdefault((message.sender, message.seq, message.at_s), []).append(number)

    def leaving(self, agent: int, run: HandlerRun) -> Iterator[int]:
        for sent in run.sent:
            yield from self._from.pop((agent, sent.seq, run.t), ())

    def arriving(self, agent: int, run: HandlerRun) -> int | None:
        trigger = run.trigger
        if not isinstance(trigger, MessageTrigger):
            return None
        return self._to.pop((trigger.sender, trigger.sequence, agent, run.t), None)


class _PerfettoTrace:
    """A converter from recorded values to packets of the trace. It describes each track when the track is
    first used.
    """

    def __init__(self, recording: ExportedRun) -> None:
        self._recording = recording
        self._arrows = _MessageArrows(recording.history.messages or ())
        if self._arrows.backwards:
            recording.add_problem(
                f"{self._arrows.backwards} messages were received before they were sent, according to the clocks of "
                "the agents: they have no arrow"
            )
        self._uuids = count(1)
        self._tracks: dict[tuple[str, str], int] = {}
        self._new: list[Any] = []
        self._counters: dict[tuple[str, str], float] = {}
        for rank, group in enumerate((SWARM, *map(_agent, recording.agents))):
            self._track(group, rank=rank)

    def clocks(self) -> Any:
        """Return the packet that declares the clock: all times are wall time."""
        packet = TracePacket(trusted_packet_sequence_id=_SEQUENCE)
        for clock in (BUILTIN_CLOCK_BOOTTIME, BUILTIN_CLOCK_REALTIME):
            packet.clock_snapshot.clocks.add(clock_id=clock, timestamp=self._recording.time.epoch_ns)
        return packet

    def new_tracks(self) -> Iterator[Any]:
        """Yield descriptions of tracks that are used for the first time."""
        new, self._new = self._new, []
        yield from new

    def of_samples(self) -> Iterator[Event]:
        for sample in self._recording.samples():
            yield from self._of(sample)

    def _of(self, sample: Sample) -> Iterator[Event]:
        at_ns = sample.at_ns
        match sample:
            case HandlerRunSample(agent=agent, run=run):
                yield self._step(at_ns, agent, run)
                held = {"chain": run.state.chain, "deque": run.state.deque, "stack": run.state.stack}
                for name, blocks in held.items():
                    yield from self._count(at_ns, _agent(agent), f"{name} (blocks)", blocks)
            case FieldPosition(vehicle=vehicle, metres=metres):
                yield from self._count(at_ns, _agent(vehicle), "altitude (m)", metres[2])
            case NetworkSample():
                yield from self._count(at_ns, SWARM, "mean loss (%)", 100 * sample.mean_loss)
                yield from self._count(at_ns, SWARM, "worst loss (%)", 100 * sample.worst_loss)
                yield from self._count(at_ns, SWARM, "connected groups", len(sample.groups))
            case ReplicationSample(replication=replication):
                yield from self._count(at_ns, SWARM, "longest chain (blocks)", replication.longest_chain)
                yield from self._count(at_ns, SWARM, "mutual chain (blocks)", replication.mutual_chain)
                yield from self._count(at_ns, SWARM, "distinct chains", replication.distinct_chains)
            case LogLine(source=source, text=text):
                packet = self._packet(at_ns, SWARM, source, TrackEvent.TYPE_INSTANT, text[:MAX_TEXT])
                yield at_ns, 0, packet

    def _step(self, at_ns: int, agent: int, run: HandlerRun) -> Event:
        packet = self._packet(at_ns, _agent(agent), "handlers", TrackEvent.TYPE_INSTANT, run.handler)
        event = packet.track_event
        event.flow_ids.extend(self._arrows.leaving(agent, run))
        if (arrow := self._arrows.arriving(agent, run)) is not None:
            event.terminating_flow_ids.append(arrow)
        trigger = next(iter(run.trigger.to_json().items()), ("", ""))
        _annotate(event, "trigger", f"{trigger[0]}: {trigger[1]}")
        _annotate(event, "branch", run.branch)
        block = self._recording.block
        details = {
            "changes": [f"{operation} {block(block_hash)}" for operation, block_hash in run.changes],
            "sent": [sent.message + (f" of {block(sent.block)}" if sent.block else "") for sent in run.sent],
        }
        for name, parts in details.items():
            if parts:
                _annotate(event, name, ", ".join(parts))
        return at_ns, int(isinstance(run.trigger, MessageTrigger)), packet

    def votes(self, agent: int) -> Iterator[Event]:
        for vote in self._recording.history.votes:
            if vote.agent == agent:
                name = f"vote on {self._recording.block(vote.block)}" if vote.block else "vote"
                yield self._begin(agent, "votes", vote.start_s, name, outcome=vote.outcome)
                yield self._end(agent, "votes", vote.end_s)

    def reconciles(self, agent: int) -> Iterator[Event]:
        for reconcile in self._recording.history.reconciles:
            if reconcile.agent == agent:
                done = "done" if reconcile.done else "cut short"
                name = f"reconcile: {reconcile.reason}"
                yield self._begin(agent, "reconciles", reconcile.start_s, name, outcome=done)
                for phase in reconcile.phases:
                    yield self._begin(agent, "reconciles", phase.start_s, phase.name, rounds=str(phase.rounds))
                    yield self._end(agent, "reconciles", phase.end_s)
                yield self._end(agent, "reconciles", reconcile.end_s)

    def _begin(self, agent: int, track: str, at_s: float, name: str, **details: str) -> Event:
        at_ns = self._recording.time.at(at_s, agent)
        packet = self._packet(at_ns, _agent(agent), track, TrackEvent.TYPE_SLICE_BEGIN, name)
        for key, value in details.items():
            _annotate(packet.track_event, key, value)
        return at_ns, 0, packet

    def _end(self, agent: int, track: str, at_s: float) -> Event:
        at_ns = self._recording.time.at(at_s, agent)
        return at_ns, 0, self._packet(at_ns, _agent(agent), track, TrackEvent.TYPE_SLICE_END)

    def _count(self, at_ns: int, group: str, name: str, value: float) -> Iterator[Event]:
        """Yield a counter event if the value differs from the value in the last event of this counter."""
        if self._counters.get((group, name)) != value and abs(value) <= _LARGEST:
            self._counters[group, name] = value
            packet = self._packet(at_ns, group, name, TrackEvent.TYPE_COUNTER)
            packet.track_event.double_counter_value = value
            yield at_ns, 1, packet

    def _packet(self, at_ns: int, group: str, track: str, kind: Any, name: str = "") -> Any:
        packet = TracePacket(timestamp=at_ns, trusted_packet_sequence_id=_SEQUENCE)
        packet.track_event.type = kind
        packet.track_event.track_uuid = self._track(group, track, counter=kind == TrackEvent.TYPE_COUNTER)
        if name:
            packet.track_event.name = name
        return packet

    def _track(self, group: str, name: str = "", *, rank: int = 0, counter: bool = False) -> int:
        """Return the ID of a track in a group. If `name` is empty, return the ID of the group."""
        if (group, name) not in self._tracks:
            uuid = self._tracks[group, name] = next(self._uuids)
            packet = TracePacket(trusted_packet_sequence_id=_SEQUENCE)
            track = packet.track_descriptor
            track.uuid, track.name = uuid, name or group
            if name:
                track.parent_uuid = self._tracks[group, ""]
                track.sibling_order_rank = _ORDER.index(name) if name in _ORDER else len(_ORDER)
            else:
                track.sibling_order_rank = rank
                track.child_ordering = TrackDescriptor.EXPLICIT
            if counter:
                track.counter.SetInParent()
            self._new.append(packet)
        return self._tracks[group, name]


_ORDER = ("votes", "reconciles", "handlers")


def _agent(agent: int) -> str:
    return f"agent {agent}"


def _annotate(event: Any, name: str, value: str) -> None:
    event.debug_annotations.add(name=name, string_value=value)
