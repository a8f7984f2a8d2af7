"""Simulate one agent alone with its recorded inputs, to find the part of its record that follows the protocol.

The agent core, with or without a known mistake (quirk), receives each recorded input at its recorded time. The
resulting handler runs must equal the recorded ones. Because of this comparison, the first deviation of an agent is
known before the whole flight is simulated. The reference implementation is not used here, because the scenario will be
played by agents, and quirks exist only for the agent core. The reference is used only to name the deviations from the
protocol: `_comparing` reads these names from the step judge. The simulation also determines which datagrams had an
effect, which timers were started, and which datagrams were sent.
"""

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import zip_longest
from random import Random

from harness.checker.recorded_inputs import decoded
from harness.checker.steps.core_in_use import settings_in_use
from harness.checker.steps.trace_header import CheckedHeader
from harness.field.reconstruct._agent_inputs import (
    BootedFromDisk,
    DatagramReceived,
    EventLogged,
    InferredInputPath,
    KnownState,
    ReconcileRequested,
    RecordedInput,
    TimerExpired,
)
from harness.play.simulation.fate_script import LateTimers, RunningTimer
from ucp.agent import Agent, drop_reason
from ucp.block import next_chain_hash
from ucp.interest import MATTERS, ONLY_COUNTED
from ucp.messages import CommitBlock, MalformedDatagramError, Message, decode, encode
from ucp.quirks import Quirks, wrong_handlers
from ucp.store import StoredState
from ucp.trace import Entry, HandlerRun, SentMessage
from ucp.trigger import LocalTrigger

MAX_NAME = 40


@dataclass(frozen=True, slots=True)
class TimerStart:
    """A timer that the agent started."""

    number: int
    """The number of the timer. All timers of the agent are numbered in the order of their starts."""
    place: int
    """The position of the input that started the timer, in the list of inputs."""
    duration_s: float
    """The duration of the timer on the agent's own clock."""


@dataclass(frozen=True)
class ProtocolDeviation:
    """The place at which an agent's record deviates from the protocol."""

    line: int
    at_s: float
    description: str
    """The deviation as text that completes a sentence such as "agent 32 ..."."""
    algorithms: frozenset[int]
    """The Algorithms of the recorded handler runs at this place."""


@dataclass(slots=True)
class PlayedInput:
    """An input that was simulated, in a form that can be simulated again."""

    incarnation: int
    input: RecordedInput
    sent: list[bytes]
    """The datagrams that the input caused."""
    matters: bool
    """False for a message without effect."""
    expired: TimerStart | None = None
    """The timer that expired, if the input is a timer expiry."""
    stopped: list[TimerStart] = field(default_factory=list)
    """The timers that the input stopped before their expiry."""


@dataclass
class SoloSimulation:
    """The simulation of one agent with its recorded inputs."""

    agent_id: int
    quirks: Quirks
    played: list[PlayedInput] = field(default_factory=list)
    """The simulated inputs. If the record deviates from the protocol, only the inputs before `deviation`."""
    deviation: ProtocolDeviation | None = None
    chain: list[str] = field(default_factory=list)
    """The block hashes of the agent's chain after the last input."""
    running_at_end: list[list[TimerStart]] = field(default_factory=list)
    """The timers that were running at the end of each incarnation."""
    truncated: bool = False
    """True if the record ends before all effects of its last input. The simulation completes this input."""
    matches_exactly: bool = True
    """True if the branches and tallies of the simulation also equal the recorded branches and tallies."""
    ignored: list[RecordedInput] = field(default_factory=list)
    """Messages that the agent ignored although they should have had an effect. The simulation omits them."""
    inferred: int = 0
    """Number of guessed inputs that replace lost lines."""
    stopped: str | None = None
    """The reason why trace lines were lost. It is set only if the simulation could not reach the known state after
    these lines, and so ended before them.
    """


@dataclass(frozen=True, slots=True)
class ToleratedDeviations:
    """The kinds of deviations that the simulation tolerates: early timers, and ignored messages."""

    early_timers: bool = False
    ignoring: bool = False


Incarnations = Sequence[Sequence[RecordedInput | KnownState]]
"""The inputs of each incarnation. Where inputs are lost, the list contains the known state of the agent after the lost
inputs.
"""


