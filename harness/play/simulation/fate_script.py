"""Apply scripted rules that decide the delivery of single messages, and delay the expiry of single timers."""

from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from harness.scenario.fates import Fate
from harness.scenario.strict_model import parse_pairs
from netem.medium import RandomDraws
from ucp.messages import Message, block_named
from ucp.state import AgentState

RIGHT_AFTER_S = 1e-6

NameOf = Callable[[bytes], str | None]
"""A function that returns the name of the block with a given hash, or None if the block has no name."""


@dataclass(slots=True, eq=False)
class _ScriptedFate:
    """A rule of the scenario that decides how single messages are delivered. `matches` is the number of messages that
    the rule matched, and `decided` the number of deliveries that it decided.
    """

    index: int
    fate: Fate
    matches: int = 0
    decided: int = 0
    arrivals: dict[int, list[float]] = field(default_factory=dict)
    """Number of a datagram -> the mission seconds at which its copies arrive. The datagrams that the rule matches are
    numbered from 0. Datagrams that were already sent are removed.
    """
    holds: bool = False
    """True while the rule holds messages back without a known end."""

    def __post_init__(self) -> None:
        for number, at_s in parse_pairs(self.fate.arrivals or ""):
            self.arrivals.setdefault(number, []).append(at_s)


@dataclass(slots=True)
class DecidedDelivery:
    """The arrival times of the copies of one message, as scripted rules decided them. Times are mission seconds.
    Receivers are identified by numbers.
    """

    arrivals: list[tuple[int, float]] = field(default_factory=list)
    """Pairs (receiver, time). The copy for the receiver arrives at this time."""
    waiting: list[tuple[int, str]] = field(default_factory=list)
    """Pairs (receiver, name). The copy for the receiver arrives directly after the message that the rule with this name
    matches.
    """
    held: list[tuple[int, int, float]] = field(default_factory=list)
    """Triples (number, receiver, time). The copy for the receiver arrives at this time. If the hold with this number
    ends later, the copy arrives at the end of the hold.
    """
    named: list[tuple[str, float]] = field(default_factory=list)
    """Pairs (name, time). The message that the rule with this name matches arrives at this time."""


