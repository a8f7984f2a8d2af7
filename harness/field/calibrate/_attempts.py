"""Find out which messages reached which vehicles, and the distance between sender and receiver at that time.

A capture shows each frame of its vehicle, so captures are preferred. A trace shows the messages that its agent handled.
In virtual time, an agent does not receive messages without effect. Only some message types count there, and only while
the agent does not reconcile. Messages are matched by sender, type and sequence number, not by time. The time of a
transmission is the sending time on the sender's clock.

An answer does not count at the agent that asked. An agent answers only a question that it received, and the shadowing
of a link is equal in both directions. Therefore an answer is sent more often while the link is good, and would make the
range seem too long: 6 % in simulated flights on a shared channel.
"""

from bisect import bisect_left, bisect_right
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

from harness.archive.packets.capture_files import read_captures
from harness.archive.packets.capture_reader import ListenerName
from harness.archive.packets.exchanges import RequestAnswers
from harness.archive.packets.transmissions import Transmission, join
from harness.archive.traces import Trace
from harness.checker.records.contradiction import in_virtual_time
from harness.errors import CaptureError
from harness.field.calibrate._delivery_model import TransmissionAttempt
from harness.field.calibrate._positions import Positions
from harness.field.ingest import Flight
from ucp.messages import BlockAddRequest, ChainContainQuery, CommitBlock
from ucp.trigger import MessageTrigger

ON_AIR_S = 0.005
"""If the sending times of two messages differ by at most this number of seconds, both messages count as on the air at
the same time.
"""
_NEVER_WITHHELD = frozenset(message.NAME for message in (BlockAddRequest, CommitBlock, ChainContainQuery))


class _SentMessage(NamedTuple):
    """A sent message. `reached` contains the vehicles that received the message, and `lost` the vehicles that did not
    receive it. A vehicle is in neither set if the records do not show whether it received the message.
    """

    at_s: float
    sender: int
    reached: frozenset[int]
    lost: frozenset[int]


@dataclass(frozen=True)
class ObservedTransmissions:
    """The transmissions of messages to receivers. `source` names the kind of records that show the transmissions.
    `problems` has a sentence for each unusable part of the records.
    """

    attempts: list[TransmissionAttempt]
    source: str
    problems: list[str]


def observe(flight: Flight, positions: Positions, epoch_us: int) -> ObservedTransmissions:
    """Return all transmissions between vehicles with known positions."""
    problems: list[str] = []
    source, sent = "captures", _from_captures(flight, epoch_us, problems)
    if not any(message.reached or message.lost for message in sent):
        source, sent = "traces", [*_from_traces(flight.traces, problems)]
    sent.sort(key=lambda message: message.at_s)
    attempts, unknown = [], 0
    times = [message.at_s for message in sent]
    for message in sent:
        others = _others(sent, times, message)
        for receiver in sorted(message.reached | message.lost):
            distance_m = positions.distance_m(message.sender, receiver, message.at_s)
            if distance_m is None:
                unknown += 1
                continue
            delivered = receiver in message.reached
            attempts.append(TransmissionAttempt(message.at_s, message.sender, receiver, distance_m, delivered, others))
    if unknown:
        total = unknown + len(attempts)
        problems.append(f"{unknown} of {total} messages are left out, because a position is unknown at their time")
    return ObservedTransmissions(attempts, source, problems)


def _others(sent: Sequence[_SentMessage], times: Sequence[float], message: _SentMessage) -> int:
    first, last = bisect_left(times, message.at_s - ON_AIR_S), bisect_right(times, message.at_s + ON_AIR_S)
    return min(3, sum(other.sender != message.sender for other in sent[first : min(last, first + 50)]))


