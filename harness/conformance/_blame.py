"""Which handler is wrong, as far as that can be told from outside.

A failure shows at an input, of which several handlers come to run, one after the other, and the wrong one may have run
before. What is missing or too much, which branches pass elsewhere, and when it fails tell them apart.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

from harness.conformance._alphabet import INPUTS, TIMER
from harness.conformance._observation import Seen
from harness.conformance._reference_model import Run
from harness.conformance._state_space import Pair
from harness.conformance._suite import Failure, Tally
from ucp.agent import HANDLERS, ON_LOCAL_EVENT
from ucp.handler import LocalEvent
from ucp.messages import Message

HELD = {"chain", "deque", "stack", "completed", "top_chain_hash"}
"""Keys of the status: what the agent has."""

Branch = tuple[str, str, bool]
"""Handler, branch, and whether it changes there what is held: one branch of Algorithm 20 does so, or does not."""

STARTS = {timer: handler.name for handler in HANDLERS.values() for timer in handler.starts}
ENDS = {
    "vote_timer_expiration": "process_next_deque_block",
    "reconcile_phase_1_timer_expiration": "reconcile_phase_1",
    "reconcile_phase_2_timer_expiration": "reconcile_phase_2",
    "reconcile_phase_3_timer_expiration": "reconcile_phase_3",
}
"""What runs when a timer has ended -> what began the count that it decides by."""


_EVENT_OF = {handler.name: event for event, handler in ON_LOCAL_EVENT.items()}
_BEGINS = {"Reconcile Begin", "Reconcile Phase 1"}
"""What only leads on."""
STARTING = {"proposed", "asked", "recommitted, more to come"}
"""Branches in which a handler starts its timer."""


@dataclass(frozen=True)
class Blamed:
    """`branch` is that which the reference takes there."""

    handler: str
    branch: str

    @property
    def algorithm(self) -> int:
        return HANDLERS[self.handler].algorithm

    @property
    def title(self) -> str:
        return HANDLERS[self.handler].title


class Evidence:
    """How often each branch was in a vector that passed, and in one that failed; and which led on to which."""

    def __init__(self, tallies: Iterable[Tally]) -> None:
        self._passed: Counter[Branch] = Counter()
        self._failed: Counter[Branch] = Counter()
        self._led_on: set[tuple[Branch, Branch]] = set()
        self._pairs: set[tuple[str, Pair]] = set()
        for tally in tallies:
            for failure in tally.failures:
                self._failed.update({_branch(run) for run in failure.seen.outcome.runs})
            for pair in tally.passed:
                self._pairs.add((tally.vectors.variant.name, pair))
                step = tally.vectors.by_pair.get(pair)
                if step is not None:
                    branches = [_branch(run) for run in step.outcome.runs]
                    self._passed.update(set(branches))
                    self._led_on.update(pairwise(branches))

    def blame(self, failure: Failure) -> Blamed:
        seen, runs = failure.seen, failure.seen.outcome.runs
        if seen.mistimed in STARTS:
            return self._starter(failure)
        if seen.hidden is not None and not self._fails_without(failure):
            return Blamed(seen.hidden.handler, seen.hidden.branch)
        if not runs:
            sends = [handler for handler in HANDLERS.values() if _names(handler.sends) & set(seen.unexpected)]
            return Blamed(sends[0].name if sends else "build_data_block", "")
        run = _says_otherwise(seen)
        if run is None and self._began_wrongly(failure):
            return Blamed(ENDS[runs[0].handler], "")
        run = run or _decided_otherwise(seen) or self._holds_otherwise(seen) or self._suspect(runs, failure)
        return Blamed(run.handler, run.branch)

    def _fails_without(self, failure: Failure) -> bool:
        """Whether the end of the timer fails also without the answer before it that must not count."""
        pair = failure.seen.pair
        if INPUTS[pair.input].first is None:
            return False
        return (failure.variant, Pair(*failure.seen.before, TIMER)) not in self._pairs

    def _began_wrongly(self, failure: Failure) -> bool:
        """Whether the count was wrong from its beginning: it decides rightly where anything was counted."""
        seen, first = failure.seen, failure.seen.outcome.runs[0]
        if first.handler not in ENDS:
            return False
        nothing_counted = seen.before.counted[:2] in ((), (0, 0), (1, 0))
        return failure.of_an_earlier_round or bool(nothing_counted and seen.unexpected and self._passed[_branch(first)])

    def _holds_otherwise(self, seen: Seen) -> Run | None:
        """Who changes what is held, if that is not as it should be; or who never led on to that, where others do."""
        if not HELD & set(seen.misstated):
            return None
        for place, run in enumerate(seen.outcome.runs):
            if run.changes:
                never = [before for before in seen.outcome.runs[:place] if not self._passed[_branch(before)]]
                return never[0] if never and self._passed[_branch(run)] else run
        return None

    @staticmethod
    def _starter(failure: Failure) -> Blamed:
        """Who starts the timer that is not as it should be; if that ran now, in the branch that it took."""
        for run in failure.seen.outcome.runs:
            if HANDLERS[run.handler].starts and run.branch in STARTING:
                return Blamed(run.handler, run.branch)
        return Blamed(STARTS[str(failure.seen.mistimed)], "")

    def _suspect(self, runs: Sequence[Run], failure: Failure) -> Run:
        """Who sends what is too much, or should have sent what is missing, or should have led on to that."""
        seen = failure.seen
        if len(runs) == 1:
            return runs[0]
        never = [run for run in runs if not self._passed[_branch(run)]]
        if never:  # what is wrong about all of them is wrong first
            return max(
                never, key=lambda run: (self._failed[_branch(run)], STARTS.get(str(seen.started)) == run.handler)
            )
        sends = [run for run in runs if _names(HANDLERS[run.handler].sends) & set(seen.unexpected)]
        if sends:
            return sends[0]
        for run, then in reversed(list(pairwise(runs))):
            if (_branch(run), _branch(then)) not in self._led_on:
                return run
        if runs[0].handler in ENDS:
            return runs[0]
        missing = [run for run in runs if {message.NAME for message in run.sent} & set(seen.missing)]
        if missing:
            return missing[0]
        return min(runs, key=lambda run: self._passed[_branch(run)])


def _decided_otherwise(seen: Seen) -> Run | None:
    """Who decides at the end of a timer, if what came is what comes of another decision."""
    first, *then = seen.outcome.runs
    if first.handler not in ENDS or not seen.unexpected:
        return None
    others = set(HANDLERS[first.handler].triggers) - {_EVENT_OF.get(run.handler) for run in then[:1]}
    sends = _names(HANDLERS[first.handler].sends).union(*[_sends_after(event) for event in others])
    sends -= {message.NAME for message in seen.outcome.sent}
    return first if set(seen.unexpected) <= sends else None


def _sends_after(event: LocalEvent) -> set[str]:
    """What may be sent when this was triggered."""
    handler = ON_LOCAL_EVENT[event]
    return _names(handler.sends).union(*[_sends_after(then) for then in handler.triggers if then in _BEGINS])


def _says_otherwise(seen: Seen) -> Run | None:
    """Who sends the same messages with another content, if all is held that should be."""
    if HELD & set(seen.misstated) or set(seen.missing) != set(seen.unexpected):
        return None
    return next((run for run in seen.outcome.runs if {message.NAME for message in run.sent} & set(seen.missing)), None)


def _branch(run: Run) -> Branch:
    return run.handler, run.branch, run.changes


def _names(sends: Iterable[type[Message]]) -> set[str]:
    return {kind.NAME for kind in sends}
