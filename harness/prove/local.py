"""Local states by number, and what the real agent makes of each input: computed once, and then looked up.

A local state is all that `ucp.agent.Agent` holds (`snapshot.py`). To compute a step the agent is put into the state,
given the input, and its state is taken: no line of the protocol is written here. Every state that an agent comes to is
looked at once, when it gets its number.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from random import Random
from typing import Any, NamedTuple

from harness.prove.blocks import Blocks, Ordinals
from harness.prove.bounds import Bounds
from harness.prove.flaws import FLAWS_OF_STEPS, Flaw, flaw_of, is_deceived
from harness.prove.gate import Gate
from harness.prove.parts import NAMES_OF_OTHERS, Parts
from harness.prove.reference import Give, Reference
from harness.prove.snapshot import NOW_S, RUNNING_S, Snapshot, dead, put_back, take
from ucp.agent import HANDLERS, Agent
from ucp.block import Block
from ucp.clock import MICROSECONDS
from ucp.events import LoggableEvent
from ucp.handler import EventHandler
from ucp.messages import CARRY_A_BLOCK, Message
from ucp.quirks import wrong_handlers
from ucp.reconcile import most_named
from ucp.state import AgentState
from ucp.store import StoredState

INITIAL_DATA = b"proof"
AT_ONCE_S = 0.05
"""A timer that is shorter ends before any answer can come (a message takes 2 to 50 ms)."""
MOST_AT_ONCE = 100
DEAD = -1
"""The local state of an agent that is gone."""

FIRST, FIRST_OTHER = 1, 2
"""What an agent calls itself, and the first of the others, where it makes no difference who is who."""

Names = tuple[int, ...]
"""What an agent is to call the others, from `FIRST_OTHER` on."""
Started = tuple[tuple[int, int], ...]
"""Timers that an agent has started in this instant and that run: (number, duration in microseconds)."""


class Step(NamedTuple):
    """What an input makes of an agent: its state, the messages that it sends, the timers that it has started."""

    local: int
    sent: tuple[int, ...]
    started: Started


class End(NamedTuple):
    """What may come of it when a timer ends, and which of the candidates of phase 2 is the oldest then."""

    step: Step
    oldest: bytes | None


@dataclass(frozen=True, slots=True)
class Known:
    """A local state. `waits` says whether the agent reconciles, `chain` is the number of its chain.

    `deceived`: it holds a block in the captured vehicle's name which that never completed.
    """

    agent_id: int
    snapshot: Snapshot
    running: tuple[int, ...]
    idle: bool
    waits: bool
    chain: tuple[int, ...]
    flaw: Flaw | None
    anonymous: int
    """The same for states that differ only in who has voted and answered; the same number on any machine."""
    names_others: bool
    deceived: bool


WHAT_ONLY_CHECKS_READ: Snapshot = {"completed": [], "newest_block_timestamp_us": -1}
"""Parts of the state that no handler needs where nothing is ever lost, as they are at the beginning."""


Content = tuple[int, Snapshot, "Flaw | None", Ordinals]
TALLIES = frozenset((*NAMES_OF_OTHERS, "vote_count", "reconcile_vote_count", "reconcile_response_dictionary"))
"""Parts of the state in which answers are counted, and nothing else is done with them until a timer ends."""


class ReductionError(Exception):
    """The agent does what the argument for a reduction says that it never does."""


class LocalStates:
    """All local states that were come upon, and all steps between them.

    When `bounds.reduced`, what no handler will read before it is written anew is as at the beginning; docs/proof.md
    says why that is sound.
    """

    def __init__(self, bounds: Bounds, *, every_count: bool = False) -> None:
        self.bounds = bounds
        self._every_count = every_count
        self._alike = bounds.alike
        self.known: list[Known] = []
        self.flawed: set[int] = set()
        """Those that must never be."""
        self.steps = 0
        """How many the real agent has computed."""
        self._loaded: dict[int, Snapshot] = {}
        """In what state each of the real agents is, while that is known."""
        roster = range(1, bounds.agents + 1)
        settings = bounds.agent_settings()
        self.settings, self._roster = settings, roster
        self._gate = None if bounds.captured is None else Gate(roster, bounds.captured)
        self._others = tuple(range(FIRST_OTHER, bounds.agents + 1))
        self._agents = {agent_id: self._agent(agent_id) for agent_id in roster}
        self._revoked = {agent_id: self._agent(agent_id, revoked=True) for agent_id in roster if self._gate is not None}
        """Agents to whom the captured vehicle is revoked."""
        self._reference = Reference(self._agent) if bounds.steps else None
        self.timers = [timer.name for timer in self._agents[1].state.timers]
        durations = (
            settings.vote_timeout_s,
            settings.phase1_timeout_s,
            settings.phase2_timeout_s,
            settings.phase3_timeout_s,
            settings.finalize_gap_s,
        )
        self.durations_us = [round(duration * MICROSECONDS) for duration in durations]
        """By timer."""
        self._numbers: dict[tuple[Any, ...], int] = {}
        self._parts = Parts()
        self.completed: list[tuple[bytes, int, int]] = []
        """Hashes of completed blocks, as they were: of whom, by the agent's number here, and the how manieth it is."""
        self._blocks: dict[bytes, int] = {}
        """The same by hash: who made them."""
        self._named = Blocks(self._agents[1].state.chain.inception, self._made)
        self._about: dict[int, Ordinals] = {}
        self._patterns: dict[int, int] = {}
        self._of_pattern: dict[tuple[int, Ordinals], int] = {}
        self.messages: list[Message] = []
        self._message_numbers: dict[Message, int] = {}
        self._steps: dict[tuple[int, int, int], Step] = {}
        self._ends: dict[tuple[int, int], list[End]] = {}
        self._lets_be: dict[tuple[int, int, int], bool] = {}
        self._counts: dict[tuple[int, int, int], bool] = {}
        self._settled: dict[int, int] = {}
        self._renamed: dict[tuple[int, tuple[int, ...]], int] = {}
        self.initial = {agent_id: self._intern(agent, take(agent)) for agent_id, agent in self._agents.items()}

    def _agent(
        self, agent_id: int, right: bool = False, after_each: Callable[[], None] | None = None, *, revoked: bool = False
    ) -> Agent:
        """A new one; it traces its handler runs if `after_each` is to be called after each."""
        handlers = [] if right else wrong_handlers(self.bounds.quirks, Random(0))
        if after_each is not None:
            handlers = [_calling(handler, after_each) for handler in handlers or HANDLERS.values()]
        settings, tracing = self.bounds.agent_settings(agent_id), after_each is not None
        make = Agent if self._gate is None else partial(self._gate.agent, revoked=revoked)
        return make(agent_id, self._roster, INITIAL_DATA, settings, handlers=handlers, tracing=tracing)

    # Steps

    def hear(self, local: int, sender: int, message: int) -> Step:
        """The agent hears a message from another, who is `sender` to it."""
        key = local, sender, message
        step = self._steps.get(key)
        if step is None:
            names = self._in_order(local, sender)
            if names is None:
                heard = self.messages[message]
                step = self._computed(local, lambda agent: agent.receive_message(sender, 0, heard, NOW_S), hears=True)
            else:
                step = self.hear(self.renamed(local, names), names[sender - FIRST_OTHER], message)
                step = step._replace(local=self.renamed(step.local, _back(names)))
            self._steps[key] = step
        return step

    def _in_order(self, local: int, sender: int) -> Names | None:
        """Names by which the others are in order: those in tallies first, then the sender; None if they are.

        Where it makes no difference who is who, what an agent does is the same but for these names (docs/proof.md).
        """
        known = self.known[local]
        if not self._alike or known.agent_id != FIRST or known.flaw is not None:
            return None
        tallies = [known.snapshot[name] for name in NAMES_OF_OTHERS]
        in_order = sorted(
            range(FIRST_OTHER, self.bounds.agents + 1),
            key=lambda other: (*(other not in tally for tally in tallies), other != sender),
        )
        return None if tuple(in_order) == self._others else _back(tuple(in_order))

    def first_names(self, local: int, senders: Sequence[int]) -> Names | None:
        """Names by which those who are heard are the first of the others, in their order; None if they are.

        Or if they have other names to the agent, as it has heard of somebody before.
        """
        known = self.known[local]
        if not self._alike or known.agent_id != FIRST or known.names_others or known.flaw is not None:
            return None
        in_order = tuple(dict.fromkeys((*senders, *self._others)))
        return None if in_order == self._others else _back(in_order)

    def renamed_back(self, local: int, names: Names) -> int:
        """The agent that was `renamed` by these names as it was."""
        return self.renamed(local, _back(names))

    def lets_be(self, local: int, sender: int, message: int) -> bool:
        """Whether it makes no difference at all that the agent hears this."""
        if self._alike and not self.known[local].names_others:
            sender = FIRST_OTHER  # it is one to the agent who says it
        key = local, sender, message
        lets_be = self._lets_be.get(key)
        if lets_be is None:
            step = self.hear(local, sender, message)
            lets_be = self._lets_be[key] = step.local == local and not step.sent and not step.started
        return lets_be

    def only_counts(self, local: int, sender: int, message: int) -> bool:
        """Whether all that the agent does when it hears this is to count it, or to let it be."""
        key = local, sender, message
        counts = self._counts.get(key)
        if counts is None:
            step = self.hear(local, sender, message)
            before, after = self.known[local], self.known[step.local]
            counts = self._counts[key] = (
                not step.sent
                and not step.started
                and after.flaw is None
                and all(after.snapshot[name] is part or name in TALLIES for name, part in before.snapshot.items())
            )
        return counts

    def end_timer(self, local: int, timer: int, way: int = 0) -> Step:
        """A timer of the agent ends, in one of the `ends` that this may have."""
        return self.ends(local, timer)[way].step

    def ends(self, local: int, timer: int) -> list[End]:
        """All that may come of it when this timer ends: more than one only if the agent asks which block is older, and
        any may be."""
        key = local, timer
        ends = self._ends.get(key)
        if ends is None:
            oldest: list[bytes | None] = [None]
            if self.bounds.clocks_any and self.timers[timer] == "phase two":
                candidates = self.known[local].snapshot["reconcile_response_dictionary"]
                oldest = sorted(candidates, key=lambda candidate: candidates[candidate][1]) or oldest
            steps: dict[Step, bytes | None] = {}
            for candidate in oldest:
                steps.setdefault(self._computed(local, partial(_end, timer, candidate)), candidate)
            ends = self._ends[key] = [End(step, candidate) for step, candidate in steps.items()]
        return ends

    def older(self, local: int, timer: int, way: int) -> tuple[int, frozenset[int]]:
        """Which block has to be older than which for a timer to end in this way: 0 is the inception block's number.

        It is older than none where nothing is asked of it.
        """
        ends = self.ends(local, timer)
        oldest = ends[way].oldest
        if oldest is None or len(ends) == 1:
            return 0, frozenset()
        snapshot = self.known[local].snapshot
        top = [0, *self._named.named(snapshot["chain"].parts["top_chain_hash"])][-1]
        asked = {
            candidate: self._named.numbers[candidate] if candidate else top
            for candidate in snapshot["reconcile_response_dictionary"]
        }
        return asked[oldest], frozenset(asked.values()) - {asked[oldest]}

    # Blocks

    def pattern(self, local: int) -> int:
        """One local state for all that differ only in which block is which, where that makes no difference."""
        if not self.bounds.blocks_alike or local == DEAD:
            return local
        pattern = self._patterns.get(local)
        if pattern is None:
            pattern = self._patterns[local] = self._exchanged(local, tuple(range(1, len(self.about(local)) + 1)))
        return pattern

    def about(self, local: int) -> Ordinals:
        """The blocks that it is about, each once, in an order that is the same for all of one pattern."""
        about = self._about.get(local)
        if about is None:
            nothing = local == DEAD or self.known[local].flaw is not None
            about = self._about[local] = () if nothing else self._named.of(self.known[local].snapshot)
        return about

    def exchanged(self, local: int, blocks: Ordinals) -> int:
        """The same agent with these blocks in the place of those that it is `about`."""
        if blocks == self.about(local):
            return local
        key = self.pattern(local), blocks
        number = self._of_pattern.get(key)
        if number is None:
            number = self._of_pattern[key] = self._exchanged(local, blocks)
        return number

    def _exchanged(self, local: int, blocks: Ordinals) -> int:
        known, about = self.known[local], self.about(local)
        if blocks == about:
            return local
        agent = self._agents[known.agent_id]
        self._loaded.pop(known.agent_id, None)
        put_back(agent, self._named.exchanged(known.snapshot, dict(zip(about, blocks, strict=True))))
        return self._intern(agent, take(agent))

    def _made(self, ordinal: int) -> Block:
        """The block that an agent completes if it is the `ordinal`th of all."""
        agent = self._agent(FIRST)
        _log(agent, ordinal)
        if agent.state.current_block:
            raise ReductionError("an event is left over where a block is completed: try again with --whole")
        (block,) = agent.state.blocks_to_be_committed
        return block

    def complete(self, local: int, ordinal: int) -> Step:
        """The agent completes a block, the `ordinal`th of all."""
        key = local, -2, ordinal
        step = self._steps.get(key)
        if step is None:
            step = self._steps[key] = self._computed(local, lambda agent: _log(agent, ordinal), completes=ordinal)
        return step

    def reboot(self, local: int) -> Step:
        """The agent's computer browns out and goes on from what was on its disk."""
        key = local, -3, 0
        step = self._steps.get(key)
        if step is None:
            stored = StoredState.of(self._restored(local).state)
            step = self._steps[key] = self._computed(local, lambda agent: agent.boot(stored, NOW_S), boots=True)
        return step

    def lie(self, local: int, message: int) -> Step:
        """The agent hears a datagram that is sealed with the captured vehicle's keys, which the real gate opens."""
        key = local, -4, message
        step = self._steps.get(key)
        if step is None:
            flaw = self._got_in(local, message)
            step = self._steps[key] = self._computed(
                local, lambda agent: agent.receive_datagram(self._sealed(message), NOW_S), hears=True, flaw=flaw
            )
        return step

    def _got_in(self, local: int, message: int) -> Flaw | None:
        """What must not: the same of a vehicle known to be revoked, in another's name, or with another's block."""
        assert self._gate is not None, "a vehicle is captured"
        known, said = self.known[local], self.messages[message]
        revoked = self._revoked[known.agent_id]
        put_back(revoked, known.snapshot)
        if _is_heard(revoked, self._sealed(message), known.snapshot):
            return Flaw("revoked", f"a {said.NAME} of a vehicle that is known to be revoked is heard")
        for datagram in self._gate.forged(said, known.agent_id, NOW_S):
            agent = self._restored(local)
            if _is_heard(agent, datagram, known.snapshot):
                return Flaw("name", f"a {said.NAME} is heard that only another vehicle could have signed")
            self._loaded[known.agent_id] = known.snapshot
        return None

    def _sealed(self, message: int) -> bytes:
        """A new datagram of the captor's that says this."""
        assert self._gate is not None, "a vehicle is captured"
        said = self.messages[message]
        genuine = type(said) in CARRY_A_BLOCK and said.block.block_hash in self._blocks  # type: ignore[union-attr]
        return self._gate.sealed(said, NOW_S, genuine=genuine)

    def state(self, local: int) -> AgentState:
        """The whole of a local state, to look at before the next step is computed."""
        return self._restored(local).state

    def inputs(self) -> Iterator[tuple[int, Message | str | None, Step]]:
        """Each local state with each input that was given there: what was heard, the timer that ended; None: a block.

        And what came of it.
        """
        for (local, timer), ends in self._ends.items():
            yield from ((local, self.timers[timer], end.step) for end in ends)
        for (local, kind, number), step in self._steps.items():
            if kind != -3:
                yield local, None if kind == -2 else self.messages[number], step

    def _restored(self, local: int) -> Agent:
        known = self.known[local]
        agent = self._agents[known.agent_id]
        put_back(agent, known.snapshot, self._loaded.pop(known.agent_id, None))
        return agent

    def _computed(
        self,
        local: int,
        give: Give,
        *,
        hears: bool = False,
        boots: bool = False,
        completes: int | None = None,
        flaw: Flaw | None = None,
    ) -> Step:
        self.steps += 1
        before = self.known[local]
        agent = self._agent(before.agent_id) if boots else self._restored(local)
        completed = len(agent.state.completed)
        crashed = wrong = None
        try:
            give(agent)
        except Exception as error:  # whatever a handler raises is what we look for
            crashed = f"{type(error).__name__}: {error}"
        if completes is not None:
            self._has_completed(agent, completed, completes)
        if self._reference is not None:
            snapshot = None if boots else before.snapshot
            wrong = self._reference.deviation(agent, crashed, snapshot, give, self._block_in_words)
        if crashed is None:
            crashed = _end_at_once(agent)
        if crashed is not None:
            flaw = Flaw("crash", f"a handler ended by {crashed}")
        if wrong is not None:
            handler, sentence = wrong
            flaw = Flaw("steps", sentence, handler)
        sent = tuple(self.message(message) for _, message in agent.messages_to_send())
        started = tuple(
            (number, round((timer.deadline - NOW_S) * MICROSECONDS))
            for number, timer in enumerate(agent.state.timers)
            if timer.deadline is not None and timer.deadline < RUNNING_S
        )
        for number, _ in started:
            agent.state.timers[number].start(RUNNING_S, 0.0)
        after = take(agent, {} if boots else before.snapshot)
        if flaw is None and all(after[name] is part for name, part in before.snapshot.items()):
            self._loaded[before.agent_id] = after
            return Step(local, sent, started)
        if self.bounds.reduced:
            if hears and any(self.timers[timer] == "voting" for timer, _ in started):
                raise ReductionError("an agent begins a vote because of a message: try again with --whole")
            _check_that_nothing_is_lost(before.snapshot, agent.state)
        return Step(self._intern(agent, after, before, flaw, keep=not boots), sent, started)

    def _has_completed(self, agent: Agent, completed: int, ordinal: int) -> None:
        """The agent had `completed` blocks before; what it has completed now is the `ordinal`th of all."""
        self.note_completed((digest, agent.agent_id, ordinal) for digest in agent.state.completed[completed:])

    def completed_by(self, agent_id: int, ordinal: int) -> bytes:
        """The hash of the `ordinal`th block of all, which this agent has completed."""
        return next(made for made, maker, number in self.completed if (maker, number) == (agent_id, ordinal))

    def note_completed(self, blocks: Iterable[tuple[bytes, int, int]]) -> None:
        """These blocks were completed, here or in another process."""
        for block_hash, agent_id, ordinal in blocks:
            if block_hash not in self._blocks:
                self._blocks[block_hash] = agent_id
                self._named.numbers[block_hash] = ordinal
                self.completed.append((block_hash, agent_id, ordinal))

    def _block_in_words(self, block_hash: str) -> str:
        ordinal = self._named.numbers.get(bytes.fromhex(block_hash))
        return f"#{ordinal}" if ordinal else block_hash[:12]

    def message(self, message: Message) -> int:
        """Its number."""
        number = self._message_numbers.setdefault(message, len(self.messages))
        if number == len(self.messages):
            self.messages.append(message)
        return number

    def blocks_named(self, message: int) -> frozenset[int]:
        """Ordinals of the blocks that a message names, by themselves or as those of a chain."""
        fields = (getattr(self.messages[message], name) for name in self.messages[message].__slots__)
        hashes = [field.block_hash if isinstance(field, Block) else field for field in fields]
        return frozenset().union(*(self._named.named(digest) for digest in hashes if isinstance(digest, bytes)))

    # States

    def settled(self, local: int) -> int:
        """The same agent when all answers to what was asked have come, or are lost: who voted matters no more."""
        number = self._settled.get(local)
        if number is None:
            parts = {} if local == DEAD or local in self.flawed else self._tallies_settled(local)
            number = self._settled[local] = self._with(local, parts) if parts else local
            self._check_that_it_ends_alike(local, number)
        return number

    def _tallies_settled(self, local: int) -> Snapshot:
        """What is left of its tallies: no more than what they decide."""
        snapshot = self.known[local].snapshot
        parts: Snapshot = {}
        if snapshot["voting_timer"].active:
            count = snapshot["vote_count"]
            parts |= {"vote_count": {"yes": int(count["yes"] > count["no"]), "no": 0}, "voters": set()}
        if self._every_count:
            return parts
        if snapshot["voting_timer"].active:
            began_with = self._named.named(snapshot["top_chain_hash_at_initiation"])
            if len(self.known[local].chain) + len(snapshot["reconcile_stack"]) > len(began_with):
                parts["top_chain_hash_at_initiation"] = b""  # blocks stay: the chain will not be that one again
        if snapshot["phase_one_timer"].active:
            parts |= self._phase_1_decided(local)
        if snapshot["phase_two_timer"].active and not self.settings.top_needs_majority:
            parts |= self._phase_2_decided(local)
        return parts

    def _phase_1_decided(self, local: int) -> Snapshot:
        """What is left of the tally of phase 1, if it makes no difference what those say who have not answered yet."""
        snapshot, timer = self.known[local].snapshot, self.timers.index("phase one")
        yes, no = (snapshot["reconcile_vote_count"][answer] for answer in ("yes", "no"))
        silent = self._silent(snapshot)
        clear = {tally: self._ends_with(local, timer, *tally) for tally in ((1, 0), (0, 1))}
        ends = self._ends_with(local, timer, yes, no)
        at_last = [self._ends_with(local, timer, *tally) for tally in ((yes + silent, no), (yes, no + silent))]
        if not yes + no or at_last != [ends, ends]:
            return {}
        yes, no = next(tally for tally, as_clear in clear.items() if as_clear == ends)
        return {"reconcile_vote_count": {"yes": yes, "no": no}, "reconcile_responders": {*self._others}}

    def _ends_with(self, local: int, timer: int, yes: int, no: int) -> list[End]:
        return self.ends(self._with(local, {"reconcile_vote_count": {"yes": yes, "no": no}}), timer)

    def _phase_2_decided(self, local: int) -> Snapshot:
        """The same of phase 2, of which those candidates are left that most have named."""
        snapshot = self.known[local].snapshot
        candidates = snapshot["reconcile_response_dictionary"]
        most, next_most, *_ = sorted([*(count for count, _ in candidates.values()), 0, 0], reverse=True)
        silent = self._silent(snapshot)
        if silent and most - next_most <= silent:
            return {}
        left = {candidate: [1, candidates[candidate][1]] for candidate in most_named(candidates)}
        return {"reconcile_response_dictionary": left, "reconcile_responders": {*self._others}}

    def _silent(self, snapshot: Snapshot) -> int:
        """How many have not answered yet."""
        return self.bounds.agents - 1 - len(snapshot["reconcile_responders"])

    def _check_that_it_ends_alike(self, local: int, settled: int) -> None:
        """A timer has to make the same of an agent whose tallies are settled as it would have made of it."""
        if settled != local and any(
            {end.step._replace(local=self.settled(end.step.local)) for end in self.ends(local, timer)}
            != {end.step._replace(local=self.settled(end.step.local)) for end in self.ends(settled, timer)}
            for timer in self.known[local].running
        ):
            raise ReductionError("an agent asks more of a tally than it should: try again with --whole")

    def renamed(self, local: int, names: Names) -> int:
        """The same agent when the others are called otherwise."""
        if not self.known[local].names_others or self.known[local].flaw is not None:
            return local
        key = local, names
        number = self._renamed.get(key)
        if number is None:
            snapshot = self.known[local].snapshot
            new = dict(zip(self._others, names, strict=True))
            parts = {name: {new[other] for other in snapshot[name]} for name in NAMES_OF_OTHERS}
            number = self._renamed[key] = self._with(local, parts)
        return number

    def _names_others(self, snapshot: Snapshot) -> bool:
        """Whether it tells some of the others from the rest."""
        return any(0 < len(snapshot[name]) < len(self._others) for name in NAMES_OF_OTHERS)

    def _with(self, local: int, parts: Snapshot) -> int:
        """The same agent but for who is in its tallies."""
        known = self.known[local]
        snapshot = known.snapshot | {name: self._parts.part(name, value) for name, value in parts.items()}
        key = self._parts.key(known.agent_id, known.flaw, snapshot)
        number = self._numbers.setdefault(key, len(self.known))
        if number == len(self.known):
            anonymous = self._parts.anonymous(known.agent_id, known.flaw, snapshot)
            names_others = self._names_others(snapshot)
            self.known.append(replace(known, snapshot=snapshot, anonymous=anonymous, names_others=names_others))
        return number

    def _intern(
        self,
        agent: Agent,
        taken: Snapshot,
        before: Known | None = None,
        flaw: Flaw | None = None,
        *,
        keep: bool = True,
    ) -> int:
        """The number of the state that the agent is in, as it was `taken`; it was in `before`.

        `keep`: it will be given more inputs.
        """
        like = {} if before is None else before.snapshot
        snapshot = {
            name: value if like.get(name, self) is value else self._parts.part(name, value)
            for name, value in taken.items()
        }
        if keep:
            self._loaded[agent.agent_id] = snapshot
        if self.bounds.reduced:
            forgotten = WHAT_ONLY_CHECKS_READ | dead(agent.state)
            snapshot = snapshot | {
                name: self._parts.part(name, value) for name, value in forgotten.items() if snapshot[name] != value
            }
        key = self._parts.key(agent.agent_id, flaw, snapshot)
        number = self._numbers.setdefault(key, len(self.known))
        if number == len(self.known):
            state = agent.state
            self._named.learn_chain(state.chain)
            self.known.append(
                Known(
                    agent.agent_id,
                    snapshot,
                    tuple(index for index, timer in enumerate(state.timers) if timer.deadline is not None),
                    state.idle,
                    state.reconcile_in_progress,
                    tuple(self._parts.name(block.block_hash) for block in state.chain),
                    flaw or flaw_of(state, self._blocks, self.bounds.captured),
                    self._parts.anonymous(agent.agent_id, flaw, snapshot),
                    self._names_others(snapshot),
                    is_deceived(state, self._blocks, self.bounds.captured),
                )
            )
            if self.known[number].flaw is not None:
                self.flawed.add(number)
        return number

    def content(self, local: int) -> Content:
        """What another process needs to know of it."""
        known = self.known[local]
        flaw = known.flaw if known.flaw is not None and known.flaw.kind in FLAWS_OF_STEPS else None
        initiated = self._named.named(known.snapshot["top_chain_hash_at_initiation"])
        return known.agent_id, known.snapshot, flaw, initiated

    def adopt(self, content: Content) -> int:
        """The number of a state that another process has come upon."""
        agent_id, snapshot, flaw, initiated = content
        self._named.learn_chain_hash(snapshot["top_chain_hash_at_initiation"], initiated)
        agent = self._agents[agent_id]
        self._loaded.pop(agent_id, None)
        put_back(agent, snapshot)
        return self._intern(agent, take(agent), None, flaw)


