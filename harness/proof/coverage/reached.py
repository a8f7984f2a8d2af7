"""Collect the states, inputs and branches of agents that runs reach, while the step judge examines their traces.

The step judge (`harness.checker.steps`) repeats the steps of each agent with the reference. Coverage can therefore be
measured for agents in any language, and for recorded runs.
"""

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from harness.checker.evidence import Evidence, Watch
from harness.checker.recorded_inputs import decoded
from harness.checker.reference.state import ReferenceState
from harness.checker.steps import check
from harness.play.simulation.simulation import Simulation
from harness.proof.model._shape import HeldBlockOrder, Shape, shape_of
from harness.run.simulate import MemoryRecorder, Simulated, simulate_in_memory
from harness.scenario import Scenario
from ucp.agent import HANDLERS
from ucp.trace import HandlerRun
from ucp.trigger import EventTrigger, LocalTrigger, MessageTrigger, TimerTrigger

Branch = tuple[str, str]
"""A handler and one of its branches."""

BRANCHES: tuple[Branch, ...] = tuple(
    (name, branch) for name, handler in HANDLERS.items() for branch in handler.branches
)
"""All branches in the agent contract."""

MOST = 2_000_000
"""Maximum number of stored local states, and of stored (state, input) pairs. It limits the memory."""
KEPT = 20_000
"""Maximum number of cached `HeldBlockOrder` objects. Each one describes the blocks that an agent holds."""


@dataclass
class ReachedStates:
    """The agent states that any run reached, and the (state, input) pairs in which the input had an effect or caused an
    answer.
    """

    states: set[int] = field(default_factory=set)
    pairs: set[int] = field(default_factory=set)
    branches: Counter[Branch] = field(default_factory=Counter)
    steps: int = 0
    """Number of handler runs that were examined."""
    untold: str | None = None
    """The reason why some steps are unknown. None if all steps are known."""

    def add(self, other: "ReachedStates") -> None:
        """Add the states, pairs and branches of another object to this one."""
        for mine, its in ((self.states, other.states), (self.pairs, other.pairs)):
            if len(mine) < MOST:
                mine |= its
            elif not its <= mine:
                self.untold = f"only the first {MOST:,} local states and pairs are counted"
        self.branches.update(other.branches)
        self.steps += other.steps
        self.untold = self.untold or other.untold


class CoverageWatcher:
    """A recorder of an agent's states, pairs and branches. After each judged step, it adds them to `reached`. Callers
    may replace `reached`.
    """

    def __init__(self) -> None:
        self.reached = ReachedStates()
        self._held: dict[tuple[object, ...], HeldBlockOrder] = {}
        self._number_before = 0
        self._shape_before: Shape = ()
        self._held_before: HeldBlockOrder | None = None
        self._input: HandlerRun | None = None
        self._answers = False

    def step(self, state: ReferenceState, run: HandlerRun | None) -> None:
        """Record the state of an agent after a handler run. `run` is None when the agent has just started."""
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
            given = _described_input(self._input, self._held_before)
            if given is not None:
                reached.pairs.add(self._held_before.number((self._shape_before, given)))
        self._number_before, self._shape_before, self._held_before = number, shape, held

    def _what_it_holds(self, state: ReferenceState) -> HeldBlockOrder:
        key: tuple[object, ...] = (state.chain.top_chain_hash,)
        if state.blocks_to_be_committed or state.reconcile_stack:
            aside = (*state.blocks_to_be_committed, *state.reconcile_stack)
            key = (*key, len(state.reconcile_stack), *[block.block_hash for block in aside])
        held = self._held.get(key)
        if held is None:
            if len(self._held) >= KEPT:
                self._held.clear()
            held = self._held[key] = HeldBlockOrder(state)
        return held


def _described_input(run: HandlerRun | None, held: HeldBlockOrder) -> tuple[Any, ...] | None:
    """Return a description of an input that is the same in every run with the same blocks in the same order. `held`
    contains the blocks that the agent held before the input. Return None for an input that does not exist in any proof.
    """
    if run is None:
        return None
    trigger = run.trigger
    if isinstance(trigger, MessageTrigger):
        return held.input_shape(decoded(run.input).message)
    if isinstance(trigger, TimerTrigger):
        return ("timer", trigger.timer)
    return ("event",) if isinstance(trigger, EventTrigger) else None


def reached_in(evidence: Evidence) -> ReachedStates:
    """Return the states, pairs and branches that the agents of a run reached, according to their traces."""
    watcher = CoverageWatcher()
    evidence.watch = watcher.step
    judgement = check(evidence)
    if judgement.verdict == "not applicable":
        watcher.reached.untold = judgement.reason
    return watcher.reached


def simulate_watched(scenario: Scenario, seed: int, watch: Watch, **options: Any) -> Simulated:
    """Simulate a run with traces. The simulation also delivers messages that have no effect. The traces then contain
    the branches in which agents ignore messages.
    """
    return simulate_in_memory(_WatchedRunRecorder(watch), scenario, seed, deliver_all=True, **options)


class _WatchedRunRecorder(MemoryRecorder):
    def __init__(self, watch: Watch) -> None:
        super().__init__(tracing=True)
        self._watch = watch

    def evidence(self, simulation: Simulation) -> Evidence:
        evidence = super().evidence(simulation)
        evidence.watch = self._watch
        return evidence
