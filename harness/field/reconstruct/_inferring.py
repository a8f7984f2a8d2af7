"""Guess the inputs of an agent without a complete trace. The sources are the packet capture of its vehicle and the
events in its blocks.

The capture contains the received and sent datagrams with their times. The blocks contain the logged events. The expiry
of timers is not recorded. Usually a timer expires on time. A process is sometimes late, and another input may then come
first.

The search gives all inputs to an agent core in order of time, and compares the datagrams that the core sends with the
capture. If they differ, the search tries other orders: datagrams that arrived shortly after a timer's deadline come
before the expiry. The last such timer is changed first. If a reconcile has no recorded cause, the operator is assumed
to have requested it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

from harness.checker.steps.core_in_use import settings_in_use
from harness.checker.steps.trace_header import CheckedHeader
from harness.field._vehicle_captures import AgentCapture, CapturedDatagram, seconds_of
from harness.field.reconstruct._agent_inputs import (
    BootedFromDisk,
    Cause,
    DatagramReceived,
    EventLogged,
    ReconcileRequested,
    RecordedInput,
    TimerExpired,
)
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
MAX_INPUTS = 200_000
"""Maximum number of inputs that are simulated in all attempts together. The simulation of this number takes some
seconds.
"""
MAX_LATE_WALL_S = 0.1
"""Maximum delay of a timer in seconds of wall time. If a timer is later, the process was paused."""
MAX_UNREAD_WALL_S = 0.005
"""Maximum number of seconds of wall time that a datagram waits in a socket."""
ROUNDING_S = 1e-3
Pause = tuple[float, float]
"""A pause of the agent's process. The two values are the mission seconds of its start and its end."""
MAX_PAUSES = 10
JUST_AFTER_S = 1e-6
MAX_STARTS = 50
TRIES_PER_START = 5
ANSWERED_QUERIES = (BlockAddRequest, ChainContainQuery, ChainHashSuccessorQuery)
"""Queries that an agent always answers, except during a reconcile."""
SENT_ON_TIMER_EXPIRY = (BlockAddRequest, CommitBlock, ChainContainQuery, ChainHashSuccessorQuery, RequestForBlock)
"""Messages that an agent usually sends when a timer expires. Received datagrams can cause some of them, too."""


@dataclass
class InferredInputs:
    """The guessed inputs of each incarnation, which explain the datagrams that the agent sent. `problem` names the
    first datagram that the inputs do not explain.
    """

    incarnations: list[list[RecordedInput]] = field(default_factory=list)
    problem: str | None = None

    @property
    def explained(self) -> int:
        """The number of guessed inputs that explain sent datagrams."""
        return sum(map(len, self.incarnations))


@dataclass(frozen=True)
class _IncarnationRecord:
    """The received datagrams, sent datagrams, and logged events of an agent between two restarts."""

    received: Sequence[CapturedDatagram]
    sent: Sequence[CapturedDatagram]
    logged_events: Sequence[tuple[float, LoggableEvent]]
    is_last: bool

    def since(self, at_s: float) -> "_IncarnationRecord":
        """Return the later part of these records, beginning with a restart of the agent at `at_s`."""
        received = [sighting for sighting in self.received if sighting.at_s >= at_s]
        logged_events = [timed for timed in self.logged_events if timed[0] >= at_s]
        return _IncarnationRecord(received, self.sent, logged_events, self.is_last)


def infer(
    header: CheckedHeader, capture: AgentCapture, events: Sequence[LoggableEvent], tries: int = MAX_TRIES
) -> InferredInputs:
    """Guess the inputs of an agent. `header` contains its mission and settings."""
    late_s = MAX_LATE_WALL_S * capture.speedup + ROUNDING_S
    inferred = InferredInputs()
    stored: StoredState | None = None
    for record in _incarnation_records(capture, events):
        if stored is None:
            attempt = _infer_incarnation(header, record, late_s, None, tries)
        else:
            attempt = _infer_restarted(header, record, late_s, stored, tries)
        inferred.incarnations.append(attempt.inputs)
        if attempt.problem is not None:
            inferred.problem = attempt.problem
            break
        stored = attempt.stored_at_end()
    return inferred


