"""What is on its way, in virtual time: messages, events, and the ends of timers, in the order in which they come.

Everything is broadcast, so N agents hear N times what each says, and nearly all of it changes nothing (`ucp.interest`).
Unless every handler run is to be traced, the air does not deliver what cannot matter: a question goes to all but those
who will still reconcile when it arrives; an answer only to those who have asked, or will have when it arrives. What
becomes of the agents is the same to the last bit either way: lots are drawn for a broadcast as a whole, and everything
has its place in the order, (time, rank, receiver), whether or not anything else is delivered.

Most answers are only tallied. They are not delivered one by one: the agent is told of those that have come, in order,
before it looks at its tally (`hear`), and nobody works out when an answer reaches whom until then.

If vehicles share a radio channel, every message occupies it, also one that matters to no agent. A message arrives when
its frame ends. Only then is it known which agents receive it and which of them ask for it, so it is delivered to these
agents at once, and no answer is kept.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from heapq import heappop, heappush
from typing import Literal

from harness.play.simulation._shared_channel import ChannelTraffic
from harness.play.simulation.fate_script import RIGHT_AFTER_S, FateScript
from netem.channel import Transmission, numbers
from netem.conditions import NetworkConditions
from netem.medium import LATENCY, Medium, RandomDraws
from netem.radio import Place
from ucp.interest import ANSWERED, ASKED, MATTERS, ONLY_COUNTED, STILL_ASKED, Question
from ucp.messages import BlockAddResponse, Message
from ucp.settings import Settings
from ucp.state import AgentState
from ucp.trace import Recorded

NEVER = float("inf")
SWEEP_EVERY = 1000
"""Broadcasts between two looks for answers that have arrived everywhere."""


@dataclass(slots=True, eq=False)
class InFlight:
    """One broadcast on its way."""

    sender: int
    sequence: int
    message: Message
    matters: Callable[[AgentState, int, Message], bool]
    sent_at: float
    rank: int
    lots: RandomDraws
    datagram: Recorded | None
    """None if no traces found to have it."""
    sealed: bytes | None = None
    """As it is on the air in a secured mission."""

    def __lt__(self, other: object) -> bool:
        return False  # of two copies that arrive at one agent in one instant either is the first


About = Literal["vote", "reconcile"]
"""What an agent's question is about: it can have one of each."""


@dataclass(slots=True, eq=False)
class _Topic:
    """What anybody says to one question, by sender in the order in which it was sent, and the numbers of who asks."""

    answers: dict[int, list[InFlight]] = field(default_factory=dict)
    askers: set[int] = field(default_factory=set)
    answer_count: int = 0
    """How many answers there are."""
    quiet_at: float = 0.0
    """None of the answers arrives later."""


@dataclass(slots=True, eq=False)
class _Asked:
    """What an agent waits to hear, since when, and from whom it has heard it."""

    question: Question
    topic: _Topic
    since: "Happening"
    heard: set[int] = field(default_factory=set)
    heard_of: int = 0
    """How many answers there were when it was last told of them."""
    next_at: float = 0.0
    """When the next of these comes."""
    first: tuple[float, int] = (NEVER, 0)
    """When the first answer of all arrives, and its rank, where no other is wanted."""


Logged = tuple[int, int, bytes, int | None]
"""An event that an agent is about to log: in which of its lives (0: whichever it is), event ID, data, and its time in
microseconds, None for that of the agent's clock."""


@dataclass(frozen=True, slots=True)
class StrayDatagram:
    """A datagram that is no message of the agent at whose address, that of vehicle `source`, it is sent."""

    source: int
    datagram: bytes
    sequence: None = None


class _Copies:
    """The copies of a broadcast that arrive: (receiver, delay in seconds)."""

    def __init__(self, copies: list[tuple[int, float]]) -> None:
        self._copies = copies
        self.latest = max((delay for _, delay in copies), default=0.0)

    def copies_to(self, receiver: int) -> tuple[float, ...]:
        return tuple(delay for number, delay in self._copies if number == receiver)

    def to_all(self) -> list[tuple[int, float]]:
        return self._copies


_UNKNOWN = _Copies([])
"""The copies of a message whose frame has not ended."""

Happening = tuple[float, int, int, InFlight | Logged | StrayDatagram | None]
"""(mission seconds, rank, number of the agent, what): a message, an event, or None for the end of a timer.

The number after the last agent's is the rogue node's.

Of two in the same instant the one with the lower rank comes first."""


