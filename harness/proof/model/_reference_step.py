"""Compare one step of an agent with the same step of the independent reference implementation.

The reference is set to the state of the agent and receives the same input. Each step is judged separately. The
comparison therefore finds a mistake in a step even if the mistake has no later consequences. If the agents run the
installed agent core, a proof compares this core with the reference in every state within the bounds.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from harness.checker.reference.algorithms import HANDLERS
from harness.checker.reference.reference_agent import ReferenceAgent
from harness.checker.reference.state import ReferenceState, Settings
from harness.checker.steps.deviation import differences
from harness.proof.bounds import Bounds
from harness.proof.model._known_states import FIRST
from harness.proof.model._real_agents import INITIAL_DATA
from harness.proof.model._snapshot import NOW_S, Snapshot, put_back
from ucp.agent import Agent
from ucp.state import AgentState
from ucp.trace import HandlerRun

Give = Callable[[Any], None]
"""The type of a function that gives an input to a `ucp.agent.Agent` or to a `ReferenceAgent`."""
Make = Callable[[int, Callable[[], None]], Agent]
"""The type of a function that creates an agent with traces. Its arguments are the ID of the agent, and a function that
the agent calls after each handler run.
"""


class _ReferenceRun(NamedTuple):
    """A handler run, and the state of the agent after it."""

    run: HandlerRun
    left: tuple[Any, ...]


class ReferenceComparison:
    """A comparison of agent steps with the steps of the reference implementation."""

    def __init__(self, bounds: Bounds, make: Make) -> None:
        self._bounds = bounds
        self._make = make

    def deviation(
        self,
        agent_id: int,
        agent: Agent,
        crashed: str | None,
        before: Snapshot | None,
        give: Give,
        to_reference: Give,
        name_of: Callable[[str], str],
    ) -> tuple[str, str] | None:
        """Compare one step of an agent with the same step of the reference. Return None if the two steps are equal.
        Otherwise return the handler and a sentence about the difference.

        `before` is the state of the agent before the step, or None if the agent had just been switched on. The
        functions `give` and `to_reference` pass the input of the step to the agent and to the reference. `name_of`
        returns the name of the block with a given hash.
        """
        reference = self._reference(agent_id, before)
        error = _error_of(reference, to_reference)
        if error is not None and crashed is not None:
            return None  # no handler is written for this state, and the proof reports the crash itself
        outbox = [said[1] for said in vars(agent.state)["outbox"]]
        alike = _state(reference.state) == _state(agent.state) and _said(reference) == outbox
        if alike and error is None and crashed is None:
            return None
        left: list[tuple[Any, ...]] = []
        traced = self._make(agent_id, lambda: left.append(_state(traced.state)))
        if before is not None:
            put_back(traced, before)
        _error_of(traced, give)
        runs = [entry for entry in traced.trace() if isinstance(entry, HandlerRun)]
        did = [_ReferenceRun(run, after) for run, after in zip(runs, left, strict=False)]  # a crash leaves no state
        should_leave: list[tuple[Any, ...]] = []
        reference = self._reference(agent_id, before, lambda: should_leave.append(_state(reference.state)))
        _error_of(reference, to_reference)
        should = [_ReferenceRun(run, after) for run, after in zip(reference.trace(), should_leave, strict=False)]
        return _first_difference(did, should, name_of)

    def _reference(
        self, agent_id: int, before: Snapshot | None, after_each: Callable[[], None] | None = None
    ) -> ReferenceAgent:
        """Return a reference agent that is set to the state of the agent."""
        roster = range(1, self._bounds.agents + 1)
        own_id = FIRST if self._bounds.nameless else agent_id
        settings = Settings.of(self._bounds.agent_settings(agent_id))
        reference = ReferenceAgent(own_id, roster, INITIAL_DATA, settings, after_each)
        if before is not None:
            _put_into(reference.state, before)
        reference.state.now = NOW_S
        return reference


def _error_of(agent: Agent | ReferenceAgent, give: Give) -> Exception | None:
    try:
        give(agent)
    except Exception as error:  # a wrong agent's state may be one that no handler was written for
        return error
    return None


def _said(reference: ReferenceAgent) -> list[Any]:
    return [message for _, message in reference.messages_to_send()]


COPIED = (
    "current_block",
    "blocks_to_be_committed",
    "completed",
    "newest_block_timestamp_us",
    "candidate_block",
    "top_chain_hash_at_initiation",
    "vote_count",
    "voters",
    "reconcile_in_progress",
    "reconcile_stack",
    "reconcile_vote_count",
    "reconcile_responders",
    "majority_response_block_hash",
)
"""Attributes that are copied from an agent's state to the reference's state. Chain, timers and the dictionary of
candidates are converted instead.
"""


def _put_into(state: ReferenceState, before: Snapshot) -> None:
    """Set the reference implementation to the state of an agent's snapshot."""
    for name in COPIED:
        value = before[name]
        setattr(state, name, value.copy() if hasattr(value, "copy") else value)
    state.reconcile_response_dictionary = {
        candidate: list(counted) for candidate, counted in before["reconcile_response_dictionary"].items()
    }
    state.note_held()
    chain = before["chain"].parts
    for block in chain["_blocks"]:
        state.chain.append(block)
    state.chain.top_chain_hash = chain["top_chain_hash"]
    for timer, name in zip(state.timers, TIMERS, strict=True):
        before[name].put_back(timer)


