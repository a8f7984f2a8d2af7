"""Prove that a simulated swarm repeats a cycle forever. In a cycle, the state of all agents recurs, and no input from
outside the swarm follows.

The search compares the swarm at moments without messages in flight, just before the next timer expires. A state
consists of the protocol state of every agent, its timers relative to this moment, and the order of the timers. From
this moment on, only timers cause further steps. If the state recurs, it recurs forever, provided that the random draws
of the network have no effect. They have no effect if each message certainly arrives or certainly does not, and one of
these conditions is met:

- All messages take the same time.
- Each message and its answers arrive before the next timer expires, and agents only answer or count them.

Otherwise the recurrence proves nothing. For runs without a proof, `harness.checker.recurring_cycles` searches for
cycles in the traces.

The search uses Brent's algorithm. It keeps one state and compares it with the following ones, then keeps a later state
and compares it with twice as many states. Its memory therefore does not grow with the length of the run.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from harness.archive.run_record import Cycle, CycleStep, CycleWait
from ucp.agent import ON_TIMER
from ucp.state import AgentState

CHECK_AFTER_S = 120.0
"""Mission seconds after which the search for a cycle starts. Most swarms become idle earlier, so the search usually
takes no computing time.
"""
SAME_INSTANT_S = 1e-6
MAX_STEPS = 1000
"""Maximum number of steps of a cycle that the record lists."""


@dataclass(frozen=True, slots=True)
class AgentAtRest:
    """The state of an agent at a moment at which no message is in transit."""

    state: AgentState
    local_s: float
    """The time on this agent's clock when the next timer of any agent expires."""
    wakes_s: float | None
    """Mission second at which this agent's next timer expires, or None if no timer runs."""


class RecurrenceSearch:
    """The search for a repeated state of the swarm. The simulation calls `check` whenever no message is in transit.

    `delays` are the minimum and the maximum delay of a message, in seconds.
    """

    def __init__(self, delays: tuple[float, float]) -> None:
        soonest, self._latest = delays
        self._equal_delays = soonest == self._latest
        self._kept: object = None
        self._kept_at = 0.0
        self._checks_left = 1
        self._keep_for = 1
        self._next_s = 0.0
        self._state_after_timers: object = None
        self._reset()

    def _reset(self) -> None:
        self._steps: list[CycleStep] = []
        self._answered_by: dict[int, set[int]] = defaultdict(set)
        """A set for each agent in a reconcile, by agent ID. It contains the agents that have answered its queries since
        the last state was stored.
        """
        self._order_is_certain = True
        """False if two timers expire so close to each other that rounding may decide their order."""
        self._delays_matter = False

    def check(
        self, swarm: Sequence[AgentAtRest], order: Sequence[object], fates: tuple[int, ...], fate_at: float
    ) -> bool:
        """Return true if the swarm repeats a cycle. Call this only while no message is in transit and at least one
        timer runs.

        - `order`: order of the next timer expiries. For an agent with late timers, it also contains the order of the
          agent's own timers.
        - `fates`: number of messages that each scripted fate has matched.
        - `fate_at`: time at which a fate last changed the delivery of a message.
        """
        wakes = sorted(agent.wakes_s for agent in swarm if agent.wakes_s is not None)
        if wakes[0] <= self._next_s + 2 * self._latest or self._state_after_timers != _changeable_by_messages(swarm):
            self._delays_matter = True
        if any(0 < later - sooner < SAME_INSTANT_S for sooner, later in pairwise(wakes)):
            self._order_is_certain = False
        self._next_s = wakes[0]
        state = (*map(_state, swarm), *order, fates)
        delays_matter = not self._equal_delays and (self._delays_matter or fate_at >= self._kept_at)
        time_has_passed = self._next_s > self._kept_at  # two checks before the same end of a timer compare equal
        if state == self._kept and time_has_passed and self._order_is_certain and not delays_matter:
            return True
        self._checks_left -= 1
        if not self._checks_left:
            self._keep_for *= 2
            self._checks_left = self._keep_for
            self._kept, self._kept_at = state, self._next_s
            self._reset()
        return False

    def record_timer_ends(self, now: float, local_s: float, state: AgentState) -> None:
        """Record that timers of this agent are about to expire. The agent must already have counted all answers that
        have arrived.
        """
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

    def record_state_after_timers(self, swarm: Sequence[AgentAtRest]) -> None:
        """Record the state of the swarm after all timers of this moment have expired, and before the resulting messages
        arrive.
        """
        self._state_after_timers = _changeable_by_messages(swarm)

    def cycle(self, swarm: Sequence[AgentAtRest]) -> Cycle:
        """Return the cycle that the last call of `check` found."""
        agents = {agent.state.agent_id for agent in swarm}
        acted = {step.agent_id for step in self._steps}
        return Cycle(
            since_s=round(self._kept_at, 3),
            period_s=round(self._next_s - self._kept_at, 3),
            proven=True,
            agents=sorted(acted | {agent.state.agent_id for agent in swarm if not agent.state.idle}),
            steps=self._steps,
            waits=[
                CycleWait(agent_id=agent_id, for_agents=sorted(silent))
                for agent_id, answered in sorted(self._answered_by.items())
                if (silent := agents - answered - {agent_id})
            ],
        )


def _changeable_by_messages(swarm: Sequence[AgentAtRest]) -> list[object]:
    """Return the parts of the agents' states that messages can change, except the counts of answers."""
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


def _state(agent: AgentAtRest) -> tuple[object, ...]:
    """Return the part of the agent's state that determines its next steps. Times are relative to the agent's clock."""
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