def _check_that_nothing_is_lost(before: Snapshot, state: AgentState) -> None:
    """Blocks stay: without that the completed ones could not be forgotten (characteristic 2)."""
    held = {block.block_hash for name in ("blocks_to_be_committed", "reconcile_stack") for block in before[name]}
    held.update(before["chain"].parts["_block_of_hash"])
    if not all(state.holds(block_hash) for block_hash in held):
        raise ReductionError("a block that an agent held is gone: try again with --whole")


def _back(names: Names) -> Names:
    """The names by which everybody has the name again that he had."""
    before = {name: other for other, name in enumerate(names, FIRST_OTHER)}
    return tuple(before[name] for name in sorted(names))


def _is_heard(agent: Agent, datagram: bytes, before: Snapshot) -> bool:
    """Whether anything comes of a datagram that the agent is given in this state: it should drop it."""
    dropped = agent.dropped.total()
    agent.receive_datagram(datagram, NOW_S)
    unchanged = all(value is before[name] for name, value in take(agent, before).items())
    return not (unchanged and agent.dropped.total() == dropped + 1 and not vars(agent.state)["outbox"])


def _calling(handler: EventHandler[Any], after: Callable[[], None]) -> EventHandler[Any]:
    """The handler, after which `after` is called."""

    def run(*inputs: Any) -> str:
        branch = handler.run(*inputs)
        after()
        return branch

    return replace(handler, run=run)


