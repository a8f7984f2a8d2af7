"""What reached an agent that left no trace in full, inferred: from its capture, and the events in its blocks.

The capture says what came and what was sent, and when. What was logged is in the blocks. When timers ended is not on
record: as a rule when they should, but a program is late now and then, and then another input may have come first. So
the reference core is given everything in the order of time, and has to send what the capture saw leave; where it does
not, what came while a timer was late is tried before the timer, the last such choice first. A reconcile that begins
without anything that led to it is the operator's.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

from harness.checker.steps.trace_header import CheckedHeader
from harness.field.reconstruct._agent_inputs import Asked, Booted, Heard, Input, Logged, TimerEnded, What
from harness.field.reconstruct._other_records import Captured, Seen, seconds_of
from harness.play.simulation.air import NEVER
from ucp.agent import Agent
from ucp.events import LoggableEvent
from ucp.messages import (
    BlockAddRequest,
    ChainContainQuery,
    ChainHashSuccessorQuery,
    CommitBlock,
    RequestForBlock,
    decode,
    encode,
)
from ucp.store import StoredState
from ucp.trace import HandlerRun

MAX_TRIES = 400
MAX_GIVEN = 200_000
"""Inputs that are given in all tries: some seconds."""
LATE_WALL_S = 0.1
"""A timer that is later than that was not only late."""
UNREAD_WALL_S = 0.005
"""So long a datagram may wait in a socket."""
ROUNDING_S = 1e-3
Still = tuple[float, float]
"""From when to when."""
MAX_STILLS = 10
JUST_AFTER_S = 1e-6
MAX_BIRTHS = 50
TRIES_AT_BIRTH = 5
ANSWERED = (BlockAddRequest, ChainContainQuery, ChainHashSuccessorQuery)
"""What an agent answers, unless it reconciles."""
SENT_AS_TIMERS_END = (BlockAddRequest, CommitBlock, ChainContainQuery, ChainHashSuccessorQuery, RequestForBlock)
"""Mostly: a query may also come of what another agent has sent."""


@dataclass
class Inferred:
    """The inputs of each life as far as they explain what was sent; `problem` says what they do not explain, if any."""

    lives: list[list[Input]] = field(default_factory=list)
    problem: str | None = None

    @property
    def explained(self) -> int:
        """How many inputs there are."""
        return sum(map(len, self.lives))


@dataclass(frozen=True)
class _Span:
    """What is on record of one life: what came, what it sent, and what it logged when."""

    came: Sequence[Seen]
    left: Sequence[Seen]
    logged: Sequence[tuple[float, LoggableEvent]]
    is_last: bool

    def since(self, at_s: float) -> "_Span":
        """Of a life that began then."""
        came = [seen for seen in self.came if seen.at_s >= at_s]
        logged = [timed for timed in self.logged if timed[0] >= at_s]
        return _Span(came, self.left, logged, self.is_last)


def infer(
    header: CheckedHeader, captured: Captured, events: Sequence[LoggableEvent], tries: int = MAX_TRIES
) -> Inferred:
    """What reached the agent. `header` is what it was told."""
    late_s = LATE_WALL_S * captured.speedup + ROUNDING_S
    inferred = Inferred()
    stored: StoredState | None = None
    for span in _spans(captured, events):
        if stored is None:
            attempt = _best(header, span, late_s, None, tries)
        else:
            attempt = _born_again(header, span, late_s, stored, tries)
        inferred.lives.append(attempt.inputs)
        if attempt.problem is not None:
            inferred.problem = attempt.problem
            break
        stored = attempt.left_on_disk()
    return inferred


def _spans(captured: Captured, events: Sequence[LoggableEvent]) -> Iterator[_Span]:
    """The lives: an agent that starts anew counts its datagrams from 0 again."""
    came = [seen for seen in captured.seen if not seen.leaving and seen.at_s >= 0]
    left = [seen for seen in captured.seen if seen.leaving]
    logged = [(seconds_of(event, captured), event) for event in events]
    firsts = [0, *(n for n in range(1, len(left)) if left[n].sequence <= left[n - 1].sequence), len(left)]
    from_s = 0.0
    for number, (first, end) in enumerate(pairwise(firsts)):
        is_last = number == len(firsts) - 2
        until_s = NEVER if is_last else _last_seen(came, left[end - 1].at_s, left[end].at_s)
        within = [seen for seen in came if from_s <= seen.at_s < until_s]
        yield _Span(within, left[first:end], [timed for timed in logged if from_s <= timed[0] < until_s], is_last)
        from_s = left[end - 1].at_s if end else 0.0  # it may have been born at any time since


def _last_seen(came: Sequence[Seen], last_s: float, again_s: float) -> float:
    """Until when it certainly was there: it would have answered the next question."""
    later = (seen for seen in came if last_s < seen.at_s)
    questions = (seen.at_s for seen in later if isinstance(decode(seen.datagram).message, ANSWERED))
    return min(next(questions, again_s), again_s)


def _born_again(header: CheckedHeader, span: _Span, late_s: float, stored: StoredState, tries: int) -> "_Attempt":
    """A life that began some time before its first message; with what was on disk, or with nothing."""
    first_s = span.left[0].at_s if span.left else NEVER
    given = sorted({first_s, *(seen.at_s for seen in span.came), *(at_s for at_s, _ in span.logged)})
    births = [at_s for at_s in given if at_s <= first_s][-MAX_BIRTHS:][::-1]
    best: _Attempt | None = None
    for birth_s in births:
        for disk in (None, stored):
            attempt = _best(header, span.since(birth_s), late_s, disk, min(tries, TRIES_AT_BIRTH), birth_s)
            if attempt.problem is None:
                return attempt
            if best is None or len(attempt.inputs) > len(best.inputs):
                best = attempt
    assert best is not None, "there is a time of birth"
    return best


def _best(
    header: CheckedHeader,
    span: _Span,
    late_s: float,
    stored: StoredState | None,
    tries: int,
    birth_s: float = 0.0,
) -> "_Attempt":
    """The order of things that explains the most."""
    deferred: dict[int, int] = {}
    stills: list[Still] = []
    best: _Attempt | None = None
    given = 0
    for _ in range(tries):
        attempt = _Attempt(header, span, late_s, deferred, stored, birth_s, stills)
        attempt.run()
        if attempt.stood_still is not None and len(stills) < MAX_STILLS:
            stills.append(attempt.stood_still)
            continue
        if best is None or attempt.problem is None or len(attempt.inputs) > len(best.inputs):
            best = attempt
        given += len(attempt.inputs)
        if attempt.problem is None or given > MAX_GIVEN or not _try_another(deferred, attempt.choices):
            break
    assert best is not None, "something was tried"
    return best


def _try_another(deferred: dict[int, int], choices: Sequence[int]) -> bool:
    """Let the last timer end elsewhere of which not all has been tried; False if there is none left."""
    for place in range(len(choices) - 1, -1, -1):
        if deferred.get(place, 0) < choices[place]:
            deferred[place] = deferred.get(place, 0) + 1
            for later in [later for later in deferred if later > place]:
                del deferred[later]
            return True
    return False


class _Attempt:
    """One way in which a life may have been. `deferred`: how far from the likely order timers end, by their number."""

    def __init__(
        self,
        header: CheckedHeader,
        span: _Span,
        late_s: float,
        deferred: dict[int, int],
        stored: StoredState | None,
        birth_s: float,
        stills: Sequence[Still],
    ) -> None:
        self.inputs: list[Input] = []
        self.problem: str | None = None
        self.choices: list[int] = []
        """For each timer how many other orders there are."""
        self._header = header
        self._agent = _agent(header)
        self.stood_still: Still | None = None
        """When it cannot have been at work, for it sent nothing and had something to send."""
        self._stills = stills
        self._given: list[tuple[float, What]] = [(self._awake(seen.at_s), Heard(seen.datagram)) for seen in span.came]
        self._given += [(self._awake(at_s, 2 * JUST_AFTER_S), Logged(event)) for at_s, event in span.logged]
        self._given.sort(key=lambda timed: timed[0])
        self._left = span.left
        self._is_last = span.is_last
        self._late_s = late_s
        self._unread_s = late_s * UNREAD_WALL_S / LATE_WALL_S
        self._deferred = deferred
        self._stored = stored
        self._explained = 0
        self._over = False
        """It did no more: it has died."""
        self._now = birth_s

    def left_on_disk(self) -> StoredState:
        """What it held at the end."""
        agent = _agent(self._header)
        for given in self.inputs:
            _feed(agent, given.at_s, given.what, self._stored)
        return StoredState.of(agent.state)

    def run(self) -> None:
        position = 0
        if self._stored is not None:
            self._give(self._now, Booted())
        while self.problem is None and not self._over:
            next_s = self._given[position][0] if position < len(self._given) else NEVER
            deadline = self._next_timer()
            if self._operator_asks(min(next_s, NEVER if deadline is None else deadline)):
                continue
            if deadline is not None and deadline <= next_s:
                if next_s == NEVER and self._explained == len(self._left):
                    return
                position = self._end_timer(deadline, position)
            elif next_s == NEVER:
                break
            else:
                self._give(*self._given[position])
                position += 1
        if self.problem is None and not self._over and self._explained < len(self._left):
            self._fail(self._left[self._explained])

    def _awake(self, at_s: float, after_s: float = 0.0) -> float:
        """When it was at work again, if it stood still then: what its socket holds comes first, timers, then events."""
        return next((until_s + after_s for from_s, until_s in self._stills if from_s <= at_s < until_s), at_s)

    def _next_timer(self) -> float | None:
        deadline = self._agent.next_timer()
        return None if deadline is None else self._awake(deadline, JUST_AFTER_S)

    def _operator_asks(self, next_s: float) -> bool:
        """Whether a reconcile begins before anything else comes: then the operator has asked for it."""
        if self._explained == len(self._left) or self._agent.state.reconcile_in_progress:
            return False
        seen = self._left[self._explained]
        if seen.at_s >= next_s or not isinstance(decode(seen.datagram).message, ChainContainQuery):
            return False
        self._give(seen.at_s, Asked())
        return True

    def _end_timer(self, deadline: float, position: int) -> int:
        """End the timer, after those inputs that came before; which input is next then."""
        waits, least, most = self._order(deadline, position)
        place = len(self.choices)
        self.choices.append(most - least)
        tried = self._deferred.get(place, 0)
        waits = waits - tried if waits == most else waits + tried
        for _ in range(waits):
            if self.problem is None and self._next_timer() == deadline:
                self._give(*self._given[position])
                position += 1
        if self.problem is None and self._next_timer() == deadline:
            soonest = self._agent.next_timer()
            timer = next(timer for timer in self._agent.state.timers if timer.deadline == soonest)
            self._give(max(deadline, self._now), TimerEnded(timer.name))
        return position

    def _order(self, deadline: float, position: int) -> tuple[int, int, int]:
        """How many of the next inputs probably came before the timer ended, and how few or many may have.

        What was sent as it ended says when that was; what came just before that may still have waited in the socket.
        """
        latest_s = deadline + self._late_s
        for seen in self._left[self._explained :]:
            if seen.at_s > latest_s:
                break
            if seen.at_s >= deadline - ROUNDING_S and type(decode(seen.datagram).message) in SENT_AS_TIMERS_END:
                most = self._before(position, seen.at_s)
                return most, self._before(position, seen.at_s - self._unread_s), most
        return 0, 0, self._before(position, latest_s)

    def _before(self, position: int, at_s: float) -> int:
        count = 0
        while position + count < len(self._given) and self._given[position + count][0] < at_s:
            count += 1
        return count

    def _give(self, at_s: float, what: What) -> None:
        agent = self._agent
        self._now = now = max(self._now, at_s)
        if self._explained < len(self._left) and self._left[self._explained].at_s + self._late_s < at_s:
            self._fail(self._left[self._explained])
            return
        _feed(agent, now, what, self._stored)
        runs = [entry for entry in agent.trace() if isinstance(entry, HandlerRun)]
        for sequence, message in agent.messages_to_send():
            if self._explained == len(self._left) and not self._is_last:
                self._over = True
                return
            if self._explained == len(self._left) or self._left[self._explained].datagram != encode(
                agent.agent_id, sequence, message
            ):
                self.problem = f"should have sent a {message.NAME} by t={now:.3f} s, but its capture has none"
                self._look_whether_still(at_s)
                return
            self._explained += 1
        if runs:
            self.inputs.append(Input(now, 0, what, runs))

    def _look_whether_still(self, since_s: float) -> None:
        """Nothing was sent when something should have been: until something is."""
        until_s = self._left[self._explained].at_s if self._explained < len(self._left) else NEVER
        if since_s + self._late_s < until_s < NEVER:
            self.stood_still = since_s, until_s

    def _fail(self, seen: Seen) -> None:
        message = decode(seen.datagram).message
        self.problem = f"sent a {message.NAME} at t={seen.at_s:.3f} s, which no recorded input explains"


def _feed(agent: Agent, now: float, what: What, stored: StoredState | None) -> None:
    match what:
        case Heard(datagram):
            agent.receive_datagram(datagram, now)
        case Logged(event):
            agent.add_event(event, now)
        case Asked():
            agent.begin_reconcile(now)
        case TimerEnded(name):
            timer = next(timer for timer in agent.state.timers if timer.name == name)
            agent.end_timer(timer, max(now, timer.deadline or now))
        case Booted():
            assert stored is not None, "it boots from something"
            agent.boot(stored, now)


def _agent(header: CheckedHeader) -> Agent:
    return Agent(header.agent_id, header.roster, header.initial_data, header.settings, seal=header.seal)
