"""Put the inputs of all agents on one common time axis.

The common times follow three rules. The inputs of each agent keep their order. A message arrives after it was sent. A
timer does not expire before its duration is over. Each input is planned at the earliest time that these rules allow,
but not before its recorded time on the agent's clock. The simulated chains therefore equal the recorded ones, even if a
clock was changed or is known only roughly. The times between inputs may become longer than in the record.

A *stray* is a received datagram that no simulated agent sent. The scenario sends a stray as a separate datagram. A
datagram that was received before it was sent, according to the records, also becomes a stray.
"""

import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from heapq import heappop, heappush

from harness.field.reconstruct._agent_inputs import BootedFromDisk, DatagramReceived
from harness.field.reconstruct._rehearsal import PlayedInput, SoloSimulation, TimerStart
from harness.field.replay._peer_messages import MAX_RATE, MIN_RATE, ClockLine, DeliveredMessage, estimate

MIN_GAP_S = 2e-5
"""Minimum number of seconds between two inputs of an agent, and between the sending and the arrival of a message."""
DIGITS = 6
MILLION = 10.0**DIGITS
MAX_WAIT_S = 86400.0
"""Maximum mission second of the first input. If the first input is later, the clocks do not start at the beginning of
the mission.
"""
MAX_CLOCK_ERROR_S = 1.0
"""Maximum number of seconds by which a datagram may seem to be sent after its arrival. The limit is used to select one
of several equal datagrams.
"""


@dataclass(slots=True)
class TimedInput:
    """An input of an agent at mission second `at_s`. If a simulated agent sent the input as a datagram, `sender` and
    `number` identify this datagram. `late_s` is the delay of an expired timer.
    """

    played: PlayedInput
    at_s: float
    late_s: float = 0.0
    sender: int | None = None
    number: int | None = None


@dataclass
class IncarnationTimes:
    """The mission seconds of the first and the last input of an incarnation."""

    number: int
    present_s: float
    """A time at which the incarnation was running: the sending time of its first received message, or the time of its
    first other input.
    """
    began_s: float
    ended_s: float
    boots: bool
    """True if the incarnation began with data on the disk."""


@dataclass
class InputTimetable:
    """The inputs of all agents in mission time."""

    clocks: dict[int, ClockLine]
    """The relation between each agent's clock and mission time."""
    inputs: dict[int, list[TimedInput]] = field(default_factory=dict)
    sent: dict[int, list[bytes]] = field(default_factory=dict)
    """All datagrams that each agent sends, in order."""
    sent_at_s: dict[int, list[float]] = field(default_factory=dict)
    lateness: dict[int, dict[int, float]] = field(default_factory=dict)
    """The delay of each timer in seconds. The first key is the agent ID, and the second is the number of the timer."""
    contradictions: list[str] = field(default_factory=list)
    """A sentence for each record that contradicts every order of inputs."""

    def incarnations(self, agent_id: int) -> list[IncarnationTimes]:
        incarnations: list[IncarnationTimes] = []
        number = -1
        for timed_input in self.inputs[agent_id]:
            if timed_input.played.incarnation != number:
                number = timed_input.played.incarnation
                boots = isinstance(timed_input.played.input.cause, BootedFromDisk)
                incarnations.append(
                    IncarnationTimes(number, timed_input.at_s, timed_input.at_s, timed_input.at_s, boots)
                )
            incarnations[-1].ended_s = timed_input.at_s
            if timed_input.sender is not None and timed_input.number is not None:
                incarnations[-1].present_s = min(
                    incarnations[-1].present_s, self.sent_at_s[timed_input.sender][timed_input.number]
                )
        return incarnations


def timetable(rehearsals: Mapping[int, SoloSimulation], ahead_s: Mapping[int, float] = {}) -> InputTimetable:
    """Return the inputs of all agents on one time axis. `ahead_s` contains the differences of the agents' clocks from
    GPS time.
    """
    senders = _DatagramsBySender(rehearsals)
    clocks = estimate(rehearsals, senders.deliveries(), ahead_s)
    clocks = _from_zero(clocks, rehearsals)
    return _TimetablePlanner(rehearsals, senders, clocks).plan()


