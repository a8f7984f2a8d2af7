"""Simplify the vote counts in an agent's state to the decision that follows from them.

States with different vote counts that always lead to the same decision count as the same local state. See
docs/explanation/proof.md.
"""

from collections.abc import Callable, Sequence

from harness.proof.model._known_states import DEAD, KnownStates
from harness.proof.model._snapshot import NAMES_OF_OTHERS, AgentStep, ReductionError, Snapshot, TimerResult
from ucp.reconcile import most_named

TALLIES = frozenset((*NAMES_OF_OTHERS, "vote_count", "reconcile_vote_count", "reconcile_response_dictionary"))
"""Parts of the state that count answers. Handlers read these parts only to count an answer and at the expiry of a
timer.
"""


class VoteCounts:
    """The vote counts of agent states after all messages of an instant, replaced by simpler ones that lead to the same
    decision.

    The function `ends` takes the number of a state and the index of a timer in `timers`. It returns the possible
    results of the timer's expiry, which the real agent computes. If `every_count` is true, the vote counts of a
    reconcile are not simplified.
    """

    def __init__(
        self,
        states: KnownStates,
        timers: Sequence[str],
        ends: Callable[[int, int], Sequence[TimerResult]],
        *,
        every_count: bool,
    ) -> None:
        self._states = states
        self._phase_one = timers.index("phase one")
        self._ends = ends
        self._every_count = every_count
        self._most_decides = not states.bounds.agent_settings().top_needs_majority
        self._settled: dict[int, int] = {}

    def settled(self, local: int) -> int:
        """Return the number of the state with simplified vote counts.

        At the end of an instant, all answers have arrived or are lost, so the identity of the voters no longer matters.
        """
        number = self._settled.get(local)
        if number is None:
            tallies = {} if local == DEAD or local in self._states.flawed else self._left(local)
            number = self._settled[local] = self._states.with_tallies(local, tallies) if tallies else local
            self._check_that_it_ends_alike(local, number)
        return number

    def _left(self, local: int) -> Snapshot:
        """Return the simplified vote counts of a state, as parts that replace those of the state."""
        known = self._states.known[local]
        snapshot = known.snapshot
        left: Snapshot = {}
        if snapshot["voting_timer"].active:
            count = snapshot["vote_count"]
            left |= {"vote_count": {"yes": int(count["yes"] > count["no"]), "no": 0}, "voters": set()}
        if self._every_count:
            return left
        if snapshot["voting_timer"].active:
            began_with = self._states.blocks.named(snapshot["top_chain_hash_at_initiation"])
            if len(known.chain) + len(snapshot["reconcile_stack"]) > len(began_with):
                left["top_chain_hash_at_initiation"] = b""  # blocks stay: the chain will not be that one again
        if snapshot["phase_one_timer"].active:
            left |= self._of_phase_1(local)
        if snapshot["phase_two_timer"].active and self._most_decides:
            left |= self._of_phase_2(snapshot)
        return left

    def _of_phase_1(self, local: int) -> Snapshot:
        """Return the simplified vote count of phase 1 if missing answers cannot change the result of phase 1. Otherwise
        return an empty snapshot.
        """
        snapshot = self._states.known[local].snapshot
        yes, no = (snapshot["reconcile_vote_count"][answer] for answer in ("yes", "no"))
        silent = self._silent(snapshot)
        clear = {tally: self._ends_with(local, *tally) for tally in ((1, 0), (0, 1))}
        ends = self._ends_with(local, yes, no)
        at_last = [self._ends_with(local, *tally) for tally in ((yes + silent, no), (yes, no + silent))]
        if not yes + no or at_last != [ends, ends]:
            return {}
        yes, no = next(tally for tally, as_clear in clear.items() if as_clear == ends)
        return {"reconcile_vote_count": {"yes": yes, "no": no}, "reconcile_responders": {*self._states.others}}

    def _ends_with(self, local: int, yes: int, no: int) -> Sequence[TimerResult]:
        """Return the possible results of phase 1 when it ends with these numbers of votes."""
        counted = self._states.with_tallies(local, {"reconcile_vote_count": {"yes": yes, "no": no}})
        return self._ends(counted, self._phase_one)

    def _of_phase_2(self, snapshot: Snapshot) -> Snapshot:
        """Return the candidates of phase 2 with the most votes. If missing answers can change these candidates, return
        an empty snapshot.
        """
        candidates = snapshot["reconcile_response_dictionary"]
        most, next_most, *_ = sorted([*(count for count, _ in candidates.values()), 0, 0], reverse=True)
        silent = self._silent(snapshot)
        if silent and most - next_most <= silent:
            return {}
        left = {candidate: [1, candidates[candidate][1]] for candidate in most_named(candidates)}
        return {"reconcile_response_dictionary": left, "reconcile_responders": {*self._states.others}}

    def _silent(self, snapshot: Snapshot) -> int:
        """Return the number of other agents whose answers the agent has not counted yet."""
        return len(self._states.others) - len(snapshot["reconcile_responders"])

    def _check_that_it_ends_alike(self, local: int, settled: int) -> None:
        """Raise ReductionError if the simplification changes the result of a timer expiry."""
        if settled != local and any(
            self._settled_ends(local, timer) != self._settled_ends(settled, timer)
            for timer in self._states.known[local].running
        ):
            raise ReductionError("an agent uses a tally in an unknown way: try again with --whole")

    def _settled_ends(self, local: int, timer: int) -> set[AgentStep]:
        return {end.step._replace(local=self.settled(end.step.local)) for end in self._ends(local, timer)}