class VirtualAir:
    """The air between `roster`, whose agents are numbered in its order. `deliver_all`: even what cannot matter."""

    def __init__(
        self,
        roster: tuple[int, ...],
        settings: Settings,
        medium: Medium,
        script: FateScript,
        channel: ChannelTraffic[InFlight | StrayDatagram] | None,
        *,
        deliver_all: bool,
    ) -> None:
        self.busy_until = [0.0] * len(roster)
        """Until when, at least, the agent with this number reconciles, and so answers nobody."""
        self.born_at = [0.0] * len(roster)
        """When the agent with this number was started; it does not hear what was sent before."""
        self.paused_at: dict[int, float] = {}
        """Since when the agents are paused that are; what has come since waits for them."""
        self.asked_by: list[dict[About, _Asked]] = [{} for _ in roster]
        """What the agent with this number waits to hear."""
        self._quiet_at = 0.0
        """When the last copy arrives that is not on the channel."""
        self.place: Happening = (0.0, 0, 0, None)
        """Where in the order the world stands."""
        self._roster = roster
        self._settings = settings
        self._medium = medium
        self._script = script
        self._channel = channel
        self._deliver_all = deliver_all
        self._coming: list[Happening] = []
        self._rank = 0
        self._topics: dict[Question, _Topic] = defaultdict(_Topic)
        self._swept_at = 0
        self._waiting: dict[str, list[tuple[InFlight, int]]] = defaultdict(list)
        self._named: dict[str, float] = {}
        self._held: dict[int, list[tuple[InFlight, int, float]]] = defaultdict(list)
        """What holds keep back, by their numbers: to whom, and when it would have arrived."""

    def deliver_everything(self) -> None:
        """From now on deliver even what cannot matter."""
        self._deliver_all = True

    @property
    def quiet_at(self) -> float:
        """Nothing that was broadcast so far arrives later. On a channel, this is when its next event takes place."""
        channel = self._channel
        return self._quiet_at if channel is None or channel.next_s == NEVER else max(self._quiet_at, channel.next_s)

    def until(self, mission_s: float) -> Iterator[Happening]:
        """What comes up to and at `mission_s`, in order, with whatever comes of it meanwhile."""
        coming = self._coming
        while True:
            channel = self._channel
            while (
                channel is not None and channel.next_s <= mission_s and not (coming and coming[0][0] <= channel.next_s)
            ):
                at = channel.next_s
                for transmission, message in channel.advance():
                    self._end(at, transmission, message)
            if not coming or coming[0][0] > mission_s:
                break
            happening = heappop(coming)
            self.place = happening
            yield happening
        self._rank += 1
        self.place = (mission_s, self._rank, 0, None)

    def expect(self, at: float, number: int, what: Logged | None) -> None:
        """The agent's timer ends, or it logs an event, at `at`."""
        self._rank += 1
        heappush(self._coming, (at, self._rank, number, what))

    def order_of_timers(self, ends: Mapping[int, float]) -> list[int]:
        """Numbers of the agents whose next timer ends when `ends` says, in the order in which that happens."""
        coming = sorted(happening[:3] for happening in self._coming if happening[3] is None)
        return list(dict.fromkeys(number for at, _, number in coming if ends.get(number) == at))

    def inject(self, at: float, stray: StrayDatagram, numbers: Iterable[int]) -> None:
        """`stray` reaches the agents with these numbers at `at`."""
        self._rank += 1
        self._quiet_at = max(self._quiet_at, at)
        for number in numbers:
            heappush(self._coming, (at, self._rank, number, stray))

    def broadcast_stray(self, now: float, number: int, datagram: bytes) -> None:
        """The agent with this number sends what is no message of its own. No fate is about it."""
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
        datagram: Recorded | None = None,
        sealed: bytes | None = None,
    ) -> None:
        """The agent with this number sends `message`, in a datagram with so many bytes of data."""
        self._rank += 1
        channel, kind = self._channel, type(message)
        lots = self._medium.draw(number, now, data_bytes) if channel is None else _UNKNOWN
        flight = InFlight(
            self._roster[number], sequence, message, MATTERS[kind], now, self._rank, lots, datagram, sealed
        )
        answered = None if self._deliver_all else ANSWERED.get(kind)
        if answered is None and kind in ASKED and (self._topics or not self._deliver_all):
            self._ask(number, ASKED[kind](message, self._settings))
        if channel is not None:
            channel.send(now, number, flight, data_bytes)
            return
        if now + lots.latest > self._quiet_at:
            self._quiet_at = now + lots.latest
        if self._script.listens and self._scripted(now, number, flight):
            return
        if answered is None:
            self._deliver(flight)
        else:
            self._answer(answered(message), flight, number)

    def _deliver(self, flight: InFlight) -> None:
        """Let it arrive at everybody but those who will certainly not answer."""
        coming, busy_until, deliver_all = self._coming, self.busy_until, self._deliver_all
        now, rank = flight.sent_at, flight.rank
        for receiver, delay in flight.lots.to_all():
            at = now + delay
            if deliver_all or at >= busy_until[receiver]:
                heappush(coming, (at, rank, receiver, flight))

    # The channel, if there is one

    def move(self, places: Mapping[int, Place], now: float) -> None:
        """Put the vehicles at these places."""
        if self._channel is not None:
            self._channel.move([places[agent_id] for agent_id in self._roster], now)

    def apply(self, conditions: NetworkConditions, now: float, *, clears_all: bool) -> None:
        """Apply these conditions to later broadcasts. `clears_all` also ends the channel, with all its messages."""
        if clears_all and self._channel is not None:
            self._channel, self._medium.latency = None, LATENCY
        self._medium.apply(conditions)
        if self._channel is not None:
            groups = conditions.groups(self._roster)
            self._channel.tune(
                [next(index for index, group in enumerate(groups) if agent_id in group) for agent_id in self._roster],
                now,
            )

    def _end(self, at: float, transmission: Transmission, message: InFlight | StrayDatagram) -> None:
        """Deliver a message whose frame ends. The conditions of the network apply to each copy that arrives."""
        sender, received = transmission.sender, transmission.received
        lots = self._medium.draw(sender, at, transmission.data_bytes)
        if isinstance(message, StrayDatagram):
            for receiver in numbers(received):
                for delay in lots.copies_to(receiver):
                    self.inject(at + delay, message, [receiver])
            return
        message.sent_at = transmission.began_at
        if self._script.listens:
            message.lots = _Copies([copy for copy in lots.to_all() if received >> copy[0] & 1])
            if self._scripted(at, sender, message):
                return
        if message.rank - self._swept_at > SWEEP_EVERY:
            self._sweep(message)
        for receiver in self._concerned(received, message, at):
            for delay in lots.copies_to(receiver):
                self._arrive(message, receiver, at + delay)

    def _concerned(self, received: int, flight: InFlight, at: float) -> Iterable[int]:
        """Return the receivers to which the message can matter.

        An agent that reconciles ignores questions. An answer that arrives at once matters only to the agents that ask
        now. A paused agent may ask before it reads the answer.
        """
        if self._deliver_all or self._medium.latest > 0:
            return numbers(received)
        answered = ANSWERED.get(type(flight.message))
        if answered is None:
            busy_until = self.busy_until
            return [receiver for receiver in numbers(received) if at >= busy_until[receiver]]
        topic = self._topics.get(answered(flight.message))
        asking = topic.askers | self.paused_at.keys() if topic else self.paused_at.keys()
        return [receiver for receiver in sorted(asking) if received >> receiver & 1]

    # Answers, to whom they matter

    def hear(self, number: int) -> list[tuple[float, int, InFlight]]:
        """(mission seconds, rank, answer) of the answers that the agent tallies and has not been told of, in order.

        Those that have come since it asked: of each agent the first.
        """
        heard = []
        now, rank, _, _ = self.place
        for asked in self.asked_by[number].values():
            topic = asked.topic
            if asked.question[0] not in ONLY_COUNTED or (topic.answer_count == asked.heard_of and now < asked.next_at):
                continue
            asked.heard_of, asked.next_at = topic.answer_count, NEVER
            for sender, flights in topic.answers.items():
                if sender in asked.heard:
                    continue
                first = self._first(flights, number, asked.since)
                if first is None:
                    continue
                if first[0] < now or (first[0] == now and first[1] < rank):
                    asked.heard.add(sender)
                    heard.append(first)
                elif first[0] < asked.next_at:
                    asked.next_at = first[0]
        heard.sort()
        return heard

    def no_longer_asked(self, number: int, state: AgentState) -> None:
        """A timer of the agent has ended, and with it a question."""
        asked_by = self.asked_by[number]
        for about, asked in list(asked_by.items()):
            if not STILL_ASKED[asked.question[0]](state):
                del asked_by[about]
                asked.topic.askers.remove(number)

    def is_gone(self, number: int) -> None:
        """The agent has been killed."""
        for asked in self.asked_by[number].values():
            asked.topic.askers.remove(number)
        self.asked_by[number].clear()
        self.paused_at.pop(number, None)
        self.busy_until[number] = 0.0

    def _ask(self, number: int, question: Question) -> None:
        """From now on the agent waits for answers: also for those to others that have not arrived yet."""
        asked_by = self.asked_by[number]
        about: About = "vote" if question[0] is BlockAddResponse else "reconcile"
        before = asked_by.get(about)
        if before is not None:
            before.topic.askers.remove(number)
        topic = self._topics[question]
        topic.askers.add(number)
        asked = asked_by[about] = _Asked(question, topic, self.place)
        if question[0] not in ONLY_COUNTED:
            for flights in topic.answers.values():
                self._arrive_first(flights, number, asked)

    def _answer(self, question: Question, flight: InFlight, sender: int) -> None:
        """Keep an answer for those who ask, or will before it arrives."""
        topic = self._topics[question]
        topic.answer_count += 1
        topic.quiet_at = self._quiet_at
        flights = topic.answers.get(sender)
        if flights is None:
            topic.answers[sender] = [flight]
        else:
            flights.append(flight)
        if question[0] not in ONLY_COUNTED:
            for receiver in topic.askers:
                self._arrive_first((flight,), receiver, self.asked_by[receiver]["reconcile"])
        if flight.rank - self._swept_at > SWEEP_EVERY:
            self._sweep(flight)

    def _arrive_first(self, flights: Iterable[InFlight], receiver: int, asked: _Asked) -> None:
        """Let that answer arrive that comes first, unless another comes before it."""
        first = self._first(flights, receiver, asked.since)
        if first is not None and first[:2] < asked.first:
            at, rank, flight = first
            asked.first = at, rank
            heappush(self._coming, (at, rank, receiver, flight))

    def _first(
        self, flights: Iterable[InFlight], receiver: int, since: Happening
    ) -> tuple[float, int, InFlight] | None:
        """(mission seconds, rank, flight) of the flight that arrives first after `since`."""
        since_s, since_rank, _, _ = since
        born_at = self.born_at[receiver]
        soonest, latest = self._medium.soonest, self._medium.latest
        first_at, first = NEVER, None
        for flight in flights:
            sent_at = flight.sent_at
            if sent_at + soonest >= first_at:
                break
            if sent_at + latest < since_s or sent_at < born_at:
                continue
            for delay in flight.lots.copies_to(receiver):
                at = sent_at + delay
                if at < first_at and (at > since_s or (at == since_s and flight.rank > since_rank)):
                    first_at, first = at, flight
        return None if first is None else (first_at, first.rank, first)

    def _sweep(self, latest: InFlight) -> None:
        """Forget the answers that have arrived everywhere and that nobody waits for."""
        self._swept_at = latest.rank
        heard_before = min([latest.sent_at, *self.paused_at.values()])
        self._topics = defaultdict(
            _Topic,
            {
                question: topic
                for question, topic in self._topics.items()
                if topic.askers or topic.quiet_at >= heard_before
            },
        )

    # Scripted fates

    def _scripted(self, now: float, number: int, flight: InFlight) -> bool:
        """Send `flight` as the script says, to everybody; False if the script says nothing of it."""
        decided = self._script.decide(
            now, flight.sender, flight.message, flight.lots, lambda receiver: self._medium.hears(number, receiver)
        )
        if decided is None:
            return False
        for receiver, at in decided.arrivals:
            self._arrive(flight, receiver, at)
        for receiver, name in decided.waiting:
            if name in self._named:
                self._arrive(flight, receiver, max(now, self._named[name]) + RIGHT_AFTER_S)
            else:
                self._waiting[name].append((flight, receiver))
        for hold, receiver, at in decided.held:
            self._held[hold].append((flight, receiver, at))
        for name, at in decided.named:
            self._named[name] = at
            for waiting, receiver in self._waiting.pop(name, ()):
                self._arrive(waiting, receiver, at + RIGHT_AFTER_S)
        return True

    def release(self, number: int, at: float) -> None:
        """What the hold with this number has kept back arrives at `at`, or when it would have."""
        for flight, receiver, would_arrive in self._held.pop(number, ()):
            self._arrive(flight, receiver, max(at, would_arrive))

    def _arrive(self, flight: InFlight, receiver: int, at: float) -> None:
        self._quiet_at = max(self._quiet_at, at)
        heappush(self._coming, (at, flight.rank, receiver, flight))

    def unmatched_fates(self) -> list[str]:
        """A sentence for each scripted fate that came to nothing."""
        return self._script.unmatched(self._waiting)