def rehearse(
    header: CheckedHeader,
    incarnations: "Incarnations",
    quirks: Quirks | None = None,
    tolerance: ToleratedDeviations | None = None,
) -> SoloSimulation:
    """Simulate all recorded inputs up to the first deviation, and return the result."""
    tolerance = tolerance or ToleratedDeviations()
    rehearsal = SoloSimulation(header.agent_id, quirks or {})
    stored: StoredState | None = None
    timers = LateTimers()
    for incarnation, inputs in enumerate(incarnations):
        rehearsed = _IncarnationSimulation(header, rehearsal, incarnation, timers, tolerance)
        for index, recorded_input in enumerate(inputs):
            if isinstance(recorded_input, KnownState):
                if not rehearsed.bridge(recorded_input):
                    rehearsal.stopped = recorded_input.why
                    rehearsal.truncated = True
                    break
                continue
            is_last = incarnation == len(incarnations) - 1 and index == len(inputs) - 1
            if deviation := rehearsed.play(index, recorded_input, stored, is_last=is_last):
                rehearsal.deviation = deviation
                break
        agent = rehearsed.agent
        rehearsal.running_at_end.append(rehearsed.running_at_end())
        rehearsal.chain = [block.block_hash.hex() for block in agent.state.chain]
        if rehearsal.deviation or rehearsal.stopped:
            break
        stored = StoredState.of(agent.state)
    return rehearsal


class _IncarnationSimulation:
    def __init__(
        self,
        header: CheckedHeader,
        rehearsal: SoloSimulation,
        incarnation: int,
        timers: LateTimers,
        tolerance: ToleratedDeviations,
    ) -> None:
        self.agent = Agent(
            header.agent_id,
            header.roster,
            header.initial_data,
            settings_in_use(header),
            handlers=wrong_handlers(rehearsal.quirks, Random(0)),
            seal=header.seal,
        )
        self._rehearsal = rehearsal
        self._processes_all = bool(rehearsal.quirks)
        self._incarnation = incarnation
        self._timers = timers
        self._early_s = math.inf if tolerance.early_timers else header.early_s
        self._ignoring = tolerance.ignoring
        self._running_timers: dict[int, TimerStart] = {}
        """The timers that are running, by their numbers."""
        timers.update(self.agent.state)

    def running_at_end(self) -> list[TimerStart]:
        """Return the timers that still run at the end of the record."""
        return [*self._running_timers.values()]

    def bridge(self, known: KnownState) -> bool:
        """Guess inputs that lead the agent to the state `known`, and simulate them. Return true if the agent reaches
        the state `known`.
        """
        bridge = InferredInputPath(self.agent, known)
        sent: list[Message] = []
        while (cause := bridge.next(sent)) is not None:
            state = self.agent.state
            deadlines = [timer.deadline for timer in state.timers if timer.deadline is not None]
            at_s = max(state.now, min(deadlines, default=0.0)) if isinstance(cause, TimerExpired) else state.now
            expired = self._timers.running.get(cause.name) if isinstance(cause, TimerExpired) else None
            inferred = RecordedInput(at_s, 0, cause)
            if self._feed(inferred, None) is not None:
                return False
            inferred.runs = [entry for entry in self.agent.trace() if isinstance(entry, HandlerRun)]
            numbered = self.agent.messages_to_send()
            sent = [message for _, message in numbered]
            datagrams = [encode(self.agent.agent_id, *each) for each in numbered]
            played = PlayedInput(self._incarnation, inferred, datagrams, matters=True)
            self._follow_timers(played, expired)
            self._rehearsal.played.append(played)
            self._rehearsal.inferred += 1
        return bridge.reached

    def play(
        self, index: int, recorded_input: RecordedInput, stored: StoredState | None, *, is_last: bool
    ) -> ProtocolDeviation | None:
        """Simulate an input. If the result differs from the record, return the deviation. Otherwise return None."""
        expired = (
            self._timers.running.get(recorded_input.cause.name)
            if isinstance(recorded_input.cause, TimerExpired)
            else None
        )
        matters = (
            not isinstance(recorded_input.cause, DatagramReceived)
            or self._processes_all
            or self._matters(recorded_input.cause.datagram)
        )
        if matters and self._ignoring and self._ignores(recorded_input):
            self._rehearsal.ignored.append(recorded_input)
            matters = False
        problem = self._feed(recorded_input, stored if index == 0 else None) if matters else None
        entries = self.agent.trace()
        if (
            (is_last or recorded_input.is_partial)
            and len(recorded_input.runs) < len(entries)
            and not _difference(recorded_input.runs, entries[: len(recorded_input.runs)])
        ):
            self._rehearsal.truncated |= is_last
            recorded_input.runs = [entry for entry in entries if isinstance(entry, HandlerRun)]
        problem = problem or _difference(recorded_input.runs, entries)
        if problem is not None:
            algorithms = frozenset(run.algorithm for run in recorded_input.runs)
            return ProtocolDeviation(recorded_input.line, recorded_input.runs[0].t, problem, algorithms)
        self._rehearsal.matches_exactly &= _matches_exactly(recorded_input.runs, entries)
        sent = self._sent(recorded_input)
        played = PlayedInput(self._incarnation, recorded_input, sent, matters)
        if matters:
            self._follow_timers(played, expired)
        self._rehearsal.played.append(played)
        return None

    def _sent(self, recorded_input: RecordedInput) -> list[bytes]:
        """Return the datagrams that the agent sent according to the record. If the record does not contain them, return
        the datagrams of the simulated agent.
        """
        encoded = [encode(self.agent.agent_id, *numbered) for numbered in self.agent.messages_to_send()]
        recorded = [sent.datagram for run in recorded_input.runs for sent in run.sent]
        both = zip(encoded, recorded, strict=False)
        return [our if their is None else base64.b64decode(their.text) for our, their in both]

    def _follow_timers(self, played: PlayedInput, ended: RunningTimer | None) -> None:
        """Record the timers that the input started, and the timers that it stopped."""
        place, before = len(self._rehearsal.played), self._running_timers
        self._timers.update(self.agent.state)
        self._running_timers = {}
        for _, number, deadline in self._timers.running.values():
            duration_s = round(deadline - self.agent.state.now, 9)
            self._running_timers[number] = before.get(number) or TimerStart(number, place, duration_s)
        if ended is not None:
            played.expired = before.pop(ended.number)
        played.stopped = [started for number, started in before.items() if number not in self._running_timers]

    def _feed(self, recorded_input: RecordedInput, stored: StoredState | None) -> str | None:
        """Give an input to the simulated agent. If the input is impossible, return the reason. Otherwise return
        None.
        """
        agent, now = self.agent, recorded_input.at_s
        match recorded_input.cause:
            case EventLogged(event):
                try:
                    agent.add_event(event, now)
                except ValueError as error:
                    return f"logged an invalid event: {error}"
            case DatagramReceived(datagram):
                agent.receive_datagram(datagram, now)
            case TimerExpired(name):
                timer = next((timer for timer in agent.state.timers if timer.name == name), None)
                if timer is None or timer.deadline is None:
                    return f"recorded the expiry of its {name[:MAX_NAME]} timer, which was not running"
                if now < timer.deadline - self._early_s:
                    return f"recorded the expiry of its {name} timer {timer.deadline - now:.3g} s early"
                agent.end_timer(timer, max(now, timer.deadline))
            case ReconcileRequested():
                agent.begin_reconcile(now)
            case BootedFromDisk():
                if stored is None:
                    return "restarted from its disk, whose content is not recorded"
                agent.boot(stored, now)
        return None

    def _matters(self, datagram: bytes) -> bool:
        """Return true if the datagram has an effect on an agent that follows the protocol."""
        try:
            sender, _, message = decode(datagram)
        except MalformedDatagramError:
            return False
        agent = self.agent
        if drop_reason(agent.agent_id, agent.roster, sender, message):
            return False
        return MATTERS[type(message)](agent.state, sender, message)

    def _ignores(self, recorded_input: RecordedInput) -> bool:
        """Return true if the recorded agent ignored a message that should have had an effect."""
        if not isinstance(recorded_input.cause, DatagramReceived) or any(
            run.changes or run.sent for run in recorded_input.runs
        ):
            return False
        message, state = decode(recorded_input.cause.datagram).message, self.agent.state
        if type(message) in ONLY_COUNTED or len(recorded_input.runs) > 1:
            return False
        if not isinstance(message, CommitBlock):
            return True
        succeeds = message.chain_hash == next_chain_hash(state.chain.top_chain_hash, message.block.block_hash)
        return succeeds and not state.holds(message.block.block_hash)


