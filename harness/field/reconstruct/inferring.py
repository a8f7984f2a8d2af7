"""What reached an agent that left no trace in full, inferred: from its capture, and the events in its blocks.

The capture says what came and what was sent, and when. What was logged is in the blocks. When timers ended is not on
record: as a rule when they should, but a program is late now and then, and then another input may have come first. So
the reference core is given everything in the order of time, and has to send what the capture saw leave; where it does
not, what came while a timer was late is tried before the timer, the last such choice first. A reconcile that begins
without anything that led to it is the operator's.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

from harness.checker.steps.header import CheckedHeader
from harness.field.reconstruct.elsewhere import Captured, Seen, seconds_of
from harness.field.reconstruct.inputs import Asked, Heard, Input, Logged, TimerEnded, What
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
from ucp.trace import HandlerRun

MAX_TRIES = 400
LATE_WALL_S = 0.1
"""A timer that is later than that was not only late."""
UNREAD_WALL_S = 0.005
"""So long a datagram may wait in a socket."""
ROUNDING_S = 1e-3
SENT_AS_TIMERS_END = (BlockAddRequest, CommitBlock, ChainContainQuery, ChainHashSuccessorQuery, RequestForBlock)
"""Mostly: a query may also come of what another agent has sent."""


@dataclass
class Inferred:
    """The inputs as far as they explain what was sent; `problem` says what they do not explain, if anything."""

    inputs: list[Input] = field(default_factory=list)
    problem: str | None = None


def infer(header: CheckedHeader, captured: Captured, events: Sequence[LoggableEvent]) -> Inferred:
    """What reached the agent of one life. `header` is what it was told."""
    came = [seen for seen in captured.seen if not seen.leaving and seen.at_s >= 0]
    left = [seen for seen in captured.seen if seen.leaving]
    if any(later.sequence <= earlier.sequence for earlier, later in pairwise(left)):
        return Inferred([], "started anew in flight, and what it held then is not on record")
    logged = [(seconds_of(event, captured), event) for event in events]
    late_s = LATE_WALL_S * captured.speedup + ROUNDING_S
    deferred: dict[int, int] = {}
    best = Inferred()
    for _ in range(MAX_TRIES):
        attempt = _Attempt(header, came, left, logged, late_s, deferred)
        attempt.run()
        if attempt.problem is None:
            return Inferred(attempt.inputs)
        if len(attempt.inputs) > len(best.inputs):
            best = Inferred(attempt.inputs, attempt.problem)
        if not _try_another(deferred, attempt.choices):
            break
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
    """One way in which it may have been. `deferred`: how far from the likely order timers end, by their number."""

    def __init__(
        self,
        header: CheckedHeader,
        came: Sequence[Seen],
        left: Sequence[Seen],
        logged: Sequence[tuple[float, LoggableEvent]],
        late_s: float,
        deferred: dict[int, int],
    ) -> None:
        self.inputs: list[Input] = []
        self.problem: str | None = None
        self.choices: list[int] = []
        """For each timer how many other orders there are."""
        self._agent = Agent(header.agent_id, header.roster, header.initial_data, header.settings)
        self._given: list[tuple[float, What]] = [(seen.at_s, Heard(seen.datagram)) for seen in came]
        self._given += [(at_s, Logged(event)) for at_s, event in logged]
        self._given.sort(key=lambda timed: timed[0])
        self._left = left
        self._late_s = late_s
        self._unread_s = late_s * UNREAD_WALL_S / LATE_WALL_S
        self._deferred = deferred
        self._explained = 0
        self._now = 0.0

    def run(self) -> None:
        position = 0
        while self.problem is None:
            next_s = self._given[position][0] if position < len(self._given) else NEVER
            deadline = self._agent.next_timer()
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
        if self.problem is None and self._explained < len(self._left):
            self._fail(self._left[self._explained])

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
            if self.problem is None and self._agent.next_timer() == deadline:
                self._give(*self._given[position])
                position += 1
        if self.problem is None and self._agent.next_timer() == deadline:
            timer = next(timer for timer in self._agent.state.timers if timer.deadline == deadline)
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
        runs = [entry for entry in agent.trace() if isinstance(entry, HandlerRun)]
        for sequence, message in agent.messages_to_send():
            if self._explained == len(self._left) or self._left[self._explained].datagram != encode(
                agent.agent_id, sequence, message
            ):
                self.problem = f"by t={now:.3f} s should have sent a {message.NAME}, and did not, as its capture says"
                return
            self._explained += 1
        if runs:
            self.inputs.append(Input(now, 0, what, runs))

    def _fail(self, seen: Seen) -> None:
        message = decode(seen.datagram).message
        self.problem = (
            f"sent a {message.NAME} at t={seen.at_s:.3f} s, which nothing explains that is known to have reached it"
        )
