"""Record the random parts of a run: the events that agents logged, and the messages that were lost.

A scenario that contains these parts as a script plays the same run again. This works because the latencies of each
sender come from a separate random stream, and a latency is drawn for every broadcast, even for a lost one. The method
does not work for networks that duplicate messages. These networks also draw a latency for the second copy, but a
scripted fate drops either all copies or none. `_smaller.shrink` therefore checks that a recording reproduces the
violation.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from harness.checker import Result
from harness.play.simulation.fate_script import DecidedDelivery, FateScript, NameOf
from harness.run.simulate import MemoryRecorder, simulate_in_memory
from harness.scenario import Scenario
from harness.scenario.fates import Fate
from netem.medium import RandomDraws
from ucp.messages import CommitBlock, Message, block_named
from ucp.trace import Entry, HandlerRun
from ucp.trigger import MessageTrigger


@dataclass(frozen=True, slots=True)
class RecordedEvent:
    """An event that an agent logged in the recorded run. `completes` is true if the event completed a block."""

    at_s: float
    agent: int
    bytes: int
    completes: bool


@dataclass(frozen=True, slots=True)
class LostMessage:
    """A message that one receiver did not receive."""

    at_s: float
    """The mission second at which the message was sent."""
    message: str
    sender: int
    receiver: int
    count: int
    """The number of the message among the messages of this type from this sender."""
    block: str | None
    by_quirk: bool = False
    """True if the message arrived, but the receiver ignored it because of a deliberate error (quirk)."""


@dataclass(frozen=True)
class Recording:
    """A recorded run with its verdict. The logged events and the lost messages are in order of time."""

    result: Result
    logged: list[RecordedEvent]
    lost: list[LostMessage]


def record(scenario: Scenario, seed: int) -> Recording:
    """Play a run and record it."""
    tape = _EventRecorder()
    result = simulate_in_memory(tape, scenario, seed, fate_script=partial(_RecordingScript, tape=tape)).result
    return Recording(result, tape.events, sorted(tape.lost, key=lambda lost: lost.at_s))


class _EventRecorder(MemoryRecorder):
    def __init__(self) -> None:
        super().__init__(tracing=True)
        self.events: list[RecordedEvent] = []
        self.lost: list[LostMessage] = []
        self.sent: dict[tuple[int, int], LostMessage] = {}
        """Sender and sequence number of a sent Commit Block message -> the entry that is added to `lost` for each
        receiver that ignores the message.
        """
        self._last_of: dict[int, int] = {}
        self._counts: Counter[int] = Counter()

    def logged(self, at_s: float, agent_id: int, data_bytes: int) -> None:
        self._last_of[agent_id] = len(self.events)
        self.events.append(RecordedEvent(at_s, agent_id, data_bytes, completes=False))

    def write(self, agent_id: int, entries: list[Entry]) -> None:
        super().write(agent_id, entries)
        for run in entries:
            if not isinstance(run, HandlerRun):
                continue
            if run.handler == "build_data_block" and run.branch == "full" and agent_id in self._last_of:
                last = self.events[self._last_of[agent_id]]
                self.events[self._last_of[agent_id]] = RecordedEvent(last.at_s, last.agent, last.bytes, completes=True)
            for sent in run.sent:
                if sent.message == CommitBlock.NAME:
                    self._counts[agent_id] += 1
                    count = self._counts[agent_id]
                    self.sent[agent_id, sent.seq] = LostMessage(run.t, sent.message, agent_id, 0, count, None)
            if run.branch == "ignored by quirk" and isinstance(run.trigger, MessageTrigger):
                lost = self.sent.get((run.trigger.sender, run.trigger.sequence))
                if lost is not None:  # a rogue node's is no agent's
                    self.lost.append(
                        LostMessage(lost.at_s, lost.message, lost.sender, agent_id, lost.count, None, by_quirk=True)
                    )


class _RecordingScript(FateScript):
    """A script that decides which messages are lost or delayed. The object also records each message that is lost
    because of the script or by chance.
    """

    def __init__(self, fates: Sequence[Fate], roster: Sequence[int], name_of: NameOf, *, tape: _EventRecorder) -> None:
        super().__init__(fates, roster, name_of)
        self.listens = True
        self._name = name_of
        self._roster = roster
        self._tape = tape
        self._sent: Counter[tuple[str, int]] = Counter()

    def decide(
        self, now: float, sender: int, message: Message, draws: RandomDraws, hears: Any
    ) -> DecidedDelivery | None:
        decided = super().decide(now, sender, message, draws, hears)
        self._sent[message.NAME, sender] += 1
        arrivals = draws.to_all() if decided is None else [*decided.arrivals, *decided.waiting]
        reached = {number for number, _ in arrivals}
        block_hash = block_named(message)
        for number, receiver in enumerate(self._roster):
            if receiver != sender and number not in reached and hears(number):
                count = self._sent[message.NAME, sender]
                name = self._name(block_hash) if block_hash else None
                self._tape.lost.append(LostMessage(now, message.NAME, sender, receiver, count, name))
        return decided
