"""One agent alone: how far its record is what the protocol does with the inputs on it.

Every input is given to the reference core, or to one with a known mistake, at the time on record. What comes of it has
to be what is on record. So the first step of a wrong agent is found before any flight is played; and of a right one it
is known which datagrams mattered, which timer was started when, and what was sent.
"""

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import zip_longest
from random import Random

from harness.checker.recorded_inputs import decoded
from harness.checker.steps.trace_header import CheckedHeader
from harness.field.reconstruct._agent_inputs import Asked, Booted, Heard, Input, Logged, TimerEnded
from harness.play.simulation.fate_script import LateTimers, Running
from ucp.agent import Agent, why_not_handled
from ucp.block import next_chain_hash
from ucp.interest import MATTERS, ONLY_COUNTED
from ucp.messages import CommitBlock, MalformedDatagramError, decode, encode
from ucp.quirks import Quirks, wrong_handlers
from ucp.store import StoredState
from ucp.trace import Entry, HandlerRun, Sent
from ucp.trigger import LocalTrigger

MAX_NAME = 40


@dataclass(frozen=True, slots=True)
class Started:
    """The `number`th timer that the agent has started; by the input at this place, for this long by its own clock."""

    number: int
    place: int
    duration_s: float


@dataclass(frozen=True)
class Parting:
    """Where an agent's record is not what the protocol does."""

    line: int
    at_s: float
    what: str
    """Completes "agent 32 ..."."""
    algorithms: frozenset[int]
    """What ran there, by the record."""


@dataclass(slots=True)
class Played:
    """An input that the agent can be given again.

    `sent` are the datagrams that came of it. `matters` is false of a message that no handler does anything with. `ends`
    is the timer that ended, if it is that; `stops` are those that run no longer, and did not end.
    """

    life: int
    input: Input
    sent: list[bytes]
    matters: bool
    ends: Started | None = None
    stops: list[Started] = field(default_factory=list)


@dataclass
class Rehearsal:
    """`played` are the inputs of all lives, up to where the record parts from the protocol; None is nowhere.

    `chain` has the block hashes of the chain that the agent then held.
    `pending` are the timers that ran at the end of each life.
    """

    agent_id: int
    quirks: Quirks
    played: list[Played] = field(default_factory=list)
    parting: Parting | None = None
    chain: list[str] = field(default_factory=list)
    pending: list[list[Started]] = field(default_factory=list)
    broken_off: bool = False
    """Whether the record ends in the middle of what its last input led to; the input is played to its end."""
    to_the_word: bool = True
    """Whether the branches that were taken and the votes that were counted are those on record, too."""
    ignored: list[Input] = field(default_factory=list)
    """Messages with which it did nothing, and should have done something; they are not played."""


@dataclass(frozen=True, slots=True)
class Allowed:
    """What an agent is allowed to do although no right one does it: have timers end early, ignore messages."""

    early_timers: bool = False
    ignoring: bool = False


def rehearse(
    header: CheckedHeader,
    lives: Sequence[Sequence[Input]],
    quirks: Quirks | None = None,
    allowed: Allowed | None = None,
) -> Rehearsal:
    """Give the agent all that is on record, up to where it did not do what is on record."""
    allowed = allowed or Allowed()
    rehearsal = Rehearsal(header.agent_id, quirks or {})
    stored: StoredState | None = None
    timers = LateTimers()
    for life, inputs in enumerate(lives):
        one_life = _Life(header, rehearsal, life, timers, allowed)
        for index, given in enumerate(inputs):
            is_last = life == len(lives) - 1 and index == len(inputs) - 1
            if parting := one_life.give(index, given, stored, is_last=is_last):
                rehearsal.parting = parting
                break
        agent = one_life.agent
        rehearsal.pending.append(one_life.pending())
        rehearsal.chain = [block.block_hash.hex() for block in agent.state.chain]
        if rehearsal.parting:
            break
        stored = StoredState.of(agent.state)
    return rehearsal