class FateScript:
    """The scripted delivery rules (fates) of a run. `name_of` is a function that returns the name of a block from its
    hash. Receivers are numbered by their index in `roster`.
    """

    def __init__(self, fates: Sequence[Fate], roster: Sequence[int], name_of: NameOf) -> None:
        self.listens = bool(fates)
        """True if there are rules. If it is false, the caller need not call `decide`."""
        self.last_s: float | None = None
        """The time at which a rule last changed the delivery of a message."""
        self._parts = [_ScriptedFate(index, fate) for index, fate in enumerate(fates)]
        self._number = {agent_id: number for number, agent_id in enumerate(roster)}
        self._name_of = name_of
        self._about: dict[tuple[str | None, int | None], list[_ScriptedFate]] = defaultdict(list)
        for part in self._parts:
            self._about[part.fate.message, part.fate.sender].append(part)

    def hold(self, fate: Fate) -> int:
        """Add a rule that holds back all matching messages that are sent from now on. Return the number of the rule."""
        part = _ScriptedFate(len(self._parts), fate.model_copy(update={"until_s": None}), holds=True)
        self._parts.append(part)
        self._about[fate.message, fate.sender].append(part)
        self.listens = True
        return part.index

    def release(self, number: int, fate: Fate) -> None:
        """End the hold (a rule that delays messages) with this number. `fate` contains the times at which the hold
        ends.
        """
        part = self._parts[number]
        part.fate, part.holds = fate, False

    def decide(
        self, now: float, sender: int, message: Message, draws: RandomDraws, hears: Callable[[int], bool]
    ) -> DecidedDelivery | None:
        """Return the delivery of a message of agent `sender`. Return None if no rule matches the message."""
        parts = [part for part in self._matching(now, sender, message) if self._count_match(part)]
        if not parts:
            return None
        decided = DecidedDelivery()
        by_chance = draws.to_all()
        for agent_id, receiver in self._number.items():
            if agent_id == sender:
                continue
            arrivals = [now + delay for reached, delay in by_chance if reached == receiver]
            part = next((part for part in parts if part.fate.receiver in (None, agent_id)), None)
            if part is None:
                decided.arrivals += [(receiver, at) for at in arrivals]
                continue
            part.decided += 1
            if not hears(receiver):
                continue
            fate = part.fate
            if part.holds or not fate.left_to_chance:
                self.last_s = now
            if part.holds:
                decided.held += [(part.index, receiver, at) for at in arrivals]
                continue
            if fate.after is not None:
                decided.waiting.append((receiver, fate.after))
                continue
            if fate.arrivals is not None:
                arrivals = [max(now, at) for at in part.arrivals.pop(part.matches - 1, ())]
            elif fate.drop:
                arrivals = []
            elif fate.delay_s is not None:
                arrivals = [now + fate.delay_s]
            elif fate.hold_until_s is not None:
                arrivals = [max(at, fate.hold_until_s) for at in arrivals]
            decided.arrivals += [(receiver, at) for at in arrivals]
            if fate.name is not None and arrivals:
                decided.named.append((fate.name, arrivals[0]))
        return decided

    def settled_counts(self, now: float) -> tuple[int, ...] | None:
        """Return the number of messages that each rule has matched. A number does not increase any further after the
        last message that the rule can affect. The numbers of a swarm in a cycle therefore become constant.

        Return None if the effect of a rule still depends on time.
        """
        if any(part.arrivals or part.holds for part in self._parts):
            return None
        times = (time for part in self._parts for time in (part.fate.from_s, part.fate.until_s, part.fate.hold_until_s))
        if any(time is not None and time > now for time in times):
            return None
        return tuple(min(part.matches, max(part.fate.counts or (0,))) for part in self._parts)

    def unmatched(self, waiting: Collection[str]) -> list[str]:
        """Return a sentence for each rule that had no effect, or only a part of the expected effect. A rule can delay
        its messages until the message of another, named rule arrives. `waiting` contains the names of rules whose
        message never arrived, although other messages still wait for it.
        """
        sentences = []
        for part in self._parts:
            fate = f"fates.{part.index} ({part.fate.describe()})"
            if not part.decided:
                sentences.append(f"{fate} matched no message")
            elif part.arrivals:
                numbers = f"{len(part.arrivals)} of its datagrams, the first number {min(part.arrivals)}"
                sentences.append(f"{fate}: {numbers}, never left")
            elif part.fate.after in waiting:
                sentences.append(f"{fate}: the message that {part.fate.after!r} is about never arrived")
        return sentences

    def _matching(self, now: float, sender: int, message: Message) -> Iterator[_ScriptedFate]:
        keys = ((message.NAME, sender), (message.NAME, None), (None, sender), (None, None))
        parts = [part for key in keys for part in self._about.get(key, ())]
        if not parts:
            return
        block_hash = block_named(message)
        block = self._name_of(block_hash) if block_hash else None
        for part in sorted(parts, key=lambda part: part.index):
            fate = part.fate
            early = fate.from_s is not None and now < fate.from_s
            late = fate.until_s is not None and now >= fate.until_s
            if not early and not late and (fate.block is None or fate.block == block):
                yield part

    def _count_match(self, part: _ScriptedFate) -> bool:
        """Increase the number of messages that the rule has matched. Return true if the rule applies to the message
        with this number.
        """
        part.matches += 1
        counts = part.fate.counts
        return counts is None or part.matches in counts


class RunningTimer(NamedTuple):
    """A running timer of an agent. All timers that the agent starts are numbered, from 0."""

    name: str
    number: int
    """Number of timers that the agent started before this timer."""
    deadline: float
    """Time on the agent's clock at which the timer expires."""


class LateTimers:
    """The timers of one agent, some of which expire late. The timers are counted across restarts of the agent. `text`
    is the agent's value of the scenario key `lateness`.
    """

    def __init__(self, text: str = "") -> None:
        self.running: dict[str, RunningTimer] = {}
        """The running timers of the agent, by name."""
        self._late_by_s = dict(parse_pairs(text))
        self._started = 0

    def update(self, state: AgentState) -> None:
        """Update the list of running timers after an input. New timers are numbered in the order of `state.timers`."""
        for timer in state.timers:
            known, deadline = self.running.get(timer.name), timer.deadline
            if deadline is None:
                self.running.pop(timer.name, None)
            elif known is None or known.deadline != deadline:
                self.running[timer.name] = RunningTimer(timer.name, self._started, deadline)
                self._started += 1

    @property
    def late_ones_have_ended(self) -> bool:
        """True if all timers that the scenario delays have expired. After this, all timers expire on time."""
        late = self._late_by_s.keys()
        running = {timer.number for timer in self.running.values()}
        return self._started > max(late, default=-1) and running.isdisjoint(late)

    def next(self, at: Callable[[float], float]) -> tuple[float, RunningTimer] | None:
        """Return the mission second of the next timer expiry, and the timer. Return None if no timer runs. `at`
        converts a time on the agent's clock to mission seconds.
        """
        ends = ((at(timer.deadline) + self._late_by_s.get(timer.number, 0.0), timer) for timer in self.running.values())
        return min(ends, default=None, key=lambda end: (end[0], end[1].deadline))
