"""Find the messages between the agent of a record and one other agent in both of their records."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

from harness.archive.traces import Trace
from harness.field.replay._agent_record import RecordedTrace
from ucp.trace import HandlerRun
from ucp.trigger import MessageTrigger


@dataclass(frozen=True, slots=True)
class DeliveredMessage:
    """A message with the times at which it was sent and received, each on the clock of the agent there."""

    sender: int
    receiver: int
    sent_s: float
    received_s: float


class PeerMessage(NamedTuple):
    """A message, and the position of the trace entry that sent or received it."""

    position: int
    delivery: DeliveredMessage


class PeerMessages:
    """The messages between two agents. `runs` contains the handler runs of the other agent with line numbers."""

    def __init__(self, record: RecordedTrace, other_trace: Trace) -> None:
        self.runs = [numbered for numbered_runs in other_trace.incarnations() for numbered in numbered_runs]
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
        """Return the positions of handler runs that sent a message of this type and number. Between two restarts there
        is at most one.
        """
        return self._sent.get((message, sequence), [])

    def runs_that_received(self, message: object, sequence: object) -> list[int]:
        """Return the positions of runs that such a message of our agent triggered."""
        return self._received.get((message, sequence), [])

    def __iter__(self) -> Iterator[PeerMessage]:
        """Yield the messages that both records certainly contain, in the order of our record."""
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