def _end(timer: int, oldest: bytes | None, agent: Agent) -> None:
    """End a timer; of the candidates of phase 2 this one is the oldest, unless it is the inception block."""
    if oldest is not None:
        counted = agent.state.reconcile_response_dictionary[oldest]
        counted[1] = min(counted[1], 1)
    agent.end_timer(agent.state.timers[timer], NOW_S)


def _log(agent: Agent, ordinal: int) -> None:
    """Log events until a block is complete: the `ordinal`th of all."""
    completed = len(agent.state.completed)
    for number in range(MOST_AT_ONCE):
        if len(agent.state.completed) > completed:
            return
        agent.add_event(LoggableEvent(ordinal * MICROSECONDS + number, 1, bytes(256)), NOW_S)


def _end_at_once(agent: Agent) -> str | None:
    """End the timers that end before anything can be heard; what a handler raised, if one did."""
    try:
        for _ in range(MOST_AT_ONCE):
            soon = [t for t in agent.state.timers if t.deadline is not None and t.deadline <= NOW_S + AT_ONCE_S]
            if not soon:
                return None
            agent.end_timer(min(soon, key=lambda timer: timer.deadline or 0.0), NOW_S)
    except Exception as error:  # whatever a handler raises is what we look for
        return f"{type(error).__name__}: {error}"
    return "its timers end at once again and again"