def _from_zero(clocks: Mapping[int, ClockLine], rehearsals: Mapping[int, SoloSimulation]) -> dict[int, ClockLine]:
    """Choose mission second 0, and return the clocks of all agents relative to it. Usually, mission second 0 is the
    time at which the first clock shows 0. If the first input is earlier or much later, mission second 0 is directly
    before this input.
    """
    played = {agent: rehearsal.played[0] for agent, rehearsal in rehearsals.items() if rehearsal.played}
    first = min((clocks[agent].at(of_agent.input.at_s) for agent, of_agent in played.items()), default=0.0)
    zero = min(line.at(0.0) for line in clocks.values())
    start = zero if MIN_GAP_S < first - zero < MAX_WAIT_S else first - MIN_GAP_S
    begin = ClockLine(start)
    rounded = {}
    for agent, line in clocks.items():
        line = line.after(begin) if MIN_RATE <= line.rate <= MAX_RATE else ClockLine().after(begin)
        rounded[agent] = ClockLine(round(line.offset_s, DIGITS), 1 + round(line.rate - 1, 9))
    return rounded


class _DatagramsBySender:
    """The datagrams that each simulated agent sent, in order. `of` finds the agents that sent a given datagram."""

    def __init__(self, rehearsals: Mapping[int, SoloSimulation]) -> None:
        self._rehearsals = rehearsals
        self.sent: dict[int, list[bytes]] = {agent: [] for agent in rehearsals}
        self._sent_by: dict[int, list[int]] = {agent: [] for agent in rehearsals}
        """Agent -> for each datagram that the agent sent, the position of the input that caused it."""
        self._numbers: dict[bytes, list[tuple[int, int]]] = defaultdict(list)
        for agent, rehearsal in rehearsals.items():
            for place, played in enumerate(rehearsal.played):
                for datagram in played.sent:
                    self._numbers[datagram].append((agent, len(self.sent[agent])))
                    self.sent[agent].append(datagram)
                    self._sent_by[agent].append(place)

    def of(self, datagram: bytes, receiver: int) -> list[tuple[int, int]]:
        """Return the senders of this datagram except the receiver. Each sender comes with the number of the datagram
        among all datagrams that this sender sent.
        """
        return [sent for sent in self._numbers.get(datagram, ()) if sent[0] != receiver]

    def sent_s(self, agent: int, number: int) -> float:
        """Return the time at which a datagram was sent, on the sender's clock."""
        return self._rehearsals[agent].played[self._sent_by[agent][number]].input.at_s

    def deliveries(self) -> list[DeliveredMessage]:
        """Return the sending time and the receiving time of each received datagram whose sender is certain, because
        exactly one agent sent it.
        """
        found = []
        for receiver, rehearsal in self._rehearsals.items():
            for played in rehearsal.played:
                if isinstance(played.input.cause, DatagramReceived):
                    sent = self.of(played.input.cause.datagram, receiver)
                    if len(sent) == 1:
                        sender, number = sent[0]
                        found.append(DeliveredMessage(sender, receiver, self.sent_s(sender, number), played.input.at_s))
        return found


