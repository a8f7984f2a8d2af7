"""Simulate the network in virtual time: a queue of messages, events and timer expiries in order of time.

Agents broadcast each message, so each message reaches nearly all agents. Most of these deliveries change no agent
(`ucp.interest`). Unless the trace needs every handler run, the air omits deliveries without effect:

- A query reaches all agents except those that will still be in a reconcile when it arrives.
- An answer reaches only the agents that have sent the query, or will have sent it when the answer arrives.

The omission changes the state of no agent, for two reasons. First, at each broadcast the network draws the random
numbers for all receivers, including those whose delivery is omitted. Second, the position of an input in the order of
inputs (time, rank, receiver) does not depend on other deliveries.

Most answers have no other effect than that the agent counts them. The air does not deliver these answers one by one. It
stores them. Before the agent reads the number of answers, the air computes when the answers arrived, and passes them to
the agent in this order (`take_answers`).

If vehicles share a radio channel, every message occupies it, even if it has no effect on any agent. A message arrives
when its frame ends. The air cannot know earlier which agents receive the message, and which of them the message
affects. It therefore delivers the message at the end of the frame, and stores no answers.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from heapq import heappop, heappush
from typing import Literal

from harness.play._shared_channel import ChannelTraffic
from harness.play.simulation.fate_script import RIGHT_AFTER_S, FateScript
from netem.channel import EndedTransmission, numbers
from netem.conditions import NetworkConditions
from netem.medium import LATENCY, Medium, RandomDraws
from netem.radio import Place
from ucp.interest import ANSWERED, ASKED, MATTERS, ONLY_COUNTED, STILL_ASKED, Question
from ucp.messages import BlockAddResponse, Message
from ucp.settings import Settings
from ucp.state import AgentState
from ucp.trace import RecordedBytes

NEVER = float("inf")
DISCARD_EVERY = 1000
"""Number of broadcasts after which obsolete answers are discarded."""


@dataclass(slots=True, eq=False)
class MessageInFlight:
    """A message that was broadcast and has not yet reached all of its receivers."""

    sender: int
    sequence: int
    message: Message
    matters: Callable[[AgentState, int, Message], bool]
    sent_at: float
    rank: int
    draws: RandomDraws
    datagram: RecordedBytes | None
    """The datagram in the form that traces record, or None if no code has encoded it yet."""
    encoded: bytes | None = None
    """The datagram as bytes, which each receiver decodes itself. The value is None if the receivers share `message`."""

    def __lt__(self, other: object) -> bool:
        return False  # two copies with equal time, rank and receiver are equal


QueryKind = Literal["vote", "reconcile"]
"""The kind of a query: part of a vote or of a reconcile. An agent waits for the answers to at most one query of each
kind.
"""


@dataclass(slots=True, eq=False)
class _AnswerLog:
    """The stored answers to one query, and the agents that sent this query."""

    answers: dict[int, list[MessageInFlight]] = field(default_factory=dict)
    """The answers of each sender to the query, in the order of sending."""
    askers: set[int] = field(default_factory=set)
    """Numbers of the agents that have sent the query and still accept answers to it."""
    answer_count: int = 0
    """Number of all answers to the query."""
    quiet_at: float = 0.0
    """The mission second after which no further answer to the query arrives."""


@dataclass(slots=True, eq=False)
class _OpenQuery:
    """A query to which an agent still accepts answers."""

    question: Question
    log: _AnswerLog
    since: "ScheduledInput"
    """The input during which the agent sent the query. Only answers that arrive after this input count."""
    answered_by: set[int] = field(default_factory=set)
    """Senders whose answers to the query the agent has received."""
    answers_seen: int = 0
    """Number of answers to the query that existed at the last call of `take_answers`."""
    next_at: float = 0.0
    """Time at which the next of the stored answers to the query arrives."""
    first: tuple[float, int] = (NEVER, 0)
    """Time and rank of the first answer to the query, if the agent uses only one answer."""


DueEvent = tuple[int, int, bytes, int | None]
"""An event to log: (incarnation, event ID, data, time in microseconds).

