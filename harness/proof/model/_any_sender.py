"""Explore each agent alone, in a network that may lose, duplicate, delay and reorder messages without limit (network
model `any`).

In such a network, an agent can receive a message at any moment, and any number of times, as soon as any agent has sent
the message. The agent depends on other agents in one further way: no agent can mention a block before the block is
completed.

The exploration collects the local states of each agent and the sent messages until no new ones appear. The result
contains every local state and message of every possible run. The result may contain more, because some of these
messages may never occur in the same run. A property of all collected states therefore holds in every run. If a
collected state violates a property, however, it is possible that no run does.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from harness.proof._progress_bar import Ended, ExplorationProgress, memory_bytes
from harness.proof.attacker._attacker import AttackerKnowledge
from harness.proof.attacker._forgeries import ForgeryMaterial
from harness.proof.bounds import Bounds
from harness.proof.model._flaws import PropertyViolation
from harness.proof.model._known_states import DEAD
from harness.proof.model._local_steps import LocalStates
from harness.proof.model._snapshot import AgentStep
from harness.proof.model._zones import NOTHING_RUNS, ZoneTable

LOOK_EVERY = 500

SingleAgentState = tuple[int, int, int, int]
"""The state of an agent that is explored alone: its ID, its local state, its zone (the possible remaining times of its
timers), and the number of blocks that it has completed.
"""
SentMessage = tuple[int, int]
"""A sent message: the number of the sender and the number of the message."""


@dataclass
class SingleAgentFigures:
    """The numeric results of an exploration of single agents. `said` is the number of different messages of all
    senders.
    """

    bounds: Bounds
    states: int = 0
    looked_at: int = 0
    transitions: int = 0
    said: int = 0
    local_states: int = 0
    steps: int = 0
    zones: int = 0
    divisions: int = 0
    seconds: float = 0.0
    ended: Ended = "complete"
    flaw: PropertyViolation | None = None
    way: list[str] = field(default_factory=list)
    """The actions and received messages that led the agent to the violation."""
    shown: set[str] = field(default_factory=set)
    """Characteristics that an attacker violates although the agents are correct."""


def collect(
    bounds: Bounds,
    *,
    most_bytes: float,
    most_s: float,
    watch: Callable[[ExplorationProgress], None] = lambda progress: None,
    keep: Callable[[LocalStates], None] = lambda local: None,
) -> SingleAgentFigures:
    """Collect all agent states and messages, until a limit of memory or time is reached or a violation is found.

    For each distribution of the blocks among the agents, `keep` is called with the local states.
    """
    collected, began = SingleAgentFigures(bounds), time.monotonic()
    try:
        for makers in divisions(bounds.agents, bounds.blocks, bounds.captured):
            collected.divisions += 1
            division = _BlockDistribution(collected, makers)
            try:
                for progress in division.collect(began):
                    watch(progress)
                    if memory_bytes() > most_bytes:
                        collected.ended = "memory"
                    elif progress.seconds > most_s:
                        collected.ended = "time"
                    elif collected.flaw is not None:
                        collected.ended = "flaw"
                    if collected.ended != "complete":
                        break
            finally:
                division.count()
            keep(division.local)
            if collected.ended != "complete":
                break
    except KeyboardInterrupt:
        collected.ended = "interrupted"
    collected.seconds = time.monotonic() - began
    return collected


def divisions(agents: int, blocks: int, captured: int | None = None) -> Iterator[tuple[int, ...]]:
    """Yield each distribution of the blocks among the agents, as a tuple that contains the author of each block.

    Distributions that differ only by an exchange of agents are yielded once. The captured agent is never exchanged.
    """
    others = [agent_id for agent_id in range(1, agents + 1) if agent_id != captured]
    begun: list[tuple[int, ...]] = [()]
    for _ in range(blocks):
        begun = [
            (*makers, maker)
            for makers in begun
            for maker in (*others[: len({*makers} - {captured}) + 1], *([captured] if captured is not None else []))
        ]
    return iter(begun)


class _BlockDistribution:
    """The exploration for one distribution of the blocks among the agents. A distribution states which agent completes
    which block.
    """

    def __init__(self, collected: SingleAgentFigures, makers: tuple[int, ...]) -> None:
        self._collected = collected
        self._bounds = bounds = collected.bounds
        self._own = {
            agent_id: [ordinal for ordinal, maker in enumerate(makers, 1) if maker == agent_id]
            for agent_id in range(1, bounds.agents + 1)
        }
        self.local = LocalStates(bounds)
        self._zones = ZoneTable()
        self._came_from: dict[SingleAgentState, tuple[SingleAgentState, str] | None] = {}
        self._said: dict[SentMessage, None] = {}
        self._names: dict[int, frozenset[int]] = {}
        self._by_agent: dict[int, list[SingleAgentState]] = {
            agent_id: [] for agent_id in self._own if agent_id != bounds.captured
        }
        self._heard = None if bounds.captured is None else AttackerKnowledge(bounds, self._own[bounds.captured])
        """The knowledge of the attacker, who can send at any moment. From the beginning, the attacker has the blocks of
        the captured vehicle.
        """
        self._delivered_forgeries: dict[int, tuple[ForgeryMaterial, int]] = {}
        """Agent -> the data from which the attacker last formed messages to the agent, and the number of the agent's
        states in which these messages were delivered.
        """
        self._explored = 0
        """Number of states whose own actions were explored. An own action needs no received message."""

    def collect(self, began: float) -> Iterator[ExplorationProgress]:
        """Explore until no new states or messages appear. Yield the progress."""
        collected = self._collected
        earlier = collected.states
        for agent_id in self._by_agent:
            local = self.local.initial[agent_id]
            self._add((agent_id, local, NOTHING_RUNS, 0), None)
        acted = dict.fromkeys(self._by_agent, 0)
        heard: dict[SentMessage, int] = {}
        busy = True
        while busy:
            busy = False
            for agent_id, states in self._by_agent.items():
                while acted[agent_id] < len(states):
                    self._act(states[acted[agent_id]])
                    acted[agent_id] += 1
                    self._explored += 1
                    busy = True
                for said in list(self._said):
                    if said[0] == agent_id:
                        continue
                    key = (said[0] * (len(self._own) + 1) + agent_id, said[1])
                    for position in range(heard.get(key, 0), len(states)):
                        busy = True
                        self._hear(states[position], said)
                    heard[key] = len(states)
                    self._attacker_hears(said)
                    yield ExplorationProgress(
                        earlier + len(self._came_from),
                        collected.looked_at + self._explored,
                        collected.transitions,
                        collected.divisions,
                        time.monotonic() - began,
                    )
                busy |= self._deliver_forgeries(agent_id, states)

    def count(self) -> None:
        """Add the numeric results of this distribution to the totals, even if its exploration is incomplete."""
        collected = self._collected
        collected.states += len(self._came_from)
        collected.looked_at += self._explored
        collected.said += len(self._said)
        collected.local_states += len(self.local.known)
        collected.steps += self.local.steps
        collected.zones += len(self._zones)

    def _add(self, state: SingleAgentState, came_from: tuple[SingleAgentState, str] | None) -> None:
        if state in self._came_from:
            return
        self._came_from[state] = came_from
        self._by_agent[state[0]].append(state)
        known, collected = self.local.known[state[1]], self._collected
        if known.flaw is not None and collected.flaw is None:
            collected.flaw = known.flaw
            while came_from is not None:
                before, what = came_from
                collected.way.insert(0, what)
                came_from = self._came_from[before]
        if known.deceived:
            collected.shown.add("4")

    def _act(self, state: SingleAgentState) -> None:
        """Explore the steps of an agent that need no message, such as the expiry of a timer."""
        agent_id, local, zone, completed = state
        if self._known_flaw(local):
            return
        running = self.local.known[local].running
        firsts = range(1, len(running) + 1) if self._bounds.timers_any else self._zones.firsts(zone)
        for first in firsts:
            timer = running[first - 1]
            step = self.local.end_timer(local, timer)
            self._go(state, step, f"its timer {self.local.timers[timer]} ends", ended=(first,))
        if completed < len(self._own[agent_id]):
            ordinal = self._own[agent_id][completed]
            step = self.local.complete(local, ordinal)
            self._go(state, step, f"it completes block {ordinal}", completes=1)
        if "reboot" in self._bounds.faults:
            self._go(state, self.local.reboot(local), "it reboots", forgets=True)

    def _hear(self, state: SingleAgentState, said: SentMessage) -> None:
        agent_id, local, _, completed = state
        if self._known_flaw(local) or not self._named(said[1]).isdisjoint(self._own[agent_id][completed:]):
            return
        step = self.local.hear(local, *said)
        self._collected.transitions += 1
        if step.local != local or step.sent or step.started:
            self._go(state, step, f"it hears a {self.local.messages[said[1]].NAME} from agent {said[0]}")

    def _attacker_hears(self, said: SentMessage) -> None:
        if self._heard is not None:
            self._heard.hears(said[0], self.local.messages[said[1]])

    def _deliver_forgeries(self, agent_id: int, states: list[SingleAgentState]) -> bool:
        """Let the attacker send each possible message to an agent in each of these states. Omit messages that were
        already delivered in the same state. Return true if any message was delivered.
        """
        if self._heard is None:
            return False
        material, before = self._heard.material(agent_id), self._delivered_forgeries.get(agent_id)
        done = 0 if before is None or before[0] != material else before[1]
        for state in states[done:]:
            for message in self._heard.forgeries(self.local.state(state[1]), material):
                self._deliver_forgery(state, self.local.message(message))
        self._delivered_forgeries[agent_id] = material, len(states)
        return done < len(states)

    def _deliver_forgery(self, state: SingleAgentState, message: int) -> None:
        agent_id, local, _, completed = state
        if self._known_flaw(local) or not self._named(message).isdisjoint(self._own[agent_id][completed:]):
            return
        step = self.local.lie(local, message)
        self._collected.transitions += 1
        if step.local != local or step.sent or step.started:
            self._collected.shown.add("1")
            self._go(state, step, f"it hears a {self.local.messages[message].NAME} of the attacker")

    def _known_flaw(self, local: int) -> bool:
        return self.local.known[local].flaw is not None

    def _named(self, message: int) -> frozenset[int]:
        """Return the blocks that must be complete before any agent can send this message."""
        named = self._names.get(message)
        if named is None:
            named = self._names[message] = self.local.blocks.named_in(self.local.messages[message])
        return named

    def _go(
        self,
        state: SingleAgentState,
        step: AgentStep,
        what: str,
        *,
        ended: tuple[int, ...] = (),
        completes: int = 0,
        forgets: bool = False,
    ) -> None:
        agent_id, local, zone, completed = state
        self._collected.transitions += 1
        for message in step.sent:
            self._said[agent_id, message] = None
        assert step.local != DEAD
        if not self._bounds.timers_any:
            before = {} if forgets else {timer: at for at, timer in enumerate(self.local.known[local].running, 1)}
            started = dict(step.started)
            running = tuple(
                -started[timer] - 1 if timer in started else before.get(timer) or -self.local.durations_us[timer] - 1
                for timer in self.local.known[step.local].running
            )
            after = self._zones.after(zone, ended, running)
            assert after is not None, "this timer can be the first to end"
            zone = after
        self._add((agent_id, step.local, zone, completed + completes), (state, what))