def _incarnation_records(capture: AgentCapture, events: Sequence[LoggableEvent]) -> Iterator[_IncarnationRecord]:
    """Yield the records of each incarnation. A restart is visible because the agent numbers its datagrams from 0
    again.
    """
    received = [sighting for sighting in capture.sightings if not sighting.outbound and sighting.at_s >= 0]
    sent = [sighting for sighting in capture.sightings if sighting.outbound]
    logged_events = [(seconds_of(event, capture), event) for event in events]
    firsts = [0, *(n for n in range(1, len(sent)) if sent[n].sequence <= sent[n - 1].sequence), len(sent)]
    from_s = 0.0
    for number, (first, end) in enumerate(pairwise(firsts)):
        is_last = number == len(firsts) - 2
        until_s = NEVER if is_last else _last_seen(received, sent[end - 1].at_s, sent[end].at_s)
        within = [sighting for sighting in received if from_s <= sighting.at_s < until_s]
        yield _IncarnationRecord(
            within, sent[first:end], [timed for timed in logged_events if from_s <= timed[0] < until_s], is_last
        )
        from_s = sent[end - 1].at_s if end else 0.0  # The next incarnation may have begun at any time after this.


def _last_seen(received: Sequence[CapturedDatagram], last_s: float, restart_s: float) -> float:
    """Return the assumed end of an incarnation, which sent its last message at `last_s`. This is the time of the first
    query after `last_s`, because the agent did not answer it. Without such a query, return `restart_s`.
    """
    later = (sighting for sighting in received if last_s < sighting.at_s)
    questions = (sighting.at_s for sighting in later if isinstance(decode(sighting.datagram).message, ANSWERED_QUERIES))
    return min(next(questions, restart_s), restart_s)


def _infer_restarted(
    header: CheckedHeader, record: _IncarnationRecord, late_s: float, stored: StoredState, tries: int
) -> "_InputSequence":
    """Guess the inputs after a restart. The time of the restart and the content of the disk are unknown. Try several
    times before the first sent datagram, each with and without data on the disk. Return the best guess.
    """
    first_s = record.sent[0].at_s if record.sent else NEVER
    times = sorted(
        {first_s, *(sighting.at_s for sighting in record.received), *(at_s for at_s, _ in record.logged_events)}
    )
    starts = [at_s for at_s in times if at_s <= first_s][-MAX_STARTS:][::-1]
    best: _InputSequence | None = None
    for start_s in starts:
        for disk in (None, stored):
            attempt = _infer_incarnation(
                header, record.since(start_s), late_s, disk, min(tries, TRIES_PER_START), start_s
            )
            if attempt.problem is None:
                return attempt
            if best is None or len(attempt.inputs) > len(best.inputs):
                best = attempt
    assert best is not None, "there is a time of birth"
    return best


def _infer_incarnation(
    header: CheckedHeader,
    record: _IncarnationRecord,
    late_s: float,
    stored: StoredState | None,
    tries: int,
    start_s: float = 0.0,
) -> "_InputSequence":
    """Try different orders of the inputs. Return an order that explains all sent datagrams. Without such an order,
    return the order that explains the longest sequence of inputs.
    """
    deferred: dict[int, int] = {}
    pauses: list[Pause] = []
    best: _InputSequence | None = None
    inputs_tried = 0
    for _ in range(tries):
        attempt = _InputSequence(header, record, late_s, deferred, stored, start_s, pauses)
        attempt.run()
        if attempt.pause is not None and len(pauses) < MAX_PAUSES:
            pauses.append(attempt.pause)
            continue
        if best is None or attempt.problem is None or len(attempt.inputs) > len(best.inputs):
            best = attempt
        inputs_tried += len(attempt.inputs)
        if attempt.problem is None or inputs_tried > MAX_INPUTS or not _next_combination(deferred, attempt.choices):
            break
    assert best is not None, "something was tried"
    return best


