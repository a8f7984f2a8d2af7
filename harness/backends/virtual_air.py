"""What is on its way, in virtual time: messages, events, and the ends of timers, in the order in which they come.

Everything is broadcast, so N agents hear N times what each says, and nearly all of it changes nothing (`ucp.interest`).
Unless every handler run is to be traced, the air does not deliver what cannot matter: a question goes to all but those
who will still reconcile when it arrives; an answer only to those who have asked, or will have when it arrives. What
becomes of the agents is the same to the last bit either way: lots are drawn for a broadcast as a whole, and everything
has its place in the order, (time, rank, receiver), whether or not anything else is delivered.
"""

from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from heapq import heappop, heappush

from harness.backends.fate_script import RIGHT_AFTER_S, FateScript
from netem.medium import Lots, Medium
from ucp.agent import Agent
from ucp.interest import ANSWERED, ASKED, MATTERS, ONLY_COUNTED, Question
from ucp.messages import BlockAddResponse, Message

LAST_RANK = 1 << 62
NEVER = float("inf")
SWEEP_EVERY = 1000
"""Broadcasts between two looks for answers that have arrived everywhere."""
ANYBODY = 0
"""No agent's ID: of the blocks that were asked for only the first is wanted, whoever sends it."""


@dataclass(slots=True, eq=False)
class Flight:
    """One broadcast on its way."""

    sender: int
    sequence: int
    message: Message
    matters: Callable[[Agent, int, Message], bool]
    sent_at: float
    rank: int
    lots: Lots

    def __lt__(self, other: object) -> bool:
        return False  # of two copies that arrive at one agent in one instant either is the first


@dataclass(slots=True)
class _Asked:
    """What an agent waits to hear, and when the first answer of each other agent arrives that is known to arrive."""

    question: Question
    first: dict[int, float] = field(default_factory=dict)


Logged = tuple[int, bytes]
"""Event ID and data of an event that an agent is about to log."""

Happening = tuple[float, int, int, Flight | Logged | None]
"""(mission seconds, rank, number of the agent, what): a message, an event, or None for the end of a timer.

Of two in the same instant the one with the lower rank comes first."""


def _counted_as(question: Question, flight: Flight) -> int:
    """Whose answer it is, of whom only the first counts."""
    return flight.sender if question[0] in ONLY_COUNTED else ANYBODY


