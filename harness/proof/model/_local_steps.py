"""Compute and cache the step that the real agent takes for each of its states and each input.

To compute a step, the module sets the agent to the state, gives it the input, and takes a snapshot of the new state.
This module contains no protocol logic.
"""

from collections.abc import Iterator
from contextlib import suppress
from functools import partial

from harness.proof.bounds import Bounds
from harness.proof.model._block_renaming import NumberedBlocks, Ordinals
from harness.proof.model._flaws import FLAWS_OF_STEPS, PropertyViolation
from harness.proof.model._known_states import DEAD, FIRST, FIRST_OTHER, KnownStates
from harness.proof.model._real_agents import RealAgents, end_at_once, end_timer, is_heard, log
from harness.proof.model._reference_step import Give, ReferenceComparison
from harness.proof.model._snapshot import (
    NOW_S,
    RUNNING_S,
    AgentStep,
    ReductionError,
    Snapshot,
    Started,
    TimerResult,
    UncoveredError,
    check_that_nothing_is_lost,
    put_back,
    reverse_dictionaries,
    set_counts,
    take,
)
from harness.proof.model._tallies import TALLIES, VoteCounts
from ucp.agent import Agent
from ucp.clock import MICROSECONDS
from ucp.messages import CARRY_A_BLOCK, Message
from ucp.state import AgentState
from ucp.store import StoredState

Content = tuple[int, Snapshot, "PropertyViolation | None", Ordinals]
"""The definition of a local state in the form in which processes send it to each other."""


OTHER_COUNTS = ((1, 0.0), (2, 60.0), (1000, 10_000.0))
"""Pairs of a counter value and a mission second. The prover repeats each step with each pair, to show that counters and
time have no effect. It does so only in proofs without merged states.
"""
COUNTED = ("reconciles", "sent", "chain_changed_at")
"""Attributes of the state that only count events, each with its name in error messages."""


