"""Find the handler that most likely caused a failure, using only observations from outside the agent.

One input can trigger several handlers, one after another, and the wrong handler may even have run before this input.
The evidence consists of missing and unexpected messages, of wrong values in the status, and of the branches that passed
or failed in other vectors.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

from harness.conformance._alphabet import INPUTS, TIMER
from harness.conformance._observation import TestedStep
from harness.conformance._reference_model import ExpectedRun
from harness.conformance._state_space import VectorKey
from harness.conformance._suite import ConfirmedFailure, VariantResult
from ucp.agent import HANDLERS, ON_LOCAL_EVENT
from ucp.handler import LocalEvent
from ucp.messages import Message

BLOCK_KEYS = {"chain", "deque", "stack", "completed", "top_chain_hash"}
"""Keys of the status that describe the blocks of the agent."""

Branch = tuple[str, str, bool]
"""The name of a handler, the name of the branch that it took, and true if the handler run changed blocks. The last
element is needed because one branch of Algorithm 20 changes blocks only in some runs.
"""

STARTED_BY = {timer: handler.name for handler in HANDLERS.values() for timer in handler.starts}
"""Timer -> the handler that starts it."""
BEGINNING_OF_COUNT = {
    "vote_timer_expiration": "process_next_deque_block",
    "reconcile_phase_1_timer_expiration": "reconcile_phase_1",
    "reconcile_phase_2_timer_expiration": "reconcile_phase_2",
    "reconcile_phase_3_timer_expiration": "reconcile_phase_3",
}
"""Handler of a timer expiry, which evaluates the counted answers -> the handler that began to count them."""

_EVENT_OF = {handler.name: event for event, handler in ON_LOCAL_EVENT.items()}
_LEADING_EVENTS = {"Reconcile Begin", "Reconcile Phase 1"}
"""Local events whose handlers do nothing but trigger another handler."""
STARTING_BRANCHES = {"proposed", "asked", "recommitted, more to come"}
"""Branches in which a handler starts a timer."""


@dataclass(frozen=True)
class BlamedBranch:
    """The branch that most likely caused a failure, and its handler. The reference implementation took this branch."""

    handler: str
    branch: str

    @property
    def algorithm(self) -> int:
        return HANDLERS[self.handler].algorithm

    @property
    def title(self) -> str:
        return HANDLERS[self.handler].title


class BlameEvidence:
    """The evidence for finding the handler that caused a failure. It contains the numbers of passed and failed tests of
    each branch, and the pairs of successive branches in passed tests.
    """

    def __init__(self, variant_results: Iterable[VariantResult]) -> None:
        self._passed: Counter[Branch] = Counter()
        self._failed: Counter[Branch] = Counter()
        self._followed_by: set[tuple[Branch, Branch]] = set()
        self._pairs: set[tuple[str, VectorKey]] = set()
        for variant_result in variant_results:
            for failure in variant_result.failures:
                self._failed.update({_branch(run) for run in failure.observation.outcome.runs})
            for key in variant_result.passed:
                self._pairs.add((variant_result.vectors.variant.name, key))
                step = variant_result.vectors.by_key.get(key)
                if step is not None:
                    branches = [_branch(run) for run in step.outcome.runs]
                    self._passed.update(set(branches))
                    self._followed_by.update(pairwise(branches))

    def blame(self, failure: ConfirmedFailure) -> BlamedBranch:
        observation, runs = failure.observation, failure.observation.outcome.runs
        if observation.wrong_timer in STARTED_BY:
            return self._starter_of_timer(failure)
        if observation.hidden_run is not None and not self._fails_without_preceding_input(failure):
            return BlamedBranch(observation.hidden_run.handler, observation.hidden_run.branch)
        if not runs:
            sends = [handler for handler in HANDLERS.values() if _names(handler.sends) & set(observation.unexpected)]
            return BlamedBranch(sends[0].name if sends else "build_data_block", "")
        run = _sends_other_content(observation)
        if run is None and self._counts_wrongly_from_start(failure):
            return BlamedBranch(BEGINNING_OF_COUNT[runs[0].handler], "")
        run = (
            run
            or _took_another_decision(observation)
            or self._holds_other_blocks(observation)
            or self._most_suspicious(runs, failure)
        )
        return BlamedBranch(run.handler, run.branch)

    def _fails_without_preceding_input(self, failure: ConfirmedFailure) -> bool:
        """Return true if the ignored answer before the timer expiry is probably not the cause of the failure. This is
        so if no test passed in which the timer expired in the same state without this answer.
        """
        key = failure.observation.key
        if INPUTS[key.input].preceding is None:
            return False
        return (failure.variant, VectorKey(*failure.observation.before, TIMER)) not in self._pairs

    def _counts_wrongly_from_start(self, failure: ConfirmedFailure) -> bool:
        """Return true if the agent probably set its counters to a wrong initial value. This is likely if the agent
        decides wrongly only with few counted answers, or only after an earlier vote or reconcile.
        """
        observation, first = failure.observation, failure.observation.outcome.runs[0]
        if first.handler not in BEGINNING_OF_COUNT:
            return False
        nothing_counted = observation.before.counted[:2] in ((), (0, 0), (1, 0))
        return failure.needs_earlier_round or bool(
            nothing_counted and observation.unexpected and self._passed[_branch(first)]
        )

    def _holds_other_blocks(self, observation: TestedStep) -> ExpectedRun | None:
        """If the agent's status shows wrong blocks, return the handler run that should have changed the blocks.
        Otherwise return None.

        If the branch of this run passes in other tests, return an earlier run whose branch never passes.
        """
        if not BLOCK_KEYS & set(observation.wrong_status_keys):
            return None
        for place, run in enumerate(observation.outcome.runs):
            if run.changes:
                never_passed = [
                    before for before in observation.outcome.runs[:place] if not self._passed[_branch(before)]
                ]
                return never_passed[0] if never_passed and self._passed[_branch(run)] else run
        return None

    @staticmethod
    def _starter_of_timer(failure: ConfirmedFailure) -> BlamedBranch:
        """Return the handler that starts the timer with the wrong duration. If this handler ran in the tested step,
        also return its branch.
        """
        for run in failure.observation.outcome.runs:
            if HANDLERS[run.handler].starts and run.branch in STARTING_BRANCHES:
                return BlamedBranch(run.handler, run.branch)
        return BlamedBranch(STARTED_BY[str(failure.observation.wrong_timer)], "")

    def _most_suspicious(self, runs: Sequence[ExpectedRun], failure: ConfirmedFailure) -> ExpectedRun:
        """Return the handler run that most likely failed. The choice depends on the messages of each handler run, on
        the handler run after it, and on the passed tests.
        """
        observation = failure.observation
        if len(runs) == 1:
            return runs[0]
        never_passed = [run for run in runs if not self._passed[_branch(run)]]
        if never_passed:  # a branch that fails everywhere is the most likely cause
            return max(
                never_passed,
                key=lambda run: (
                    self._failed[_branch(run)],
                    STARTED_BY.get(str(observation.running_timer)) == run.handler,
                ),
            )
        sends = [run for run in runs if _names(HANDLERS[run.handler].sends) & set(observation.unexpected)]
        if sends:
            return sends[0]
        for run, then in reversed(list(pairwise(runs))):
            if (_branch(run), _branch(then)) not in self._followed_by:
                return run
        if runs[0].handler in BEGINNING_OF_COUNT:
            return runs[0]
        missing = [run for run in runs if {message.NAME for message in run.sent} & set(observation.missing)]
        if missing:
            return missing[0]
        return min(runs, key=lambda run: self._passed[_branch(run)])


def _took_another_decision(observation: TestedStep) -> ExpectedRun | None:
    """If a different decision at the expiry of the timer would explain all unexpected messages, return the handler run
    of this expiry. Otherwise return None.
    """
    first, *then = observation.outcome.runs
    if first.handler not in BEGINNING_OF_COUNT or not observation.unexpected:
        return None
    others = set(HANDLERS[first.handler].triggers) - {_EVENT_OF.get(run.handler) for run in then[:1]}
    sends = _names(HANDLERS[first.handler].sends).union(*[_messages_after(event) for event in others])
    sends -= {message.NAME for message in observation.outcome.sent}
    return first if set(observation.unexpected) <= sends else None


def _messages_after(event: LocalEvent) -> set[str]:
    """Return the names of the messages that the agent may send after this local event."""
    handler = ON_LOCAL_EVENT[event]
    return _names(handler.sends).union(*[_messages_after(then) for then in handler.triggers if then in _LEADING_EVENTS])


def _sends_other_content(observation: TestedStep) -> ExpectedRun | None:
    """If the agent sent messages of the right types with wrong content, return the handler run that sent these
    messages. Return None if a block or a message type is wrong.
    """
    if BLOCK_KEYS & set(observation.wrong_status_keys) or set(observation.missing) != set(observation.unexpected):
        return None
    return next(
        (run for run in observation.outcome.runs if {message.NAME for message in run.sent} & set(observation.missing)),
        None,
    )


def _branch(run: ExpectedRun) -> Branch:
    return run.handler, run.branch, run.changes


def _names(sends: Iterable[type[Message]]) -> set[str]:
    return {kind.NAME for kind in sends}