class VirtualAir:
    """The air between `roster`, whose agents are numbered in its order. `deliver_all`: even what cannot matter."""

    def __init__(self, roster: tuple[int, ...], medium: Medium, script: FateScript, *, deliver_all: bool) -> None:
        self.busy_until = [0.0] * len(roster)
        """Until when, at least, the agent with this number reconciles, and so answers nobody."""
        self.quiet_at = 0.0
        """Nothing that was broadcast so far arrives later."""
        self._roster = roster
        self._medium = medium
        self._script = script
        self._deliver_all = deliver_all
        self._coming: list[Happening] = []
        self._rank = 0
        self._current: Happening = (0.0, LAST_RANK, 0, None)
        self._asking: dict[Question, dict[int, _Asked]] = defaultdict(dict)
        self._asked_by: list[dict[bool, _Asked]] = [{} for _ in roster]
        self._answers: dict[Question, list[Flight]] = defaultdict(list)
        self._swept_at = 0
        self._waiting: dict[str, list[tuple[Flight, int]]] = defaultdict(list)
        self._named: dict[str, float] = {}

    def until(self, mission_s: float) -> Iterator[Happening]:
        """What comes up to and at `mission_s`, in order, with whatever comes of it meanwhile."""
        coming = self._coming
        while coming and coming[0][0] <= mission_s:
            self._current = happening = heappop(coming)
            yield happening
        self._current = (mission_s, LAST_RANK, 0, None)

    def expect(self, at: float, number: int, what: Logged | None) -> None:
        """The agent's timer ends, or it logs an event, at `at`."""
        self._rank += 1
        heappush(self._coming, (at, self._rank, number, what))

    def broadcast(self, now: float, number: int, sequence: int, message: Message) -> None:
        """The agent with this number sends `message`."""
        self._rank += 1
        lots = self._medium.draw(number)
        kind = type(message)
        flight = Flight(self._roster[number], sequence, message, MATTERS[kind], now, self._rank, lots)
        if kind in ASKED:
            self._ask(number, ASKED[kind](message))
        if self._script.listens and self._scripted(now, number, flight):
            return
        if now + lots.latest > self.quiet_at:
            self.quiet_at = now + lots.latest
        if self._deliver_all or kind not in ANSWERED:
            self._deliver(flight)
        else:
            self._answer(ANSWERED[kind](message), flight)

    def _deliver(self, flight: Flight) -> None:
        """Let it arrive at everybody but those who will certainly not answer."""
        coming, busy_until, deliver_all = self._coming, self.busy_until, self._deliver_all
        now, rank = flight.sent_at, flight.rank
        for receiver, delay in flight.lots.to_all():
            at = now + delay
            if deliver_all or at >= busy_until[receiver]:
                heappush(coming, (at, rank, receiver, flight))

    # Answers, to whom they matter

    def _ask(self, number: int, question: Question) -> None:
        """From now on the agent waits for answers: also for those to others that have not arrived yet."""
        asked_by = self._asked_by[number]
        of_vote = question[0] is BlockAddResponse
        before = asked_by.get(of_vote)
        if before is not None:
            others = self._asking[before.question]
            del others[number]
            if not others:
                del self._asking[before.question]
        waiting = asked_by[of_vote] = _Asked(question)
        self._asking[question][number] = waiting
        for flight in self._answers.get(question, ()):
            for delay in flight.lots.copies_to(number):
                self._answer_to(number, waiting, flight, _counted_as(question, flight), delay)

    def _answer(self, question: Question, flight: Flight) -> None:
        """Let an answer arrive at whom it can matter: those who ask, if it is the first of its sender to arrive."""
        sender = _counted_as(question, flight)
        for receiver, waiting in self._asking.get(question, {}).items():
            if waiting.first.get(sender, NEVER) > flight.sent_at:
                delay = flight.lots.first_to(receiver)
                if delay is not None:
                    self._answer_to(receiver, waiting, flight, sender, delay)
        self._remember(question, flight)

    def _answer_to(self, receiver: int, waiting: "_Asked", flight: Flight, sender: int, delay: float) -> None:
        at = flight.sent_at + delay
        if at < waiting.first.get(sender, NEVER) and (at, flight.rank, receiver) > self._current[:3]:
            waiting.first[sender] = at
            heappush(self._coming, (at, flight.rank, receiver, flight))

    def _remember(self, answer: Question, flight: Flight) -> None:
        """Keep an answer for those who ask before it arrives."""
        self._answers[answer].append(flight)
        if flight.rank - self._swept_at > SWEEP_EVERY:
            self._swept_at = flight.rank
            on_their_way = {
                question: [one for one in flights if one.sent_at + one.lots.latest >= flight.sent_at]
                for question, flights in self._answers.items()
            }
            self._answers = defaultdict(list, {question: left for question, left in on_their_way.items() if left})

    # Scripted fates

    def _scripted(self, now: float, number: int, flight: Flight) -> bool:
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
        for name, at in decided.named:
            self._named[name] = at
            for waiting, receiver in self._waiting.pop(name, ()):
                self._arrive(waiting, receiver, at + RIGHT_AFTER_S)
        return True

    def _arrive(self, flight: Flight, receiver: int, at: float) -> None:
        self.quiet_at = max(self.quiet_at, at)
        heappush(self._coming, (at, flight.rank, receiver, flight))

    def unmatched_fates(self) -> list[str]:
        """A sentence for each scripted fate that came to nothing."""
        return self._script.unmatched(self._waiting)