def _matches_exactly(recorded: Sequence[HandlerRun], entries: Sequence[Entry]) -> bool:
    ours = [(entry.branch, entry.tally) for entry in entries if isinstance(entry, HandlerRun)]
    return not ours or ours == [
        (run.branch, our[1] if run.tally is None else run.tally) for run, our in zip(recorded, ours, strict=False)
    ]


def _difference(recorded: Sequence[HandlerRun], entries: Sequence[Entry]) -> str | None:
    """Describe the first difference that has an effect. Return None if no difference has an effect."""
    runs = [entry for entry in entries if isinstance(entry, HandlerRun)]
    for ours, theirs in zip_longest(runs, recorded):
        if ours is None:
            if theirs.changes or theirs.sent or isinstance(theirs.trigger, LocalTrigger):
                return f"ran {theirs.handler}, but should have done nothing"
        elif theirs is None:
            return f"did not run {ours.handler}, which was triggered"
        elif ours.handler != theirs.handler:
            return f"ran {theirs.handler}; it should have run {ours.handler}"
        elif ours.changes != theirs.changes or not same_sent(ours.sent, theirs.sent):
            return f"deviated from the protocol in {ours.handler}"
    return None


def same_sent(ours: Sequence[SentMessage], theirs: Sequence[SentMessage]) -> bool:
    """Return true if the messages are equal. Sequence numbers are ignored, because the protocol does not use them."""
    if len(ours) != len(theirs):
        return False
    return all(_same_message(our, their) for our, their in zip(ours, theirs, strict=True))


def _same_message(ours: SentMessage, theirs: SentMessage) -> bool:
    if (ours.message, ours.block) != (theirs.message, theirs.block):
        return False
    try:
        return theirs.datagram is None or decoded(ours.datagram).message == decoded(theirs.datagram).message
    except MalformedDatagramError:
        return False
