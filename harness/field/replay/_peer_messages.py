"""Find the messages between the replayed agent and one other agent that the records of both agents contain."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

from harness.archive.traces import Trace
from harness.field.replay._agent_record import RecordedTrace
from ucp.trace import HandlerRun
from ucp.trigger import MessageTrigger


@dataclass(frozen=True, slots=True)
class DeliveredMessage:
    """A message with its sending time on the sender's clock and its receiving time on the receiver's clock."""

    sender: int
    receiver: int
    sent_s: float
    received_s: float


class PeerMessage(NamedTuple):
    """A message, and the position of the trace entry that sent or received it."""

    position: int
    delivery: DeliveredMessage


class PeerMessages:
    """The messages between two agents."""

    def __init__(self, record: RecordedTrace, other_trace: Trace) -> None:
        self.runs = [numbered for numbered_runs in other_trace.incarnations() for numbered in numbered_runs]
        """The handler runs of the second agent, with their line numbers."""
        self._record = record
        self._agents = record.agent_id, other_trace.header.agent_id
        self._sent: dict[tuple[object, object], list[int]] = {}
        self._received: dict[tuple[object, object], list[int]] = {}
        for number, (_, run) in enumerate(self.runs):
            for message in run.sent:
                self._sent.setdefault((message.message, message.seq), []).append(number)
            trigger = run.trigger
            if isinstance(trigger, MessageTrigger) and trigger.sender == record.agent_id:
                self._received.setdefault((trigger.message, trigger.sequence), []).append(number)

    def runs_that_sent(self, message: object, sequence: object) -> list[int]:
        """Return the positions of the handler runs that sent a message of this type with this sequence number. Each
        incarnation has at most one such run.
        """
        return self._sent.get((message, sequence), [])

    def runs_that_received(self, message: object, sequence: object) -> list[int]:
        """Return the positions of the second agent's handler runs that were triggered by a message of this type with
        this sequence number.
        """
        return self._received.get((message, sequence), [])

    def __iter__(self) -> Iterator[PeerMessage]:
        """Yield the messages that are certainly in both records, in the order of the replayed agent's record."""
        own, other = self._agents
        for position, entry in enumerate(self._record.entries):
            run = entry.content
            if not isinstance(run, HandlerRun):
                continue
            trigger = run.trigger
            if isinstance(trigger, MessageTrigger) and trigger.sender == other:
                sent = self.runs_that_sent(trigger.message, trigger.sequence)
                if len(sent) == 1:
                    yield PeerMessage(position, DeliveredMessage(other, own, self.runs[sent[0]][1].t, run.t))
            for message in run.sent:
                received = self.runs_that_received(message.message, message.seq)
                if len(received) == 1:
                    yield PeerMessage(position, DeliveredMessage(own, other, run.t, self.runs[received[0]][1].t))