class _Life:
    def __init__(
        self, header: CheckedHeader, rehearsal: Rehearsal, life: int, timers: LateTimers, allowed: Allowed
    ) -> None:
        self.agent = Agent(
            header.agent_id,
            header.roster,
            header.initial_data,
            header.settings,
            handlers=wrong_handlers(rehearsal.quirks, Random(0)),
            seal=header.seal,
        )
        self._rehearsal = rehearsal
        self._hears_all = bool(rehearsal.quirks)
        self._life = life
        self._timers = timers
        self._early_s = math.inf if allowed.early_timers else header.early_s
        self._ignoring = allowed.ignoring
        self._started: dict[int, Started] = {}
        """The timers that run, by number."""
        timers.look(self.agent.state)

    def pending(self) -> list[Started]:
        """The timers that run now."""
        return [*self._started.values()]

    def give(self, index: int, given: Input, stored: StoredState | None, *, is_last: bool) -> Parting | None:
        """Where the agent did something else with it than is on record; None if it did not."""
        ends = self._timers.running.get(given.what.name) if isinstance(given.what, TimerEnded) else None
        matters = not isinstance(given.what, Heard) or self._hears_all or self._matters(given.what.datagram)
        if matters and self._ignoring and self._ignores(given):
            self._rehearsal.ignored.append(given)
            matters = False
        problem = self._feed(given, stored if index == 0 else None) if matters else None
        entries = self.agent.trace()
        if is_last and len(given.runs) < len(entries) and not _differs(given.runs, entries[: len(given.runs)]):
            self._rehearsal.broken_off = True
            given.runs = [entry for entry in entries if isinstance(entry, HandlerRun)]
        problem = problem or _differs(given.runs, entries)
        if problem is not None:
            algorithms = frozenset(run.algorithm for run in given.runs)
            return Parting(given.line, given.runs[0].t, problem, algorithms)
        self._rehearsal.to_the_word &= _to_the_word(given.runs, entries)
        sent = self._sent(given)
        played = Played(self._life, given, sent, matters)
        if matters:
            self._follow_timers(played, ends)
        self._rehearsal.played.append(played)
        return None

    def _sent(self, given: Input) -> list[bytes]:
        """The datagrams that left, as they are on record; as the reference makes them where they are not."""
        encoded = [encode(self.agent.agent_id, *numbered) for numbered in self.agent.messages_to_send()]
        recorded = [sent.datagram for run in given.runs for sent in run.sent]
        both = zip(encoded, recorded, strict=False)
        return [our if their is None else base64.b64decode(their.text) for our, their in both]

    def _follow_timers(self, played: Played, ended: Running | None) -> None:
        """Which timers the input has started, and which run no longer."""
        place, before = len(self._rehearsal.played), self._started
        self._timers.look(self.agent.state)
        self._started = {}
        for _, number, deadline in self._timers.running.values():
            duration_s = round(deadline - self.agent.state.now, 9)
            self._started[number] = before.get(number) or Started(number, place, duration_s)
        if ended is not None:
            played.ends = before.pop(ended.number)
        played.stops = [started for number, started in before.items() if number not in self._started]

    def _feed(self, given: Input, stored: StoredState | None) -> str | None:
        """Why that cannot be; None if it can."""
        agent, now = self.agent, given.at_s
        match given.what:
            case Logged(event):
                try:
                    agent.add_event(event, now)
                except ValueError as error:
                    return f"logged an invalid event: {error}"
            case Heard(datagram):
                agent.receive_datagram(datagram, now)
            case TimerEnded(name):
                timer = next((timer for timer in agent.state.timers if timer.name == name), None)
                if timer is None or timer.deadline is None:
                    return f"recorded the expiry of its {name[:MAX_NAME]} timer, which was not running"
                if now < timer.deadline - self._early_s:
                    return f"recorded the expiry of its {name} timer {timer.deadline - now:.3g} s early"
                agent.end_timer(timer, max(now, timer.deadline))
            case Asked():
                agent.begin_reconcile(now)
            case Booted():
                if stored is None:
                    return "restarted from its disk, whose content is not recorded"
                agent.boot(stored, now)
        return None

    def _matters(self, datagram: bytes) -> bool:
        """Whether a right agent does anything with it."""
        try:
            sender, _, message = decode(datagram)
        except MalformedDatagramError:
            return False
        agent = self.agent
        if why_not_handled(agent.agent_id, agent.roster, sender, message):
            return False
        return MATTERS[type(message)](agent.state, sender, message)

    def _ignores(self, given: Input) -> bool:
        """Whether nothing came of a message of which something should have come."""
        if not isinstance(given.what, Heard) or any(run.changes or run.sent for run in given.runs):
            return False
        message, state = decode(given.what.datagram).message, self.agent.state
        if type(message) in ONLY_COUNTED or len(given.runs) > 1:
            return False
        if not isinstance(message, CommitBlock):
            return True
        succeeds = message.chain_hash == next_chain_hash(state.chain.top_chain_hash, message.block.block_hash)
        return succeeds and not state.holds(message.block.block_hash)


def _to_the_word(recorded: Sequence[HandlerRun], entries: Sequence[Entry]) -> bool:
    ours = [(entry.branch, entry.tally) for entry in entries if isinstance(entry, HandlerRun)]
    return not ours or ours == [
        (run.branch, our[1] if run.tally is None else run.tally) for run, our in zip(recorded, ours, strict=False)
    ]


def _differs(recorded: Sequence[HandlerRun], entries: Sequence[Entry]) -> str | None:
    """What the protocol does otherwise than is on record, as far as anybody is affected by it."""
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


def same_sent(ours: Sequence[Sent], theirs: Sequence[Sent]) -> bool:
    """Whether the messages are the same; their sequence numbers mean nothing to the protocol."""
    if len(ours) != len(theirs):
        return False
    return all(_same_message(our, their) for our, their in zip(ours, theirs, strict=True))


def _same_message(ours: Sent, theirs: Sent) -> bool:
    if (ours.message, ours.block) != (theirs.message, theirs.block):
        return False
    try:
        return theirs.datagram is None or decoded(ours.datagram).message == decoded(theirs.datagram).message
    except MalformedDatagramError:
        return False