class LocalStates(KnownStates):
    """The known states of single agents, and the steps between them."""

    def __init__(self, bounds: Bounds, *, every_count: bool = False) -> None:
        self.agents = RealAgents(bounds)
        first = self.agents.by_id[FIRST].state
        super().__init__(bounds, NumberedBlocks(first.chain.inception, self.agents.made))
        self.steps = 0
        """Number of steps that the real agent has computed."""
        self._counting = {agent_id: self.agents.new(agent_id) for agent_id in self.agents.by_id}
        """Agents that repeat steps with other values of the counters."""
        self._reference = ReferenceComparison(bounds, self.agents.new) if bounds.steps else None
        self.timers = [timer.name for timer in first.timers]
        self.settings = settings = bounds.agent_settings()
        durations = (
            settings.vote_timeout_s,
            settings.phase1_timeout_s,
            settings.phase2_timeout_s,
            settings.phase3_timeout_s,
            settings.finalize_gap_s,
        )
        self.durations_us = [round(duration * MICROSECONDS) for duration in durations]
        """The duration of each timer in microseconds."""
        self._tallies = VoteCounts(self, self.timers, self.ends, every_count=every_count)
        self._about: dict[int, Ordinals] = {}
        self._patterns: dict[int, int] = {}
        self._of_pattern: dict[tuple[int, Ordinals], int] = {}
        self.messages: list[Message] = []
        self._message_numbers: dict[Message, int] = {}
        self._steps: dict[tuple[int, int, int], AgentStep] = {}
        self._ends: dict[tuple[int, int], list[TimerResult]] = {}
        self._lets_be: dict[tuple[int, int, int], bool] = {}
        self._counts: dict[tuple[int, int, int], bool] = {}
        self.initial = {
            agent_id: self._intern(agent_id, agent, take(agent)) for agent_id, agent in self.agents.by_id.items()
        }

    # Steps

    def hear(self, local: int, sender: int, message: int) -> AgentStep:
        """Return the step of an agent that receives a message. `sender` is the ID that the agent uses for the sender of
        the message.
        """
        key = local, sender, message
        step = self._steps.get(key)
        if step is None:
            names = self.names_in_order(local, sender)
            if names is None:
                heard = self.messages[message]
                step = self._computed(
                    local, lambda agent: agent.receive_message(sender, 0, heard, agent.state.now), hears=True
                )
            else:
                step = self.hear(self.renamed(local, names), names[sender - FIRST_OTHER], message)
                step = step._replace(local=self.renamed_back(step.local, names))
            self._steps[key] = step
        return step

    def lets_be(self, local: int, sender: int, message: int) -> bool:
        """Return true if the message has no effect on the agent in this state."""
        if self._nameless and not self.known[local].names_others:
            sender = FIRST_OTHER  # it is one to the agent who says it
        key = local, sender, message
        lets_be = self._lets_be.get(key)
        if lets_be is None:
            step = self.hear(local, sender, message)
            lets_be = self._lets_be[key] = step.local == local and not step.sent and not step.started
        return lets_be

    def only_counts(self, local: int, sender: int, message: int) -> bool:
        """Return true if the agent ignores the message, or only counts it."""
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

    def end_timer(self, local: int, timer: int, result: int = 0) -> AgentStep:
        """Return the step of an agent whose timer expires. If several results are possible, `result` selects one."""
        return self.ends(local, timer)[result].step

    def ends(self, local: int, timer: int) -> list[TimerResult]:
        """Return the possible results when a timer expires. There are several results only if the agent compares the
        ages of blocks and each of these blocks may be the oldest.
        """
        key = local, timer
        ends = self._ends.get(key)
        if ends is None:
            oldest: list[bytes | None] = [None]
            if self.bounds.clocks_any and self.timers[timer] == "phase two":
                candidates = self.known[local].snapshot["reconcile_response_dictionary"]
                oldest = sorted(candidates, key=lambda candidate: candidates[candidate][1]) or oldest
            steps: dict[AgentStep, bytes | None] = {}
            for candidate in oldest:
                steps.setdefault(self._computed(local, partial(end_timer, timer, candidate)), candidate)
            ends = self._ends[key] = [TimerResult(step, candidate) for step, candidate in steps.items()]
        return ends

    def older(self, local: int, timer: int, result: int) -> tuple[int, frozenset[int]]:
        """Return the block ages that this result of a timer expiry requires: the candidate block that must be the
        oldest, and the candidates that must be newer. Block 0 is the inception block. The set of newer candidates is
        empty if the agent does not compare ages.
        """
        ends = self.ends(local, timer)
        oldest = ends[result].oldest
        if oldest is None or len(ends) == 1:
            return 0, frozenset()
        snapshot = self.known[local].snapshot
        top = [0, *self.blocks.named(snapshot["chain"].parts["top_chain_hash"])][-1]
        asked = {
            candidate: self.blocks.numbers[candidate] if candidate else top
            for candidate in snapshot["reconcile_response_dictionary"]
        }
        return asked[oldest], frozenset(asked.values()) - {asked[oldest]}

    def complete(self, local: int, ordinal: int) -> AgentStep:
        """Return the step of an agent that completes the block with this number."""
        key = local, -2, ordinal
        step = self._steps.get(key)
        if step is None:
            step = self._steps[key] = self._computed(local, lambda agent: log(agent, ordinal), completes=ordinal)
        return step

    def reboot(self, local: int) -> AgentStep:
        """Return the step of an agent that loses power and restarts from its disk."""
        key = local, -3, 0
        step = self._steps.get(key)
        if step is None:
            stored = StoredState.of(self._restored(local).state)
            step = self._steps[key] = self._computed(local, lambda agent: agent.boot(stored, NOW_S), boots=True)
        return step

    def lie(self, local: int, message: int) -> AgentStep:
        """Return the step of an agent that receives an encrypted datagram from the attacker."""
        key = local, -4, message
        step = self._steps.get(key)
        if step is None:
            flaw = self._wrongly_accepted(local, message)
            captured, said = self.bounds.captured, self.messages[message]
            step = self._steps[key] = self._computed(
                local,
                lambda agent: agent.receive_datagram(self._sealed(message), NOW_S),
                hears=True,
                flaw=flaw,
                to_reference=lambda reference: reference.receive_message(captured, 0, said, NOW_S),
            )
        return step

    def _wrongly_accepted(self, local: int, message: int) -> PropertyViolation | None:
        """Return a violation if the agent accepts a message of the attacker that it must reject. These are messages of
        a revoked vehicle, messages in the name of a third vehicle, and blocks in the receiver's own name. Return None
        if the agent rejects the message.
        """
        known, said = self.known[local], self.messages[message]
        revoked = self.agents.revoked[known.agent_id]
        put_back(revoked, known.snapshot)
        if is_heard(revoked, self._sealed(message), known.snapshot):
            return PropertyViolation("revoked", f"a {said.NAME} of a vehicle whose revocation is known is accepted")
        for datagram in self.agents.gate.forged(said, known.agent_id, NOW_S):
            agent = self._restored(local)
            if is_heard(agent, datagram, known.snapshot):
                return PropertyViolation("name", f"a {said.NAME} is accepted that only another vehicle could sign")
            self.agents.leave_in(known.agent_id, known.snapshot)
        return None

    def _sealed(self, message: int) -> bytes:
        """Return a new encrypted datagram of the attacker with this message."""
        said = self.messages[message]
        genuine = type(said) in CARRY_A_BLOCK and said.block.block_hash in self.blocks.makers  # type: ignore[union-attr]
        return self.agents.gate.sealed(said, NOW_S, genuine=genuine)

    def state(self, local: int) -> AgentState:
        """Return the agent's data in this state. The returned object changes when the next step is computed."""
        return self._restored(local).state

    def inputs(self) -> Iterator[tuple[int, Message | str | None, AgentStep]]:
        """Yield each known state with each input that was tried in it, and the step that the input caused.

        The input is a received message, the name of an expired timer, or None for a completed block.
        """
        for (local, timer), ends in self._ends.items():
            yield from ((local, self.timers[timer], end.step) for end in ends)
        for (local, kind, number), step in self._steps.items():
            if kind != -3:
                yield local, None if kind == -2 else self.messages[number], step

    def _restored(self, local: int) -> Agent:
        known = self.known[local]
        return self.agents.put_into(known.agent_id, known.snapshot)

    def _computed(
        self,
        local: int,
        give: Give,
        *,
        hears: bool = False,
        boots: bool = False,
        completes: int | None = None,
        flaw: PropertyViolation | None = None,
        to_reference: Give | None = None,
    ) -> AgentStep:
        """Compute the step of an agent. The function `give` gives the input to the agent.

        The function `to_reference` gives the same input, in decrypted form, to the reference implementation.
        """
        self.steps += 1
        before = self.known[local]
        agent = self.agents.new(before.agent_id) if boots else self._restored(local)
        completed = len(agent.state.completed)
        crashed = wrong = None
        try:
            give(agent)
        except Exception as error:  # any exception of a handler is a flaw
            crashed = f"{type(error).__name__}: {error}"
        if completes is not None:
            made = agent.state.completed[completed:]
            self.blocks.note_completed((digest, agent.agent_id, completes) for digest in made)
        if self._reference is not None:
            snapshot = None if boots else before.snapshot
            wrong = self._reference.deviation(
                before.agent_id, agent, crashed, snapshot, give, to_reference or give, self.blocks.in_words
            )
        if crashed is None:
            crashed = end_at_once(agent)
        if crashed is not None:
            flaw = PropertyViolation("crash", f"a handler ended by {crashed}")
        if wrong is not None:
            handler, sentence = wrong
            flaw = PropertyViolation("steps", sentence, handler)
        sent, started = self._results(agent)
        after = take(agent, {} if boots else before.snapshot)
        if not (self.bounds.reduced or boots or self.bounds.captured):
            self._check_counts(before.agent_id, before.snapshot, give, after, (sent, started))
        if flaw is None and all(after[name] is part for name, part in before.snapshot.items()):
            self.agents.leave_in(before.agent_id, after)
            return AgentStep(local, sent, started)
        if self.bounds.reduced:
            if hears and any(self.timers[timer] == "voting" for timer, _ in started):
                raise ReductionError("an agent starts a vote because of a message: try again with --whole")
            check_that_nothing_is_lost(before.snapshot, agent.state)
        local = self._intern(before.agent_id, agent, after, before.snapshot, flaw, keep=not boots)
        return AgentStep(local, sent, started)

    def _results(self, agent: Agent) -> tuple[tuple[int, ...], Started]:
        """Return the messages that the agent sent in a step, and the timers that it started. The messages are removed
        from the agent, and the timers continue.
        """
        sent = tuple(self.message(message) for _, message in agent.messages_to_send())
        started = tuple(
            (number, round((timer.deadline - agent.state.now) * MICROSECONDS))
            for number, timer in enumerate(agent.state.timers)
            if timer.deadline is not None and timer.deadline < RUNNING_S
        )
        for number, _ in started:
            agent.state.timers[number].start(RUNNING_S, 0.0)
        return sent, started

    def _check_counts(
        self, agent_id: int, before: Snapshot, give: Give, after: Snapshot, results: tuple[tuple[int, ...], Started]
    ) -> None:
        """Repeat the step with other counters and another time. Raise UncoveredError if the step depends on the time,
        on the number of earlier reconciles or messages, or on the order of dictionaries.
        """
        for count, now_s in OTHER_COUNTS:
            agent = self._counting[agent_id]
            put_back(agent, before)
            set_counts(agent, count, now_s)
            reverse_dictionaries(agent)
            with suppress(Exception):  # the step itself reports an exception
                give(agent)
                end_at_once(agent)
            if self._results(agent) != results or take(agent, after).items() != after.items():
                raise UncoveredError(
                    "a step of an agent depends on the mission time, on the order of a dictionary, or on a counter "
                    f"({', '.join(COUNTED)}), but the states of the proof do not have these values: keep the input of "
                    "the step in another attribute of the agent"
                )

    def message(self, message: Message) -> int:
        """Return the number that stands for this message."""
        number = self._message_numbers.setdefault(message, len(self.messages))
        if number == len(self.messages):
            self.messages.append(message)
        return number

    # Blocks

    def pattern(self, local: int) -> int:
        """Return the number of the state in which blocks 1, 2, ... replace the agent's blocks. All states that differ
        only in their blocks have the same result.
        """
        if not self.bounds.blocks_alike or local == DEAD:
            return local
        pattern = self._patterns.get(local)
        if pattern is None:
            pattern = self._patterns[local] = self._exchanged(local, tuple(range(1, len(self.about(local)) + 1)))
        return pattern

    def about(self, local: int) -> Ordinals:
        """Return the numbers of the blocks that occur in a state, without repetition. If two states differ only in
        their blocks, corresponding blocks are at the same position in both results.
        """
        about = self._about.get(local)
        if about is None:
            nothing = local == DEAD or self.known[local].flaw is not None
            about = self._about[local] = () if nothing else self.blocks.of(self.known[local].snapshot)
        return about

    def exchanged(self, local: int, blocks: Ordinals) -> int:
        """Return the state with these blocks in place of the blocks that `about` returns."""
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
        exchanged = self.blocks.exchanged(known.snapshot, dict(zip(about, blocks, strict=True)))
        agent = self.agents.put_into(known.agent_id, exchanged)
        return self._intern(known.agent_id, agent, take(agent))

    # States

    def settled(self, local: int) -> int:
        """Return the state with simplified vote counts. This is correct when all answers have arrived or are lost."""
        return self._tallies.settled(local)

    def _intern(
        self,
        agent_id: int,
        agent: Agent,
        taken: Snapshot,
        before: Snapshot | None = None,
        flaw: PropertyViolation | None = None,
        *,
        keep: bool = True,
    ) -> int:
        """Store an agent's state and return its number. `taken` is the snapshot of the state, and `before` is the
        snapshot before the step. If `keep` is true, the agent will receive further inputs in this state.
        """
        snapshot = self._parts.of(taken, before or {})
        if keep:
            self.agents.leave_in(agent_id, snapshot)
        return self.number(agent_id, agent.state, snapshot, flaw)

    def content(self, local: int) -> Content:
        """Return the definition of a state in a form that another process can read."""
        known = self.known[local]
        flaw = known.flaw if known.flaw is not None and known.flaw.kind in FLAWS_OF_STEPS else None
        initiated = self.blocks.named(known.snapshot["top_chain_hash_at_initiation"])
        return known.agent_id, known.snapshot, flaw, initiated

    def adopt(self, content: Content) -> int:
        """Return this process's number for a state that another process found."""
        agent_id, snapshot, flaw, initiated = content
        self.blocks.learn_chain_hash(snapshot["top_chain_hash_at_initiation"], initiated)
        agent = self.agents.put_into(agent_id, snapshot)
        return self._intern(agent_id, agent, take(agent), None, flaw)
