"""When everything happens, on one time for all: every input of every agent that is played.

Each agent's inputs keep their order, a message arrives after it was sent, and a timer ends no sooner than its duration
after it was started. Every input happens as soon as these allow, and not before its agent's clock says. So chains come
out as they did even where clocks are known badly, or were set back or forward on the way: only times are stretched.

What was received and is not known to have been sent by an agent that is played is a stray: it is put on the air as it
is. So is what was received, by the records, before it was sent, which no order of things explains.
"""

import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from heapq import heappop, heappush

from harness.field.reconstruct._agent_inputs import Booted, Heard
from harness.field.reconstruct._clock_offsets import FASTEST, SLOWEST, Delivery, Line, estimate
from harness.field.reconstruct._rehearsal import Played, Rehearsal, Started

APART_S = 2e-5
"""Two inputs of an agent, and a message's leaving and its arrival, are at least so far apart."""
DIGITS = 6
MILLION = 10.0**DIGITS
LONG_BEFORE_S = 86400.0
"""Nobody waits so long for a mission's first event: its clocks count from something else."""
WITHIN_S = 1.0
"""Of two equal datagrams one is meant that was sent no later than that after it was received, for clocks differ."""


@dataclass(slots=True)
class Happening:
    """An input of an agent at mission second `at_s`; `number` is that of the sender's datagram, None for a stray.

    `late_s` is by how much a timer ended late.
    """

    played: Played
    at_s: float
    late_s: float = 0.0
    sender: int | None = None
    number: int | None = None


@dataclass
class Life:
    """Mission seconds of the first and last input, and whether the agent went on from its disk; numbers are from 0.

    By `there_s` it was there: the first message that it heard was sent then, or something else came.
    """

    number: int
    there_s: float
    began_s: float
    ended_s: float
    boots: bool


@dataclass
class Timetable:
    """`clocks` are beside mission time. `impossible` names what no order of things explains."""

    clocks: dict[int, Line]
    happenings: dict[int, list[Happening]] = field(default_factory=dict)
    sent: dict[int, list[bytes]] = field(default_factory=dict)
    """Every datagram that each agent sends, in order."""
    sent_at_s: dict[int, list[float]] = field(default_factory=dict)
    lateness: dict[int, dict[int, float]] = field(default_factory=dict)
    """By how much timers end late, by their numbers."""
    impossible: list[str] = field(default_factory=list)

    def lives(self, agent_id: int) -> list[Life]:
        lives: list[Life] = []
        number = -1
        for happening in self.happenings[agent_id]:
            if happening.played.life != number:
                number = happening.played.life
                boots = isinstance(happening.played.input.what, Booted)
                lives.append(Life(number, happening.at_s, happening.at_s, happening.at_s, boots))
            lives[-1].ended_s = happening.at_s
            if happening.sender is not None and happening.number is not None:
                lives[-1].there_s = min(lives[-1].there_s, self.sent_at_s[happening.sender][happening.number])
        return lives


def timetable(rehearsals: Mapping[int, Rehearsal]) -> Timetable:
    """Of what was rehearsed."""
    senders = _Senders(rehearsals)
    clocks = estimate(rehearsals, senders.deliveries())
    clocks = _from_zero(clocks, rehearsals)
    return _Planner(rehearsals, senders, clocks).plan()


def _from_zero(clocks: Mapping[int, Line], rehearsals: Mapping[int, Rehearsal]) -> dict[int, Line]:
    """Mission second 0 is when the first clock shows 0; if the first input comes sooner, or much later, it is then."""
    played = {agent: rehearsal.played[0] for agent, rehearsal in rehearsals.items() if rehearsal.played}
    first = min((clocks[agent].at(of_agent.input.at_s) for agent, of_agent in played.items()), default=0.0)
    zero = min(line.at(0.0) for line in clocks.values())
    start = zero if APART_S < first - zero < LONG_BEFORE_S else first - APART_S
    begin = Line(start)
    rounded = {}
    for agent, line in clocks.items():
        line = line.after(begin) if SLOWEST <= line.rate <= FASTEST else Line().after(begin)
        rounded[agent] = Line(round(line.offset_s, DIGITS), 1 + round(line.rate - 1, 9))
    return rounded


class _Senders:
    """Who has sent what, of those that are played, and which of their datagrams somebody has heard."""

    def __init__(self, rehearsals: Mapping[int, Rehearsal]) -> None:
        self._rehearsals = rehearsals
        self.sent: dict[int, list[bytes]] = {agent: [] for agent in rehearsals}
        self._sent_by: dict[int, list[int]] = {agent: [] for agent in rehearsals}
        """Of each datagram the place of the input that it came of."""
        self._numbers: dict[bytes, list[tuple[int, int]]] = defaultdict(list)
        for agent, rehearsal in rehearsals.items():
            for place, played in enumerate(rehearsal.played):
                for datagram in played.sent:
                    self._numbers[datagram].append((agent, len(self.sent[agent])))
                    self.sent[agent].append(datagram)
                    self._sent_by[agent].append(place)

    def of(self, datagram: bytes, receiver: int) -> list[tuple[int, int]]:
        """(agent, number) of each time that it was sent by another."""
        return [sent for sent in self._numbers.get(datagram, ()) if sent[0] != receiver]

    def left_s(self, agent: int, number: int) -> float:
        """When, by the sender's clock."""
        return self._rehearsals[agent].played[self._sent_by[agent][number]].input.at_s

    def deliveries(self) -> list[Delivery]:
        """What was sent once, and received."""
        found = []
        for receiver, rehearsal in self._rehearsals.items():
            for played in rehearsal.played:
                if isinstance(played.input.what, Heard):
                    sent = self.of(played.input.what.datagram, receiver)
                    if len(sent) == 1:
                        sender, number = sent[0]
                        found.append(Delivery(sender, receiver, self.left_s(sender, number), played.input.at_s))
        return found


