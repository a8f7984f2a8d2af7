"""Find the messages that the records of two agents contain, and estimate the offsets and drifts of the agents' clocks.

The only data for the estimate are the times at which messages were sent and received. Each message was received after
it was sent. Let t be the time on the clock of agent A, and u the time on the clock of agent B. The clocks are related
by a line that converts t to u. A message from A to B is a point (t sent, u received) above this line. A message from B
to A is a point (t received, u sent) below it. Fast messages are close to the line. The estimate is the line with the
greatest distance to both groups of points, similar to NTP, which uses the messages with minimal delays. A line has an
offset and a drift. Drift is assumed only if the points contradict a line without drift, because a few messages do not
prove a drift.

No clock is assumed to be more accurate than another. The reference is the clock of the agent that exchanged the most
messages.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
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
                if len(sent) == 1 and _is_same(self.runs[sent[0]][1], run):
                    yield PeerMessage(position, DeliveredMessage(other, own, self.runs[sent[0]][1].t, run.t))
            for message in run.sent:
                received = self.runs_that_received(message.message, message.seq)
                if len(received) == 1 and _is_same(run, self.runs[received[0]][1]):
                    yield PeerMessage(position, DeliveredMessage(own, other, run.t, self.runs[received[0]][1].t))


def _is_same(sender: HandlerRun, receiver: HandlerRun) -> bool:
    """Return false if the received datagram differs from all datagrams that this handler run of the sender sent. A
    restarted agent uses sequence numbers again, so type and sequence number alone do not identify a message.
    """
    datagrams = [message.datagram for message in sender.sent]
    return receiver.input is None or None in datagrams or receiver.input in datagrams


MIN_RATE, MAX_RATE = 0.55, 1.8
"""Limits of plausible clock rates."""
SEARCH_STEPS = 100
MESSAGES_FOR_DRIFT = 8
"""Minimum number of messages in each direction for an estimate of drift."""
OFFSET_DIGITS, DRIFT_DIGITS = 6, 9


@dataclass(frozen=True)
class ClockLine:
    """A linear relation between two clocks. When the reference clock shows t, the other clock shows offset_s + rate *
    t.
    """

    offset_s: float = 0.0
    rate: float = 1.0

    def shows(self, t: float) -> float:
        return self.offset_s + self.rate * t

    def at(self, shown: float) -> float:
        """Return the time on the reference clock when this clock shows `shown`."""
        return (shown - self.offset_s) / self.rate

    def after(self, first: "ClockLine") -> "ClockLine":
        """Combine two clock relations. The result relates this clock to the reference clock of `first`."""
        return ClockLine(self.shows(first.offset_s), self.rate * first.rate)

    def inverse(self) -> "ClockLine":
        return ClockLine(-self.offset_s / self.rate, 1 / self.rate)


Point = tuple[float, float]


def estimate(
    agents: Iterable[int],
    deliveries: Iterable[DeliveredMessage],
    ahead_s: Mapping[int, float] = {},
) -> dict[int, ClockLine]:
    """Return the clock of each agent relative to a common reference clock. `ahead_s` contains the differences between
    clocks and GPS time. These differences are used for agents that exchanged no messages with the reference agent.
    Without such a difference, the agent's clock is assumed to equal the reference clock.
    """
    between: dict[tuple[int, int], tuple[list[Point], list[Point]]] = defaultdict(lambda: ([], []))
    for delivery in deliveries:
        if delivery.sender < delivery.receiver:
            above, _ = between[delivery.sender, delivery.receiver]
            above.append((delivery.sent_s, delivery.received_s))
        else:
            _, below = between[delivery.receiver, delivery.sender]
            below.append((delivery.received_s, delivery.sent_s))
    weight = {
        pair: min(len(above), len(below)) + 1e-3 * (len(above) + len(below)) for pair, (above, below) in between.items()
    }
    total: dict[int, float] = dict.fromkeys(agents, 0.0)
    for (a, b), pair_weight in weight.items():
        total[a] += pair_weight
        total[b] += pair_weight
    clocks: dict[int, ClockLine] = {}
    while unplaced := [agent for agent in total if agent not in clocks]:
        links = [
            (pair_weight, pair) for pair, pair_weight in weight.items() if (pair[0] in clocks) != (pair[1] in clocks)
        ]
        if not links:
            known = next((agent for agent in clocks if agent in ahead_s), None)
            candidates = [agent for agent in unplaced if known is not None and agent in ahead_s] or unplaced
            reference = max(candidates, key=lambda agent: (total[agent], -agent))
            if known is not None and reference in ahead_s:
                clocks[reference] = ClockLine(ahead_s[reference] - ahead_s[known]).after(clocks[known])
            else:
                clocks[reference] = ClockLine()
            continue
        _, (a, b) = max(links)
        line = fit_line(*between[a, b])
        if a in clocks:
            clocks[b] = line.after(clocks[a])
        else:
            clocks[a] = line.inverse().after(clocks[b])
    return clocks


def _height(hull: list[Point], rate: float, of: Callable[[Iterator[float]], float]) -> float:
    """Return the value at t = 0 of a line with slope `rate` through one of the points. If `of` is `min`, this is the
    lowest such line. If `of` is `max`, this is the highest such line.
    """
    return of(u - rate * t for t, u in hull)


def _hull(points: list[Point], side: int) -> list[Point]:
    """Return the lower (`side` 1) or upper (`side` -1) part of the convex hull of the points."""
    hull: list[Point] = []
    for t, u in sorted(points, key=lambda point: (point[0], side * point[1])):
        if hull and hull[-1][0] == t:
            continue
        while len(hull) > 1 and side * _cross_product(hull[-2], hull[-1], (t, u)) <= 0:
            hull.pop()
        hull.append((t, u))
    return hull


def _cross_product(a: Point, b: Point, c: Point) -> float:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def fit_line(above: list[Point], below: list[Point]) -> ClockLine:
    """Return the line that separates two sets of points and has the greatest distance from both."""
    lower, upper = _hull(above, 1), _hull(below, -1)

    def room(rate: float) -> float:
        return _height(lower, rate, min) - _height(upper, rate, max)

    rate = 1.0
    if min(len(above), len(below)) >= MESSAGES_FOR_DRIFT and room(1.0) < 0:
        low, high = MIN_RATE, MAX_RATE
        for _ in range(SEARCH_STEPS):  # The distance is a concave function of the rate.
            third = (high - low) / 3
            if room(low + third) < room(high - third):
                low += third
            else:
                high -= third
        rate = (low + high) / 2
    if above and below:
        return ClockLine((_height(lower, rate, min) + _height(upper, rate, max)) / 2, rate)
    return ClockLine(_height(lower, rate, min) if above else _height(upper, rate, max), rate)
