"""Scripted fates of single messages, and timers that expire late."""

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
"""A block's name from its hash, if it is known."""


@dataclass(slots=True, eq=False)
class _Part:
    """One fate and what it has come to: messages that fit it, and deliveries that it decided.

    `arrivals` are the mission seconds at which the sender's datagrams arrive that have not been sent yet, by number.
    While it `holds`, nobody knows yet until when.
    """

    index: int
    fate: Fate
    fitting: int = 0
    decided: int = 0
    arrivals: dict[int, list[float]] = field(default_factory=dict)
    holds: bool = False

    def __post_init__(self) -> None:
        for number, at_s in parse_pairs(self.fate.arrivals or ""):
            self.arrivals.setdefault(number, []).append(at_s)


@dataclass(slots=True)
class Decided:
    """When copies of a message arrive at whom, as far as that is known yet, in mission seconds."""

    arrivals: list[tuple[int, float]] = field(default_factory=list)
    waiting: list[tuple[int, str]] = field(default_factory=list)
    """(receiver, name): to arrive after the message that the fate with this name is about."""
    held: list[tuple[int, int, float]] = field(default_factory=list)
    """(number, receiver, time): to arrive then, or when the hold with this number is over if that is later."""
    named: list[tuple[str, float]] = field(default_factory=list)
    """(name, time): when the message arrives that the fate with this name is about."""


class FateScript:
    """Fates for `roster`; receivers are numbered in its order. `name_of` gives a block's name from its hash."""

    def __init__(self, fates: Sequence[Fate], roster: Sequence[int], name_of: NameOf) -> None:
        self.listens = bool(fates)
        """Whether `decide` is to be asked at all."""
        self.last_s: float | None = None
        """When the last message was sent that did not go as chance would have it."""
        self._parts = [_Part(index, fate) for index, fate in enumerate(fates)]
        self._number = {agent_id: number for number, agent_id in enumerate(roster)}
        self._name_of = name_of
        self._about: dict[tuple[str | None, int | None], list[_Part]] = defaultdict(list)
        for part in self._parts:
            self._about[part.fate.message, part.fate.sender].append(part)

    def hold(self, fate: Fate) -> int:
        """From now on this fate is the last in the list, and holds back what fits it; its number."""
        part = _Part(len(self._parts), fate.model_copy(update={"until_s": None}), holds=True)
        self._parts.append(part)
        self._about[fate.message, fate.sender].append(part)
        self.listens = True
        return part.index

    def release(self, number: int, fate: Fate) -> None:
        """The hold with this number lasts as long as `fate` says."""
        part = self._parts[number]
        part.fate, part.holds = fate, False

    def decide(
        self, now: float, sender: int, message: Message, lots: RandomDraws, hears: Callable[[int], bool]
    ) -> Decided | None:
        """What becomes of a message that agent `sender` broadcasts; None if no fate is about it."""
        parts = [part for part in self._fitting(now, sender, message) if self._picks(part)]
        if not parts:
            return None
        decided = Decided()
        by_chance = lots.to_all()
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
                arrivals = [max(now, at) for at in part.arrivals.pop(part.fitting - 1, ())]
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

    def standing(self, now: float) -> tuple[int, ...] | None:
        """How far each fate has counted, as far as that still matters; None while the time of one is to come."""
        if any(part.arrivals or part.holds for part in self._parts):
            return None
        times = (time for part in self._parts for time in (part.fate.from_s, part.fate.until_s, part.fate.hold_until_s))
        if any(time is not None and time > now for time in times):
            return None
        return tuple(min(part.fitting, max(part.fate.counts or (0,))) for part in self._parts)

    def unmatched(self, waiting: Collection[str]) -> list[str]:
        """A sentence for each fate that came to nothing: whoever wrote it believes that it did something.

        `waiting`: names of fates whose message others still wait for.
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

    def _fitting(self, now: float, sender: int, message: Message) -> Iterator[_Part]:
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

    def _picks(self, part: _Part) -> bool:
        """Count the message that fits; whether the fate is about this one."""
        part.fitting += 1
        counts = part.fate.counts
        return counts is None or part.fitting in counts


class Running(NamedTuple):
    """A timer that runs: the `number`th, from 0, that the agent has started, and when it ends by the agent's clock."""

    name: str
    number: int
    deadline: float


class LateTimers:
    """Those of one agent, through all of its lives. `text` is as in a scenario."""

    def __init__(self, text: str = "") -> None:
        self.running: dict[str, Running] = {}
        """By name."""
        self._late_by_s = dict(parse_pairs(text))
        self._started = 0

    def look(self, state: AgentState) -> None:
        """See which timers run after an input; of several that it has started the one that `timers` names first."""
        for timer in state.timers:
            known, deadline = self.running.get(timer.name), timer.deadline
            if deadline is None:
                self.running.pop(timer.name, None)
            elif known is None or known.deadline != deadline:
                self.running[timer.name] = Running(timer.name, self._started, deadline)
                self._started += 1

    @property
    def all_have_ended(self) -> bool:
        """Whether none of those that are told to be late runs or is to come: from now on all end when they should."""
        late = self._late_by_s.keys()
        running = {timer.number for timer in self.running.values()}
        return self._started > max(late, default=-1) and running.isdisjoint(late)

    def next(self, at: Callable[[float], float]) -> tuple[float, Running] | None:
        """When which ends next, in mission seconds; `at` is when the agent's clock shows something."""
        ends = ((at(timer.deadline) + self._late_by_s.get(timer.number, 0.0), timer) for timer in self.running.values())
        return min(ends, default=None, key=lambda end: (end[0], end[1].deadline))
