"""The network `any`: each agent by itself, against all that anybody could ever have said.

A message may be lost, be heard twice, take any time and overtake others. So an agent can hear, at any moment and as
often as it likes, whatever somebody has sent, and depends on the others in no other way; only of its own block nobody
speaks before it has completed it. Local states of each agent and messages that are sent are collected together until
there are no more: whatever any run can show is among them, and maybe more, for not all of these messages need have been
sent in one run. What holds of all of them holds; what does not is not shown.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from harness.proof._progress_bar import Ended, Progress, memory_bytes
from harness.proof.attacker._attacker import Heard
from harness.proof.attacker._forgeries import Material
from harness.proof.bounds import Bounds
from harness.proof.model._flaws import Flaw
from harness.proof.model._known_states import DEAD
from harness.proof.model._local_steps import LocalStates
from harness.proof.model._snapshot import Step
from harness.proof.model._zones import NOTHING_RUNS, Zones

LOOK_EVERY = 500

Alone = tuple[int, int, int, int]
"""An agent by itself: its ID, local state, zone, and how many of its own blocks it has completed."""
Said = tuple[int, int]
"""A sender and a message."""


@dataclass
class Collected:
    """What was collected, over all ways to divide the blocks among the agents. `said` counts messages by sender."""

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
    flaw: Flaw | None = None
    way: list[str] = field(default_factory=list)
    """What the agent with the flaw did and heard before."""
    shown: set[str] = field(default_factory=set)
    """Characteristics that a captor violates though no agent does anything wrong."""


def collect(
    bounds: Bounds,
    *,
    most_bytes: float,
    most_s: float,
    watch: Callable[[Progress], None] = lambda progress: None,
    keep: Callable[[LocalStates], None] = lambda local: None,
) -> Collected:
    """All local states, and all messages, or as many as memory and time allow, or up to the first flaw.

    `keep` is given the local states of each way to divide the blocks.
    """
    collected, began = Collected(bounds), time.monotonic()
    try:
        for makers in divisions(bounds.agents, bounds.blocks, bounds.captured):
            collected.divisions += 1
            division = _Division(collected, makers)
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
    """Who completes which block, in the order of the blocks; agents are numbered as they come, but for the captured."""
    others = [agent_id for agent_id in range(1, agents + 1) if agent_id != captured]
    begun: list[tuple[int, ...]] = [()]
    for _ in range(blocks):
        begun = [
            (*makers, maker)
            for makers in begun
            for maker in (*others[: len({*makers} - {captured}) + 1], *([captured] if captured is not None else []))
        ]
    return iter(begun)


class _Division:
    """The agents when it is settled who completes which block."""

    def __init__(self, collected: Collected, makers: tuple[int, ...]) -> None:
        self._collected = collected
        self._bounds = bounds = collected.bounds
        self._own = {
            agent_id: [ordinal for ordinal, maker in enumerate(makers, 1) if maker == agent_id]
            for agent_id in range(1, bounds.agents + 1)
        }
        self.local = LocalStates(bounds)
        self._zones = Zones()
        self._came_from: dict[Alone, tuple[Alone, str] | None] = {}
        self._said: dict[Said, None] = {}
        self._names: dict[int, frozenset[int]] = {}
        self._by_agent: dict[int, list[Alone]] = {agent_id: [] for agent_id in self._own if agent_id != bounds.captured}
        self._heard = None if bounds.captured is None else Heard(bounds, self._own[bounds.captured])
        """What a captor has heard, who can speak at any moment; the blocks of its vehicle it has from the beginning."""
        self._lied: dict[int, tuple[Material, int]] = {}
        """Of each agent: with what the captor spoke to it last, and to how many of its states."""
        self._looked_at = 0
        """States whose own steps have been taken."""

    def collect(self, began: float) -> Iterator[Progress]:
        """Until there is no more."""
        collected = self._collected
        earlier = collected.states
        for agent_id in self._by_agent:
            local = self.local.initial[agent_id]
            self._add((agent_id, local, NOTHING_RUNS, 0), None)
        acted = dict.fromkeys(self._by_agent, 0)
        heard: dict[Said, int] = {}
        busy = True
        while busy:
            busy = False
            for agent_id, states in self._by_agent.items():
                while acted[agent_id] < len(states):
                    self._act(states[acted[agent_id]])
                    acted[agent_id] += 1
                    self._looked_at += 1
                    busy = True
                for said in list(self._said):
                    if said[0] == agent_id:
                        continue
                    key = (said[0] * (len(self._own) + 1) + agent_id, said[1])
                    for position in range(heard.get(key, 0), len(states)):
                        busy = True
                        self._hear(states[position], said)
                    heard[key] = len(states)
                    self._captor_hears(said)
                    yield Progress(
                        earlier + len(self._came_from),
                        collected.looked_at + self._looked_at,
                        collected.transitions,
                        collected.divisions,
                        time.monotonic() - began,
                    )
                busy |= self._lied_to(agent_id, states)

    def count(self) -> None:
        """Add the figures of this division, complete or not, to those of all divisions."""
        collected = self._collected
        collected.states += len(self._came_from)
        collected.looked_at += self._looked_at
        collected.said += len(self._said)
        collected.local_states += len(self.local.known)
        collected.steps += self.local.steps
        collected.zones += len(self._zones)

    def _add(self, state: Alone, came_from: tuple[Alone, str] | None) -> None:
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

    def _act(self, state: Alone) -> None:
        """What the agent may do of its own."""
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

    def _hear(self, state: Alone, said: Said) -> None:
        agent_id, local, _, completed = state
        if self._known_flaw(local) or not self._named(said[1]).isdisjoint(self._own[agent_id][completed:]):
            return
        step = self.local.hear(local, *said)
        self._collected.transitions += 1
        if step.local != local or step.sent or step.started:
            self._go(state, step, f"it hears a {self.local.messages[said[1]].NAME} from agent {said[0]}")

    def _captor_hears(self, said: Said) -> None:
        if self._heard is not None:
            self._heard.hears(said[0], self.local.messages[said[1]])

    def _lied_to(self, agent_id: int, states: list[Alone]) -> bool:
        """The captor says all that it can to the agent in each of these states; whether it had not done so before."""
        if self._heard is None:
            return False
        material, before = self._heard.material(agent_id), self._lied.get(agent_id)
        told = 0 if before is None or before[0] != material else before[1]
        for state in states[told:]:
            for message in self._heard.letters(self.local.state(state[1]), material):
                self._lie(state, self.local.message(message))
        self._lied[agent_id] = material, len(states)
        return told < len(states)

    def _lie(self, state: Alone, message: int) -> None:
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
        """The blocks that must have been completed for the message to be sent: it names them, or a chain of them."""
        named = self._names.get(message)
        if named is None:
            named = self._names[message] = self.local.blocks.named_in(self.local.messages[message])
        return named

    def _go(
        self,
        state: Alone,
        step: Step,
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