class _TimetablePlanner:
    def __init__(
        self, rehearsals: Mapping[int, SoloSimulation], senders: _DatagramsBySender, clocks: dict[int, ClockLine]
    ) -> None:
        self._rehearsals = rehearsals
        self._senders = senders
        self._table = InputTimetable(clocks, sent=senders.sent)
        for agent in rehearsals:
            self._table.inputs[agent], self._table.sent_at_s[agent], self._table.lateness[agent] = [], [], {}
        self._played = {agent: rehearsal.played for agent, rehearsal in rehearsals.items()}
        self._next = dict.fromkeys(rehearsals, 0)
        self._at: dict[int, list[float]] = {agent: [0.0] * len(played) for agent, played in self._played.items()}
        """The planned time of each input on the agent's own clock. The key is the agent ID, and the index is the
        position of the input.
        """
        self._ready: list[tuple[float, int]] = []
        self._waiting: dict[tuple[int, int], list[int]] = defaultdict(list)
        self._as_strays: set[tuple[int, int]] = set()

    def plan(self) -> InputTimetable:
        for agent in self._played:
            self._queue(agent)
        while True:
            while self._ready:
                _, agent = heappop(self._ready)
                self._schedule(agent)
            if not self._waiting:
                break
            self._break_cycle()
        for agent, rehearsal in self._rehearsals.items():
            for incarnation in self._table.incarnations(agent):
                for timer in rehearsal.running_at_end[incarnation.number]:
                    self._keep_running(agent, timer, incarnation.ended_s + MIN_GAP_S)
        return self._table

    def _queue(self, agent: int) -> None:
        """Find the next input of the agent that has no mission time yet. Record that this input is ready, or that it
        waits for a message which another agent has not sent yet.
        """
        played = self._played[agent]
        place = self._next[agent]
        while place < len(played) and not played[place].matters:
            place += 1
        self._next[agent] = place
        if place == len(played):
            return
        sent = self._sent(agent, place)
        if sent is not None and len(self._table.sent_at_s[sent[0]]) <= sent[1]:
            self._waiting[sent].append(agent)
        else:
            heappush(self._ready, (self._recorded_s(agent, place), agent))

    def _recorded_s(self, agent: int, place: int) -> float:
        return self._table.clocks[agent].at(self._played[agent][place].input.at_s)

    def _sent(self, agent: int, place: int) -> tuple[int, int] | None:
        """Return the sender and the number of the datagram that is received in this input. Return None if the input is
        no datagram, or if no simulated agent sent the datagram.
        """
        cause = self._played[agent][place].input.cause
        if not isinstance(cause, DatagramReceived) or (agent, place) in self._as_strays:
            return None
        candidates = self._senders.of(cause.datagram, agent)
        if len(candidates) < 2:
            return candidates[0] if candidates else None
        limit_s = self._recorded_s(agent, place) + MAX_CLOCK_ERROR_S
        before = [sent for sent in candidates if self._table.clocks[sent[0]].at(self._senders.sent_s(*sent)) <= limit_s]
        return before[-1] if before else candidates[0]

    def _break_cycle(self) -> None:
        """Resolve a deadlock in which each agent waits for a message that another agent has not yet sent. The earliest
        waiting input becomes a *stray*, a datagram that no agent of the scenario sends.
        """
        waiting = [
            (self._recorded_s(agent, self._next[agent]), agent, sent)
            for sent, agents in self._waiting.items()
            for agent in agents
        ]
        at_s, agent, sent = min(waiting)
        place = self._next[agent]
        self._waiting[sent].remove(agent)
        if not self._waiting[sent]:
            del self._waiting[sent]
        self._as_strays.add((agent, place))
        line = self._played[agent][place].input.line
        self._table.contradictions.append(
            f"agent {agent} recorded a message before agent {sent[0]} sent it (trace line {line}, "
            f"t={self._played[agent][place].input.at_s:g} s): the scenario sends it at the recorded time"
        )
        heappush(self._ready, (at_s, agent))

    def _schedule(self, agent: int) -> None:
        place = self._next[agent]
        played = self._played[agent][place]
        inputs, clock = self._table.inputs[agent], self._table.clocks[agent]
        sent = self._sent(agent, place)
        earliest_s = self._recorded_s(agent, place)
        if inputs:
            before = inputs[-1]
            gap = MIN_GAP_S if before.played.incarnation == played.incarnation else 10 * MIN_GAP_S
            earliest_s = max(earliest_s, before.at_s + gap)
        if sent is not None:
            earliest_s = max(earliest_s, self._table.sent_at_s[sent[0]][sent[1]] + MIN_GAP_S)
        timed_input = TimedInput(played, _rounded_up(max(earliest_s, MIN_GAP_S)))
        if sent is not None:
            timed_input.sender, timed_input.number = sent
        local = clock.shows(timed_input.at_s)
        if played.expired is not None:
            expiry_local, expiry_s = self._expiry(agent, played.expired)
            late_s = _rounded_up(earliest_s - expiry_s) if earliest_s > expiry_s else 0.0
            timed_input.at_s = expiry_s + late_s
            local = max(expiry_local, clock.shows(timed_input.at_s))
            self._delay(agent, played.expired, late_s)
            timed_input.late_s = late_s
        for stopped in played.stopped:
            self._keep_running(agent, stopped, timed_input.at_s)
        self._at[agent][place] = local
        inputs.append(timed_input)
        for _ in played.sent:
            number = len(self._table.sent_at_s[agent])
            self._table.sent_at_s[agent].append(timed_input.at_s)
            for receiver in self._waiting.pop((agent, number), ()):
                heappush(self._ready, (self._recorded_s(receiver, self._next[receiver]), receiver))
        self._next[agent] += 1
        self._queue(agent)

    def _expiry(self, agent: int, timer: TimerStart) -> tuple[float, float]:
        """Return the time at which a timer expires without delay, on the agent's clock and in mission seconds."""
        expiry_local = self._at[agent][timer.place] + timer.duration_s
        return expiry_local, self._table.clocks[agent].at(expiry_local)

    def _keep_running(self, agent: int, timer: TimerStart, until_s: float) -> None:
        """Delay the expiry of a timer, so that the timer still runs at mission second `until_s`."""
        _, expiry_s = self._expiry(agent, timer)
        if expiry_s < until_s + MIN_GAP_S:
            self._delay(agent, timer, _rounded_up(until_s + 2 * MIN_GAP_S - expiry_s))

    def _delay(self, agent: int, timer: TimerStart, delay_s: float) -> None:
        if delay_s > 0:
            self._table.lateness[agent][timer.number] = delay_s


def _rounded_up(seconds: float) -> float:
    return math.ceil(round(seconds * MILLION, 3)) / MILLION