TIMERS = ("voting_timer", "phase_one_timer", "phase_two_timer", "phase_three_timer", "finalize_timer")


def _state(state: ReferenceState | AgentState) -> tuple[Any, ...]:
    """Return the parts of a state that affect subsequent steps. Vote counts matter only while their timer runs."""
    votes, phase_1, phase_2, phase_3, _ = (timer.active for timer in state.timers)
    return (
        [block.block_hash for block in state.chain],
        state.chain.top_chain_hash,
        bytes(state.current_block),
        [block.block_hash for block in state.blocks_to_be_committed],
        [block.block_hash for block in state.reconcile_stack],
        list(state.completed),
        state.newest_block_timestamp_us,
        state.reconcile_in_progress,
        [(timer.deadline, timer.active) for timer in state.timers],
        votes
        and (
            state.vote_count.copy(),
            state.voters.copy(),
            state.candidate_block and state.candidate_block.block_hash,
            state.top_chain_hash_at_initiation,
        ),
        phase_1 and state.reconcile_vote_count.copy(),
        (phase_1 or phase_2) and state.reconcile_responders.copy(),
        phase_2 and {candidate: list(count) for candidate, count in state.reconcile_response_dictionary.items()},
        phase_3 and state.majority_response_block_hash,
    )


def _first_difference(
    did: Sequence[_ReferenceRun], should: Sequence[_ReferenceRun], name_of: Callable[[str], str]
) -> tuple[str, str]:
    alike = 0
    for (run, left), (expected, should_leave) in zip(did, should, strict=False):
        if run.handler != expected.handler:
            break
        alike += 1
        words = [f"it {done}; it should have {right}" for done, right in differences(run, expected, name_of)]
        if words:
            return run.handler, f"{_title(run)}: {'; '.join(words)}"
        if left != should_leave and _handler(did, alike) == _handler(should, alike):
            return run.handler, f"{_title(run)}: the state or a timer is wrong after it"
    whose = (did or should)[max(alike - 1, 0)].run
    follows, should_follow = _handler(did, alike), _handler(should, alike)
    return whose.handler, f"{_title(whose)}: it triggers {follows}; it should trigger {should_follow}"


def _handler(runs: Sequence[_ReferenceRun], number: int) -> str:
    return runs[number].run.handler if number < len(runs) else "nothing"


def _title(run: HandlerRun) -> str:
    return f"Algorithm {HANDLERS[run.handler].algorithm}, {run.handler}"
