"""The messages between the agent of a record and another, as both records have them."""

from collections.abc import Iterator
from typing import NamedTuple

from harness.archive.traces import Trace
from harness.field.reconstruct._clock_offsets import Delivery
from harness.field.replay._agent_record import Record
from ucp.trace import HandlerRun
from ucp.trigger import MessageTrigger


class Exchange(NamedTuple):
    """A message on its way, and which entry of the record sent or heard it."""

    position: int
    delivery: Delivery


class Exchanges:
    """`runs` are the other's handler runs, with their lines."""

    def __init__(self, record: Record, theirs: Trace) -> None:
        self.runs = [numbered for life in theirs.incarnations() for numbered in life]
        self._record = record
        self._agents = record.agent_id, theirs.header.agent_id
        self._sent: dict[tuple[object, object], list[int]] = {}
        self._heard: dict[tuple[object, object], list[int]] = {}
        for number, (_, run) in enumerate(self.runs):
            for message in run.sent:
                self._sent.setdefault((message.message, message.seq), []).append(number)
            trigger = run.trigger
            if isinstance(trigger, MessageTrigger) and trigger.sender == record.agent_id:
                self._heard.setdefault((trigger.message, trigger.sequence), []).append(number)

    def that_sent(self, message: object, sequence: object) -> list[int]:
        """The other's runs that sent a message of this type and number: one in each of its lives, at most."""
        return self._sent.get((message, sequence), [])

    def that_heard(self, message: object, sequence: object) -> list[int]:
        """The other's runs that such a message of ours triggered."""
        return self._heard.get((message, sequence), [])

    def __iter__(self) -> Iterator[Exchange]:
        """What is certain to be the same message on both records, in the order of ours."""
        own, other = self._agents
        for position, entry in enumerate(self._record.entries):
            run = entry.what
            if not isinstance(run, HandlerRun):
                continue
            trigger = run.trigger
            if isinstance(trigger, MessageTrigger) and trigger.sender == other:
                sent = self.that_sent(trigger.message, trigger.sequence)
                if len(sent) == 1:
                    yield Exchange(position, Delivery(other, own, self.runs[sent[0]][1].t, run.t))
            for message in run.sent:
                heard = self.that_heard(message.message, message.seq)
                if len(heard) == 1:
                    yield Exchange(position, Delivery(own, other, run.t, self.runs[heard[0]][1].t))