Incarnation 0 stands for the current incarnation. If the time is None, the event has the time of the agent's clock.
"""


@dataclass(frozen=True, slots=True)
class StrayDatagram:
    """A datagram that is not a message of the agent, but has the address of vehicle `source` as its sender."""

    source: int
    datagram: bytes
    sequence: None = None


class _BroadcastCopies:
    """The copies of a broadcast that reach receivers. Each copy is a pair of receiver number and delay in seconds."""

    def __init__(self, copies: list[tuple[int, float]]) -> None:
        self._copies = copies
        self.latest = max((delay for _, delay in copies), default=0.0)

    def copies_to(self, receiver: int) -> tuple[float, ...]:
        return tuple(delay for number, delay in self._copies if number == receiver)

    def to_all(self) -> list[tuple[int, float]]:
        return self._copies


_UNKNOWN = _BroadcastCopies([])
"""A placeholder for the copies of a message on a shared channel. The receivers are known only when the frame ends."""

ScheduledInput = tuple[float, int, int, MessageInFlight | DueEvent | StrayDatagram | None]
"""An input of an agent: (mission second, rank, agent number, input). The input is a message, an event, or None for a
timer expiry. If two inputs have the same time, the one with the lower rank comes first.

The rogue node has the number after the last agent.
"""


class VirtualAir:
    """The simulated network between the agents in `roster`. The number of an agent is its index in the roster.

    If `deliver_all` is true, messages that cannot affect their receiver are delivered, too.
    """

    def __init__(
        self,
        roster: tuple[int, ...],
        settings: Settings,
        medium: Medium,
        script: FateScript,
        channel: ChannelTraffic[MessageInFlight | StrayDatagram] | None,
        *,
        deliver_all: bool,
    ) -> None:
        self.busy_until = [0.0] * len(roster)
        """The earliest possible end of each agent's current reconcile, by agent number. Until this time, the agent
        answers no query.
        """
        self.started_at = [0.0] * len(roster)
        """The time at which each agent started, by agent number. The agent does not receive messages that were sent
        before this time.
        """
        self.paused_at: dict[int, float] = {}
        """The start of the pause of each paused agent, by agent number. Inputs of the agent wait until the end of the
        pause.
        """
        self.open_queries: list[dict[QueryKind, _OpenQuery]] = [{} for _ in roster]
        """The open queries of each agent, by agent number."""
        self._quiet_at = 0.0
        """The time at which all messages in transit have arrived. Messages on a shared channel are not included."""
        self.position: ScheduledInput = (0.0, 0, 0, None)
        """The input that is being handled."""
        self._roster = roster
        self._settings = settings
        self._medium = medium
        self._script = script
        self._channel = channel
        self._deliver_all = deliver_all
        self._queue: list[ScheduledInput] = []
        self._rank = 0
        self._answer_logs: dict[Question, _AnswerLog] = defaultdict(_AnswerLog)
        self._discarded_at = 0
        self._waiting: dict[str, list[tuple[MessageInFlight, int]]] = defaultdict(list)
        self._arrived_at: dict[str, float] = {}
        self._held: dict[int, list[tuple[MessageInFlight, int, float]]] = defaultdict(list)
        """Number of a hold -> the messages that it delays. Each message has its receiver, and the time at which it
        would have arrived without the hold.
        """

    def deliver_everything(self) -> None:
        """Deliver all messages from now on, including those that cannot have an effect on their receiver."""
        self._deliver_all = True

    @property
    def quiet_at(self) -> float:
        """The latest mission second at which a message that is in transit can arrive.

        While a shared channel has messages, this is at least the time of the channel's next event.
        """
        channel = self._channel
        return self._quiet_at if channel is None or channel.next_s == NEVER else max(self._quiet_at, channel.next_s)

    def inputs_until(self, mission_s: float) -> Iterator[ScheduledInput]:
        """Yield the inputs of all agents up to and including `mission_s`, in order. The caller may add inputs while it
        iterates.
        """
        queue = self._queue
        while True:
            channel = self._channel
            while channel is not None and channel.next_s <= mission_s and not (queue and queue[0][0] <= channel.next_s):
                at = channel.next_s
                for transmission, message in channel.advance():
                    self._deliver_frame(at, transmission, message)
            if not queue or queue[0][0] > mission_s:
                break
            happening = heappop(queue)
            self.position = happening
            yield happening
        self._rank += 1
        self.position = (mission_s, self._rank, 0, None)

    def schedule(self, at: float, number: int, what: DueEvent | None) -> None:
        """Schedule an event that the agent logs. If `what` is None, schedule the expiry of a timer."""
        self._rank += 1
        heappush(self._queue, (at, self._rank, number, what))

    def timer_order(self, ends: Mapping[int, float]) -> list[int]:
        """Return the agents in the order of their next timer expiries. `ends` contains the times of these expiries."""
        queue = sorted(happening[:3] for happening in self._queue if happening[3] is None)
        return list(dict.fromkeys(number for at, _, number in queue if ends.get(number) == at))

    def inject(self, at: float, stray: StrayDatagram, numbers: Iterable[int]) -> None:
        """Schedule the arrival of a stray datagram (a datagram that is not a message of an agent) at these agents."""
        self._rank += 1
        self._quiet_at = max(self._quiet_at, at)
        for number in numbers:
            heappush(self._queue, (at, self._rank, number, stray))

    def broadcast_stray(self, now: float, number: int, datagram: bytes) -> None:
        """Broadcast a datagram that is not a valid message. Scripted delivery rules do not apply to it."""
        stray = StrayDatagram(self._roster[number], datagram)
        if self._channel is not None:
            self._channel.send(now, number, stray, len(datagram))
            return
        for receiver, delay in self._medium.draw(number, now, len(datagram)).to_all():
            self.inject(now + delay, stray, [receiver])

    def broadcast(
        self,
        now: float,
        number: int,
        sequence: int,
        message: Message,
        data_bytes: int,
        datagram: RecordedBytes | None = None,
        encoded: bytes | None = None,
    ) -> None:
        """Broadcast a message of the agent, in a datagram with `data_bytes` bytes of data.

        If `encoded` is None, the receivers share the object `message`. Otherwise each receiver decodes these bytes.
        """
        self._rank += 1
        channel, kind = self._channel, type(message)
        draws = self._medium.draw(number, now, data_bytes) if channel is None else _UNKNOWN
        flight = MessageInFlight(
            self._roster[number], sequence, message, MATTERS[kind], now, self._rank, draws, datagram, encoded
        )
        answered = None if self._deliver_all else ANSWERED.get(kind)
        if answered is None and kind in ASKED and (self._answer_logs or not self._deliver_all):
            self._open_query(number, ASKED[kind](message, self._settings))
        if channel is not None:
            channel.send(now, number, flight, data_bytes)
            return
        if now + draws.latest > self._quiet_at:
            self._quiet_at = now + draws.latest
        if self._script.listens and self._apply_fates(now, number, flight):
            return
        if answered is None:
            self._schedule_all(flight)
        else:
            self._keep_answer(answered(message), flight, number)

    def _schedule_all(self, flight: MessageInFlight) -> None:
        """Schedule the arrivals of a message at all receivers, except at agents that will certainly ignore it."""
        queue, busy_until, deliver_all = self._queue, self.busy_until, self._deliver_all
        now, rank = flight.sent_at, flight.rank
        for receiver, delay in flight.draws.to_all():
            at = now + delay
            if deliver_all or at >= busy_until[receiver]:
                heappush(queue, (at, rank, receiver, flight))

    # Shared channel

    def move(self, places: Mapping[int, Place], now: float) -> None:
        """Set the positions of the vehicles in the simulated network."""
        if self._channel is not None:
            self._channel.move([places[agent_id] for agent_id in self._roster], now)

    def apply(self, conditions: NetworkConditions, now: float, *, clears_all: bool) -> None:
        """Apply these network conditions to later broadcasts. If `clears_all` is true, also remove the shared channel
        and all messages on it.
        """
        if clears_all and self._channel is not None:
            self._channel, self._medium.latency = None, LATENCY
        self._medium.apply(conditions)
        if self._channel is not None:
            groups = conditions.groups(self._roster)
            self._channel.tune(
                [next(index for index, group in enumerate(groups) if agent_id in group) for agent_id in self._roster],
                now,
            )

    def _deliver_frame(
        self, at: float, transmission: EndedTransmission, message: MessageInFlight | StrayDatagram
    ) -> None:
        """Deliver a message whose transmission on the shared channel ends. The network conditions, such as loss, apply
        to each copy.
        """
        sender, received = transmission.sender, transmission.received
        draws = self._medium.draw(sender, at, transmission.data_bytes)
        if isinstance(message, StrayDatagram):
            for receiver in numbers(received):
                for delay in draws.copies_to(receiver):
                    self.inject(at + delay, message, [receiver])
            return
        message.sent_at = transmission.began_at
        if self._script.listens:
            message.draws = _BroadcastCopies([copy for copy in draws.to_all() if received >> copy[0] & 1])
            if self._apply_fates(at, sender, message):
                return
        if message.rank - self._discarded_at > DISCARD_EVERY:
            self._discard_answers(message)
        for receiver in self._interested_receivers(received, message, at):
            for delay in draws.copies_to(receiver):
                self._schedule_arrival(message, receiver, at + delay)

    def _interested_receivers(self, received: int, flight: MessageInFlight, at: float) -> Iterable[int]:
        """Return the receivers on which the message can have an effect.

        An agent that reconciles ignores queries. The message arrives now, so an answer affects only agents that are
        waiting for answers now. The exceptions are paused agents, which may send a query before they read the answer.
        """
        if self._deliver_all or self._medium.latest > 0:
            return numbers(received)
        answered = ANSWERED.get(type(flight.message))
        if answered is None:
            busy_until = self.busy_until
            return [receiver for receiver in numbers(received) if at >= busy_until[receiver]]
        log = self._answer_logs.get(answered(flight.message))
        asking = log.askers | self.paused_at.keys() if log else self.paused_at.keys()
        return [receiver for receiver in sorted(asking) if received >> receiver & 1]

    # Answers

    def take_answers(self, number: int) -> list[tuple[float, int, MessageInFlight]]:
        """Return the answers that the agent must count now, in order of arrival, each as (mission second, rank,
        answer). These answers have arrived since the agent's query. Of several answers from one sender, only the first
        counts.
        """
        new = []
        now, rank, _, _ = self.position
        for query in self.open_queries[number].values():
            log = query.log
            if query.question[0] not in ONLY_COUNTED or (
                log.answer_count == query.answers_seen and now < query.next_at
            ):
                continue
            query.answers_seen, query.next_at = log.answer_count, NEVER
            for sender, flights in log.answers.items():
                if sender in query.answered_by:
                    continue
                first = self._earliest(flights, number, query.since)
                if first is None:
                    continue
                if first[0] < now or (first[0] == now and first[1] < rank):
                    query.answered_by.add(sender)
                    new.append(first)
                elif first[0] < query.next_at:
                    query.next_at = first[0]
        new.sort()
        return new

    def close_ended_queries(self, number: int, state: AgentState) -> None:
        """Close the open queries to which the agent no longer accepts answers."""
        open_queries = self.open_queries[number]
        for about, query in list(open_queries.items()):
            if not STILL_ASKED[query.question[0]](state):
                del open_queries[about]
                query.log.askers.remove(number)

    def remove_agent(self, number: int) -> None:
        """Remove a killed agent from the network."""
        for query in self.open_queries[number].values():
            query.log.askers.remove(number)
        self.open_queries[number].clear()
        self.paused_at.pop(number, None)
        self.busy_until[number] = 0.0

    def _open_query(self, number: int, question: Question) -> None:
        """Record that an agent waits for the answers to a query. Answers that arrive later count, even if they answer
        an equal query of another agent.
        """
        open_queries = self.open_queries[number]
        about: QueryKind = "vote" if question[0] is BlockAddResponse else "reconcile"
        before = open_queries.get(about)
        if before is not None:
            before.log.askers.remove(number)
        log = self._answer_logs[question]
        log.askers.add(number)
        query = open_queries[about] = _OpenQuery(question, log, self.position)
        if question[0] not in ONLY_COUNTED:
            for flights in log.answers.values():
                self._schedule_earliest(flights, number, query)

    def _keep_answer(self, question: Question, flight: MessageInFlight, sender: int) -> None:
        """Store an answer for all agents that have sent this query or will send it before the answer arrives."""
        log = self._answer_logs[question]
        log.answer_count += 1
        log.quiet_at = self._quiet_at
        flights = log.answers.get(sender)
        if flights is None:
            log.answers[sender] = [flight]
        else:
            flights.append(flight)
        if question[0] not in ONLY_COUNTED:
            for receiver in log.askers:
                self._schedule_earliest((flight,), receiver, self.open_queries[receiver]["reconcile"])
        if flight.rank - self._discarded_at > DISCARD_EVERY:
            self._discard_answers(flight)

    def _schedule_earliest(self, flights: Iterable[MessageInFlight], receiver: int, query: _OpenQuery) -> None:
        """Schedule the earliest of these answers, unless an earlier answer is already scheduled."""
        first = self._earliest(flights, receiver, query.since)
        if first is not None and first[:2] < query.first:
            at, rank, flight = first
            query.first = at, rank
            heappush(self._queue, (at, rank, receiver, flight))

    def _earliest(
        self, flights: Iterable[MessageInFlight], receiver: int, since: ScheduledInput
    ) -> tuple[float, int, MessageInFlight] | None:
        """Return the first of these messages that arrives after `since`, as (mission second, rank, message). Return
        None if no message arrives after `since`.
        """
        since_s, since_rank, _, _ = since
        started_at = self.started_at[receiver]
        soonest, latest = self._medium.soonest, self._medium.latest
        first_at, first = NEVER, None
        for flight in flights:
            sent_at = flight.sent_at
            if sent_at + soonest >= first_at:
                break
            if sent_at + latest < since_s or sent_at < started_at:
                continue
            for delay in flight.draws.copies_to(receiver):
                at = sent_at + delay
                if at < first_at and (at > since_s or (at == since_s and flight.rank > since_rank)):
                    first_at, first = at, flight
        return None if first is None else (first_at, first.rank, first)

    def _discard_answers(self, latest: MessageInFlight) -> None:
        """Discard the answers that have arrived at all receivers and that no open query needs."""
        self._discarded_at = latest.rank
        heard_before = min([latest.sent_at, *self.paused_at.values()])
        self._answer_logs = defaultdict(
            _AnswerLog,
            {
                question: log
                for question, log in self._answer_logs.items()
                if log.askers or log.quiet_at >= heard_before
            },
        )

    # Scripted fates

    def _apply_fates(self, now: float, number: int, flight: MessageInFlight) -> bool:
        """Schedule the arrivals of a message by the scripted delivery rules. Return false if no rule matches."""
        decided = self._script.decide(
            now, flight.sender, flight.message, flight.draws, lambda receiver: self._medium.hears(number, receiver)
        )
        if decided is None:
            return False
        for receiver, at in decided.arrivals:
            self._schedule_arrival(flight, receiver, at)
        for receiver, name in decided.waiting:
            if name in self._arrived_at:
                self._schedule_arrival(flight, receiver, max(now, self._arrived_at[name]) + RIGHT_AFTER_S)
            else:
                self._waiting[name].append((flight, receiver))
        for hold, receiver, at in decided.held:
            self._held[hold].append((flight, receiver, at))
        for name, at in decided.named:
            self._arrived_at[name] = at
            for waiting, receiver in self._waiting.pop(name, ()):
                self._schedule_arrival(waiting, receiver, at + RIGHT_AFTER_S)
        return True

    def release(self, number: int, at: float) -> None:
        """End the hold (a rule that delays messages) with this number. Each held message arrives at the time `at`, or
        at its original arrival time if that is later.
        """
        for flight, receiver, would_arrive in self._held.pop(number, ()):
            self._schedule_arrival(flight, receiver, max(at, would_arrive))

    def _schedule_arrival(self, flight: MessageInFlight, receiver: int, at: float) -> None:
        self._quiet_at = max(self._quiet_at, at)
        heappush(self._queue, (at, flight.rank, receiver, flight))

    def unmatched_fates(self) -> list[str]:
        """Return a sentence for each scripted delivery rule without an effect."""
        return self._script.unmatched(self._waiting)
