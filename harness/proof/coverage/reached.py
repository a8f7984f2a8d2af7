"""Local states, inputs and branches that runs reached, collected while a simulated run is judged.

The steps of an agent are those that the step judge's reference core follows (`harness.checker.steps`): agents of
another make count as ours do, and recorded runs as simulated ones.
"""

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from harness.checker.evidence import Evidence, Watch
from harness.checker.recorded_inputs import decoded
from harness.checker.reference.state import State
from harness.checker.steps import check
from harness.play.simulation.simulation import Simulation
from harness.proof.model._shape import Held, Shape, shape_of
from harness.run.simulate import MemoryRecorder, Simulated, simulate_in_memory
from harness.scenario import Scenario
from ucp.agent import HANDLERS
from ucp.trace import HandlerRun
from ucp.trigger import EventTrigger, LocalTrigger, MessageTrigger, TimerTrigger

Branch = tuple[str, str]
"""A handler, and a branch of it."""

BRANCHES: tuple[Branch, ...] = tuple(
    (name, branch) for name, handler in HANDLERS.items() for branch in handler.branches
)
"""All that there are in the contract."""

MOST = 2_000_000
"""So many local states, or pairs, are kept: more would take all memory."""
KEPT = 20_000
"""So much that agents held is kept, with what was worked out of it."""


@dataclass
class Reached:
    """Numbers of local states, and of pairs of one and an input that changes something there or is answered."""

    states: set[int] = field(default_factory=set)
    pairs: set[int] = field(default_factory=set)
    branches: Counter[Branch] = field(default_factory=Counter)
    steps: int = 0
    """Handler runs that were followed."""
    untold: str | None = None
    """Why not everything that agents did is known."""

    def add(self, other: "Reached") -> None:
        """All that the other has."""
        for mine, its in ((self.states, other.states), (self.pairs, other.pairs)):
            if len(mine) < MOST:
                mine |= its
            elif not its <= mine:
                self.untold = f"only the first {MOST:,} local states and pairs are counted"
        self.branches.update(other.branches)
        self.steps += other.steps
        self.untold = self.untold or other.untold


class Watcher:
    """Is shown each step that is followed, and takes down what is reached. `reached` may be taken away at any time."""

    def __init__(self) -> None:
        self.reached = Reached()
        self._held: dict[tuple[object, ...], Held] = {}
        self._number_before = 0
        self._shape_before: Shape = ()
        self._held_before: Held | None = None
        self._input: HandlerRun | None = None
        self._answers = False

    def step(self, state: State, run: HandlerRun | None) -> None:
        """An agent is in this state after this handler has run; None where a life begins."""
        reached = self.reached
        if run is None:
            self._held_before = None
        else:
            reached.steps += 1
            reached.branches[run.handler, run.branch] += 1
            if not isinstance(run.trigger, LocalTrigger):
                self._input, self._answers = run, False
            self._answers = self._answers or bool(run.sent)
            if state.triggered:
                return
        held = self._what_it_holds(state)
        shape = shape_of(state, held)
        number = held.number(shape)
        reached.states.add(number)
        if self._held_before is not None and (number != self._number_before or self._answers):
            given = _given(self._input, self._held_before)
            if given is not None:
                reached.pairs.add(self._held_before.number((self._shape_before, given)))
        self._number_before, self._shape_before, self._held_before = number, shape, held

    def _what_it_holds(self, state: State) -> Held:
        key: tuple[object, ...] = (state.chain.top_chain_hash,)
        if state.blocks_to_be_committed or state.reconcile_stack:
            aside = (*state.blocks_to_be_committed, *state.reconcile_stack)
            key = (*key, len(state.reconcile_stack), *[block.block_hash for block in aside])
        held = self._held.get(key)
        if held is None:
            if len(self._held) >= KEPT:
                self._held.clear()
            held = self._held[key] = Held(state)
        return held


def _given(run: HandlerRun | None, held: Held) -> tuple[Any, ...] | None:
    """The input, as it is to the agent that held this; None of one that no bounds have."""
    if run is None:
        return None
    trigger = run.trigger
    if isinstance(trigger, MessageTrigger):
        return held.input_shape(decoded(run.input).message)
    if isinstance(trigger, TimerTrigger):
        return ("timer", trigger.timer)
    return ("event",) if isinstance(trigger, EventTrigger) else None


def reached_in(evidence: Evidence) -> Reached:
    """What the agents of a run came to, by their traces."""
    watcher = Watcher()
    evidence.watch = watcher.step
    judgement = check(evidence)
    if judgement.verdict == "not applicable":
        watcher.reached.untold = judgement.reason
    return watcher.reached


def simulate_watched(scenario: Scenario, seed: int, watch: Watch, **options: Any) -> Simulated:
    """As `simulate` with traces; everything is delivered, so that branches in which nothing happens are seen, too."""
    return simulate_in_memory(_Watched(watch), scenario, seed, deliver_all=True, **options)


class _Watched(MemoryRecorder):
    def __init__(self, watch: Watch) -> None:
        super().__init__(tracing=True)
        self._watch = watch

    def evidence(self, simulation: Simulation) -> Evidence:
        evidence = super().evidence(simulation)
        evidence.watch = self._watch
        return evidence