def _from_captures(flight: Flight, epoch_us: int, problems: list[str]) -> list[_SentMessage]:
    paths = [*flight.captures.values(), *flight.more_captures]
    if len(paths) < 2:
        return []
    try:
        captures = read_captures(paths)
    except CaptureError as error:
        problems.append(str(error))
        return []
    problems += captures.errors
    shift_s = 0.0 if captures.clock.of_run else (captures.clock.epoch_ns / 1000 - epoch_us) / 1e6
    transmissions = join(captures)
    asking = _asking_agents(transmissions)
    return [
        _SentMessage(
            transmission.at_s + shift_s,
            transmission.sender,
            frozenset(_vehicles(transmission.reached) - asking[transmission.number]),
            frozenset(_vehicles(transmission.lost_by) - asking[transmission.number]),
        )
        for transmission in transmissions
        if transmission.origin == "captured"
    ]


def _vehicles(names: Iterable[ListenerName]) -> set[int]:
    return {name for name in names if isinstance(name, int)}


def _asking_agents(transmissions: Sequence[Transmission]) -> dict[int, set[int]]:
    """Return a mapping: number of each answer -> the agents that had asked for this answer. An answer that was sent
    twice has two numbers.
    """
    asking: dict[int, set[int]] = defaultdict(set)
    answers = RequestAnswers(transmissions)
    for request in transmissions:
        for response in answers.responses(request):
            asking[response.number].add(request.sender)
    return asking


def _from_traces(traces: dict[int, Trace], problems: list[str]) -> Iterator[_SentMessage]:
    for agent_id, trace in traces.items():
        if trace.jumps:
            problems.append(f"agent {agent_id}: its clock jumps, so the messages that it sent after that are left out")
    receivers = {agent_id: _ReceivingAgent(trace) for agent_id, trace in traces.items()}
    for sender, trace in traces.items():
        for run in trace.runs[: trace.jumps[0]] if trace.jumps else trace.runs:
            asking = run.trigger.sender if isinstance(run.trigger, MessageTrigger) else None
            for message in run.sent:
                reached: set[int] = set()
                lost: set[int] = set()
                for agent_id, receiver in receivers.items():
                    if agent_id in (sender, asking) or not receiver.is_ready(message.message, run.t):
                        continue
                    (reached if receiver.takes((sender, message.message, message.seq)) else lost).add(agent_id)
                yield _SentMessage(run.t, sender, frozenset(reached), frozenset(lost))


class _ReceivingAgent:
    """The messages that an agent handled, and the intervals in which its trace contains every handled message."""

    def __init__(self, trace: Trace) -> None:
        triggers = (run.trigger for run in trace.runs)
        self._handled = Counter(
            (trigger.sender, trigger.message, trigger.sequence)
            for trigger in triggers
            if isinstance(trigger, MessageTrigger)
        )
        self._virtual = in_virtual_time(trace)
        bounds = sorted({0, *trace.starts, *(gap.position for gap in trace.gaps), len(trace.runs)})
        self._spans = [
            (min(trace.runs[first].t, trace.runs[last - 1].t), max(trace.runs[first].t, trace.runs[last - 1].t))
            for first, last in pairwise(bounds)
        ]
        self._times = [run.t for run in trace.runs]
        self._reconciling = [run.state.reconciling for run in trace.runs]

    def is_ready(self, message: str, at_s: float) -> bool:
        if not any(first_s <= at_s <= last_s for first_s, last_s in self._spans):
            return False
        if not self._virtual:
            return True
        place = bisect_right(self._times, at_s + 0.06)
        around = self._reconciling[max(0, bisect_right(self._times, at_s) - 1) : place]
        return message in _NEVER_WITHHELD and not any(around)

    def takes(self, key: tuple[int, str, int]) -> bool:
        """Return true if the agent handled the message. If the agent handled the message n times, only the first n
        calls for this message return true.
        """
        self._handled[key] -= 1
        return self._handled[key] >= 0


def pairs_of(attempts: Iterable[TransmissionAttempt]) -> list[frozenset[int]]:
    """Return the pairs of vehicles between which messages were transmitted, in the order of their IDs."""
    return sorted({attempt.link for attempt in attempts}, key=sorted)
