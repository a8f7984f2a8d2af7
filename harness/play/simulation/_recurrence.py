"""Whether a swarm in virtual time goes round in circles: its global state recurs, and nothing else is to come.

Looked at are the moments in which nothing is on its way, each as it is when the next timer is about to end: the
protocol state of every agent, its timers relative to that moment, and their order. Only timers make the swarm go on
from there. If such a state comes again it comes again for ever, unless lots decide otherwise. They do not where every
message surely arrives, or never does, and besides

- takes as long as any other; or
- has arrived, and the answers to it, before the next timer of anybody ends, and has only been answered or tallied:
  then nothing depends on when it came.

Only then the recurrence is a proof. Other cycles show in the traces (`harness.checker.recurring_cycles`).

One state is kept and compared with all that follow, then a later one with twice as many (Brent's algorithm), so that a
swarm that goes on for days takes no more memory than one that goes on for minutes.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from harness.archive.run_record import Cycle, CycleStep, CycleWait
from ucp.agent import ON_TIMER
from ucp.state import AgentState

LOOK_AFTER_S = 120.0
"""For so many mission seconds a swarm that has no more to log may take its time before anybody looks."""
SAME_INSTANT_S = 1e-6
MAX_STEPS = 1000
"""More steps of a cycle than anyone reads are not named."""


@dataclass(frozen=True, slots=True)
class Waiting:
    """An agent in whose way nothing is: `local_s` is what its clock shows when the next timer of anybody ends.

    `wakes_s` is when its own next timer ends, in mission seconds; None if none runs.
    """

    state: AgentState
    local_s: float
    wakes_s: float | None


class Recurrence:
    """Is shown the swarm whenever nothing is on its way, and tells when it has seen all that will ever be.

    `delays`: how soon and how late any message surely arrives, in seconds.
    """

    def __init__(self, delays: tuple[float, float]) -> None:
        soonest, self._latest = delays
        self._all_alike = soonest == self._latest
        self._kept: object = None
        self._kept_at = 0.0
        self._looks_left = 1
        self._keep_for = 1
        self._next_s = 0.0
        self._as_timers_left_it: object = None
        self._begin_anew()

    def _begin_anew(self) -> None:
        self._steps: list[CycleStep] = []
        self._answered_by: dict[int, set[int]] = defaultdict(set)
        """Agent that asked, in a reconcile -> those who answered, since the state that is kept."""
        self._told_apart = True
        """Whether no two timers ended so close to each other that rounding decides which was first."""
        self._delays_matter = False

    def look(self, swarm: Sequence[Waiting], order: Sequence[object], fates: tuple[int, ...], fate_at: float) -> bool:
        """Whether the swarm has been here before, and always comes back. Nothing is on its way, and some timer runs.

        `order` is that in which timers end, of one agent's, too, if it matters. `fates` is how far they have counted,
        and `fate_at` when one last decided.
        """
        wakes = sorted(agent.wakes_s for agent in swarm if agent.wakes_s is not None)
        if wakes[0] <= self._next_s + 2 * self._latest or self._as_timers_left_it != _what_messages_may_change(swarm):
            self._delays_matter = True
        if any(0 < later - sooner < SAME_INSTANT_S for sooner, later in pairwise(wakes)):
            self._told_apart = False
        self._next_s = wakes[0]
        state = (*map(_state, swarm), *order, fates)
        delays_matter = not self._all_alike and (self._delays_matter or fate_at >= self._kept_at)
        time_has_passed = self._next_s > self._kept_at  # who looks twice in the same wait sees the same
        if state == self._kept and time_has_passed and self._told_apart and not delays_matter:
            return True
        self._looks_left -= 1
        if not self._looks_left:
            self._keep_for *= 2
            self._looks_left = self._keep_for
            self._kept, self._kept_at = state, self._next_s
            self._begin_anew()
        return False

    def timers_end(self, now: float, local_s: float, state: AgentState) -> None:
        """Timers of an agent are about to end, after all answers have been tallied."""
        if now != self._next_s:
            self._delays_matter = True
        for timer in state.timers:
            if timer.deadline is not None and timer.deadline <= local_s and len(self._steps) < MAX_STEPS:
                after_s = round(now - self._kept_at, 3)
                self._steps.append(
                    CycleStep(agent_id=state.agent_id, after_s=after_s, handler=ON_TIMER[timer.name].name)
                )
        if state.phase_one_timer.active or state.phase_two_timer.active:
            self._answered_by[state.agent_id] |= state.reconcile_responders

    def timers_have_ended(self, swarm: Sequence[Waiting]) -> None:
        """All timers that end in this instant have; what they sent has not arrived yet."""
        self._as_timers_left_it = _what_messages_may_change(swarm)

    def cycle(self, swarm: Sequence[Waiting]) -> Cycle:
        """Return the cycle that the last look has found."""
        agents = {agent.state.agent_id for agent in swarm}
        went_on = {step.agent_id for step in self._steps}
        return Cycle(
            since_s=round(self._kept_at, 3),
            period_s=round(self._next_s - self._kept_at, 3),
            proven=True,
            agents=sorted(went_on | {agent.state.agent_id for agent in swarm if not agent.state.idle}),
            steps=self._steps,
            waits=[
                CycleWait(agent_id=agent_id, for_agents=sorted(silent))
                for agent_id, answered in sorted(self._answered_by.items())
                if (silent := agents - answered - {agent_id})
            ],
        )


def _what_messages_may_change(swarm: Sequence[Waiting]) -> list[object]:
    """Of what messages do to an agent all but what they are there to be tallied for."""
    return [
        (
            state.chain.top_chain_hash,
            len(state.blocks_to_be_committed),
            len(state.reconcile_stack),
            state.reconcile_in_progress,
            [timer.deadline for timer in state.timers],
        )
        for state in (agent.state for agent in swarm)
    ]


def _state(agent: Waiting) -> tuple[object, ...]:
    """All that the agent's next steps depend on; times are relative to its clock."""
    state = agent.state
    return (
        state.agent_id,
        state.chain.top_chain_hash,
        len(state.chain),
        tuple(block.block_hash for block in state.blocks_to_be_committed),
        tuple(block.block_hash for block in state.reconcile_stack),
        tuple(None if timer.deadline is None else round(timer.deadline - agent.local_s, 6) for timer in state.timers),
        state.candidate_block and state.candidate_block.block_hash,
        state.top_chain_hash_at_initiation,
        tuple(state.vote_count.values()),
        frozenset(state.voters),
        state.reconcile_in_progress,
        tuple(state.reconcile_vote_count.values()),
        frozenset(state.reconcile_responders),
        frozenset((candidate, *counted) for candidate, counted in state.reconcile_response_dictionary.items()),
        state.majority_response_block_hash,
    )