def _next_combination(deferred: dict[int, int], choices: Sequence[int]) -> bool:
    """Choose the next order of inputs to try: change the position of one timer, and reset the positions of all later
    timers. The function chooses the last timer that has a further possible position. Return false if no timer has one.
    """
    for place in range(len(choices) - 1, -1, -1):
        if deferred.get(place, 0) < choices[place]:
            deferred[place] = deferred.get(place, 0) + 1
            for later in [later for later in deferred if later > place]:
                del deferred[later]
            return True
    return False


class _InputSequence:
    """One possible order of the inputs of an agent between two restarts. Each timer expires at its most likely position
    among the other inputs, unless `deferred` moves the expiry to a later position. `deferred` maps the number of a
    timer to the number of positions by which its expiry is moved.
    """

    def __init__(
        self,
        header: CheckedHeader,
        record: _IncarnationRecord,
        late_s: float,
        deferred: dict[int, int],
        stored: StoredState | None,
        start_s: float,
        pauses: Sequence[Pause],
    ) -> None:
        self.inputs: list[RecordedInput] = []
        self.problem: str | None = None
        self.choices: list[int] = []
        """Number of a timer -> number of further positions among the inputs at which the expiry of this timer is
        possible.
        """
        self._header = header
        self._agent = _agent(header)
        self.pause: Pause | None = None
        """A pause of the process that follows from this order of inputs: although the agent had a message to send, it
        sent nothing for a long time. None without a pause.
        """
        self._pauses = pauses
        self._inputs_to_play: list[tuple[float, Cause]] = [
            (self._end_of_pause(sighting.at_s), DatagramReceived(sighting.datagram)) for sighting in record.received
        ]
        self._inputs_to_play += [
            (self._end_of_pause(at_s, 2 * JUST_AFTER_S), EventLogged(event)) for at_s, event in record.logged_events
        ]
        self._inputs_to_play.sort(key=lambda timed: timed[0])
        self._sent = record.sent
        self._is_last = record.is_last
        self._late_s = late_s
        self._unread_s = late_s * MAX_UNREAD_WALL_S / MAX_LATE_WALL_S
        self._deferred = deferred
        self._stored = stored
        self._explained = 0
        self._ended = False
        """True if the incarnation has ended, so that the capture contains no further datagram of the agent."""
        self._now = start_s

    def stored_at_end(self) -> StoredState:
        """Return the data on the agent's disk after all these inputs."""
        agent = _agent(self._header)
        for played in self.inputs:
            _feed(agent, played.at_s, played.cause, self._stored)
        return StoredState.of(agent.state)

    def run(self) -> None:
        position = 0
        if self._stored is not None:
            self._play(self._now, BootedFromDisk())
        while self.problem is None and not self._ended:
            next_s = self._inputs_to_play[position][0] if position < len(self._inputs_to_play) else NEVER
            deadline = self._next_timer()
            if self._begin_requested_reconcile(min(next_s, NEVER if deadline is None else deadline)):
                continue
            if deadline is not None and deadline <= next_s:
                if next_s == NEVER and self._explained == len(self._sent):
                    return
                position = self._expire_timer(deadline, position)
            elif next_s == NEVER:
                break
            else:
                self._play(*self._inputs_to_play[position])
                position += 1
        if self.problem is None and not self._ended and self._explained < len(self._sent):
            self._fail(self._sent[self._explained])

    def _end_of_pause(self, at_s: float, after_s: float = 0.0) -> float:
        """Return the time at which the agent handles an input that arrives at `at_s`. If the agent was paused at this
        time, it handles the input at the end of the pause. After a pause, the process first reads its socket, then
        handles timers, then events.
        """
        return next((until_s + after_s for from_s, until_s in self._pauses if from_s <= at_s < until_s), at_s)

    def _next_timer(self) -> float | None:
        deadline = self._agent.next_timer()
        return None if deadline is None else self._end_of_pause(deadline, JUST_AFTER_S)

    def _begin_requested_reconcile(self, next_s: float) -> bool:
        """Begin a reconcile if the capture shows that a reconcile began before the next input. Because no input caused
        this reconcile, the operator must have requested it. Return true if a requested reconcile begins.
        """
        if self._explained == len(self._sent) or self._agent.state.reconcile_in_progress:
            return False
        sighting = self._sent[self._explained]
        if sighting.at_s >= next_s or not isinstance(decode(sighting.datagram).message, ChainContainQuery):
            return False
        self._play(sighting.at_s, ReconcileRequested())
        return True

    def _expire_timer(self, deadline: float, position: int) -> int:
        """Let the timer expire after the inputs that come before its expiry. Return the position of the next input."""
        count, fewest, most = self._inputs_before_timer(deadline, position)
        place = len(self.choices)
        self.choices.append(most - fewest)
        tried = self._deferred.get(place, 0)
        count = count - tried if count == most else count + tried
        for _ in range(count):
            if self.problem is None and self._next_timer() == deadline:
                self._play(*self._inputs_to_play[position])
                position += 1
        if self.problem is None and self._next_timer() == deadline:
            soonest = self._agent.next_timer()
            timer = next(timer for timer in self._agent.state.timers if timer.deadline == soonest)
            self._play(max(deadline, self._now), TimerExpired(timer.name))
        return position

    def _inputs_before_timer(self, deadline: float, position: int) -> tuple[int, int, int]:
        """Return the most likely, the smallest and the largest number of inputs before the expiry of the timer. The
        datagrams that the expiry caused show its time. Datagrams that arrived shortly before this time may have waited
        in the socket.
        """
        latest_s = deadline + self._late_s
        for sighting in self._sent[self._explained :]:
            if sighting.at_s > latest_s:
                break
            if (
                sighting.at_s >= deadline - ROUNDING_S
                and type(decode(sighting.datagram).message) in SENT_ON_TIMER_EXPIRY
            ):
                most = self._count_before(position, sighting.at_s)
                return most, self._count_before(position, sighting.at_s - self._unread_s), most
        return 0, 0, self._count_before(position, latest_s)

    def _count_before(self, position: int, at_s: float) -> int:
        count = 0
        while position + count < len(self._inputs_to_play) and self._inputs_to_play[position + count][0] < at_s:
            count += 1
        return count

    def _play(self, at_s: float, cause: Cause) -> None:
        agent = self._agent
        self._now = now = max(self._now, at_s)
        if self._explained < len(self._sent) and self._sent[self._explained].at_s + self._late_s < at_s:
            self._fail(self._sent[self._explained])
            return
        _feed(agent, now, cause, self._stored)
        runs = [entry for entry in agent.trace() if isinstance(entry, HandlerRun)]
        for sequence, message in agent.messages_to_send():
            if self._explained == len(self._sent) and not self._is_last:
                self._ended = True
                return
            if self._explained == len(self._sent) or self._sent[self._explained].datagram != encode(
                agent.agent_id, sequence, message
            ):
                what = f"sends a {message.NAME} by t={now:.3f} s with its inferred inputs"
                self.problem = f"{what}, and its capture has none, so an input is missing or has another time"
                self._detect_pause(at_s)
                return
            self._explained += 1
        if runs:
            self.inputs.append(RecordedInput(now, 0, cause, runs))

    def _detect_pause(self, since_s: float) -> None:
        """Record a pause if the agent sent nothing for a long time although it should have sent a message."""
        until_s = self._sent[self._explained].at_s if self._explained < len(self._sent) else NEVER
        if since_s + self._late_s < until_s < NEVER:
            self.pause = since_s, until_s

    def _fail(self, sighting: CapturedDatagram) -> None:
        message = decode(sighting.datagram).message
        self.problem = f"sent a {message.NAME} at t={sighting.at_s:.3f} s, which no recorded input explains"


def _feed(agent: Agent, now: float, cause: Cause, stored: StoredState | None) -> None:
    match cause:
        case DatagramReceived(datagram):
            agent.receive_datagram(datagram, now)
        case EventLogged(event):
            agent.add_event(event, now)
        case ReconcileRequested():
            agent.begin_reconcile(now)
        case TimerExpired(name):
            timer = next(timer for timer in agent.state.timers if timer.name == name)
            agent.end_timer(timer, max(now, timer.deadline or now))
        case BootedFromDisk():
            assert stored is not None, "it boots from something"
            agent.boot(stored, now)


def _agent(header: CheckedHeader) -> Agent:
    return Agent(header.agent_id, header.roster, header.initial_data, settings_in_use(header), seal=header.seal)