class _Planner:
    def __init__(self, rehearsals: Mapping[int, Rehearsal], senders: _Senders, clocks: dict[int, Line]) -> None:
        self._rehearsals = rehearsals
        self._senders = senders
        self._table = Timetable(clocks, sent=senders.sent)
        for agent in rehearsals:
            self._table.happenings[agent], self._table.sent_at_s[agent], self._table.lateness[agent] = [], [], {}
        self._played = {agent: rehearsal.played for agent, rehearsal in rehearsals.items()}
        self._next = dict.fromkeys(rehearsals, 0)
        self._at: dict[int, list[float]] = {agent: [0.0] * len(played) for agent, played in self._played.items()}
        """What each agent's own clock shows at its inputs, by place, once they are planned."""
        self._ready: list[tuple[float, int]] = []
        self._waiting: dict[tuple[int, int], list[int]] = defaultdict(list)
        self._as_stray: set[tuple[int, int]] = set()

    def plan(self) -> Timetable:
        for agent in self._played:
            self._queue(agent)
        while True:
            while self._ready:
                _, agent = heappop(self._ready)
                self._happen(agent)
            if not self._waiting:
                break
            self._break_circle()
        for agent, rehearsal in self._rehearsals.items():
            for life in self._table.lives(agent):
                for timer in rehearsal.pending[life.number]:
                    self._let_run(agent, timer, life.ended_s + APART_S)
        return self._table

    def _queue(self, agent: int) -> None:
        """The next input of the agent that matters is ready, or waits for a message to be sent."""
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
            heappush(self._ready, (self._told_s(agent, place), agent))

    def _told_s(self, agent: int, place: int) -> float:
        return self._table.clocks[agent].at(self._played[agent][place].input.at_s)

    def _sent(self, agent: int, place: int) -> tuple[int, int] | None:
        """(sender, number) of the datagram that arrives; None for other inputs, and for strays."""
        what = self._played[agent][place].input.what
        if not isinstance(what, Heard) or (agent, place) in self._as_stray:
            return None
        candidates = self._senders.of(what.datagram, agent)
        if len(candidates) < 2:
            return candidates[0] if candidates else None
        by = self._told_s(agent, place) + WITHIN_S
        before = [sent for sent in candidates if self._table.clocks[sent[0]].at(self._senders.left_s(*sent)) <= by]
        return before[-1] if before else candidates[0]

    def _break_circle(self) -> None:
        """Everybody waits for what is sent later: what should come first is taken for a stray."""
        waiting = [
            (self._told_s(agent, self._next[agent]), agent, sent)
            for sent, agents in self._waiting.items()
            for agent in agents
        ]
        at_s, agent, sent = min(waiting)
        place = self._next[agent]
        self._waiting[sent].remove(agent)
        if not self._waiting[sent]:
            del self._waiting[sent]
        self._as_stray.add((agent, place))
        line = self._played[agent][place].input.line
        self._table.impossible.append(
            f"agent {agent} recorded a message before agent {sent[0]} sent it (trace line {line}, "
            f"t={self._played[agent][place].input.at_s:g} s): the scenario sends it at the recorded time"
        )
        heappush(self._ready, (at_s, agent))

    def _happen(self, agent: int) -> None:
        place = self._next[agent]
        played = self._played[agent][place]
        happenings, clock = self._table.happenings[agent], self._table.clocks[agent]
        sent = self._sent(agent, place)
        soonest = self._told_s(agent, place)
        if happenings:
            before = happenings[-1]
            gap = APART_S if before.played.life == played.life else 10 * APART_S
            soonest = max(soonest, before.at_s + gap)
        if sent is not None:
            soonest = max(soonest, self._table.sent_at_s[sent[0]][sent[1]] + APART_S)
        happening = Happening(played, _rounded_up(max(soonest, APART_S)))
        if sent is not None:
            happening.sender, happening.number = sent
        local = clock.shows(happening.at_s)
        if played.ends is not None:
            ends_local, ends_s = self._ends(agent, played.ends)
            late_s = _rounded_up(soonest - ends_s) if soonest > ends_s else 0.0
            happening.at_s = ends_s + late_s
            local = max(ends_local, clock.shows(happening.at_s))
            self._be_late(agent, played.ends, late_s)
            happening.late_s = late_s
        for stopped in played.stops:
            self._let_run(agent, stopped, happening.at_s)
        self._at[agent][place] = local
        happenings.append(happening)
        for _ in played.sent:
            number = len(self._table.sent_at_s[agent])
            self._table.sent_at_s[agent].append(happening.at_s)
            for receiver in self._waiting.pop((agent, number), ()):
                heappush(self._ready, (self._told_s(receiver, self._next[receiver]), receiver))
        self._next[agent] += 1
        self._queue(agent)

    def _ends(self, agent: int, timer: Started) -> tuple[float, float]:
        """When the timer ends if it is not late, by the agent's clock and in mission seconds."""
        ends_local = self._at[agent][timer.place] + timer.duration_s
        return ends_local, self._table.clocks[agent].at(ends_local)

    def _let_run(self, agent: int, timer: Started, until_s: float) -> None:
        """The timer does not end up to then."""
        _, ends_s = self._ends(agent, timer)
        if ends_s < until_s + APART_S:
            self._be_late(agent, timer, _rounded_up(until_s + 2 * APART_S - ends_s))

    def _be_late(self, agent: int, timer: Started, by_s: float) -> None:
        if by_s > 0:
            self._table.lateness[agent][timer.number] = by_s


def _rounded_up(seconds: float) -> float:
    return math.ceil(round(seconds * MILLION, 3)) / MILLION
