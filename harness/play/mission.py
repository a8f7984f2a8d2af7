"""The story of a mission, whichever backend runs the agents: a `Swarm` is what a backend must be able to do.

Play the timeline, stop the events, let the agents settle, and reconcile finally if the scenario asks for it.
"""

from collections.abc import Awaitable, Callable
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

from harness.archive.run_record import Cycle, FinalReconcile
from harness.errors import HarnessError, UnsupportedError
from harness.scenario import Scenario
from harness.scenario.changes import RANGE, Change, final_reconcile, timeline_of
from harness.scenario.fates import Fate
from ucp.trace import HandlerRun

MAX_FINAL_ROUNDS = 20
"""Bound on the rounds of a final reconcile; each lets every agent reconcile once."""

Outcome = Literal["completed", "interrupted", "failed", "not supported"]


@dataclass
class RunOutcome:
    """What became of a run, before anybody judges it."""

    outcome: Outcome = "completed"
    outcome_detail: str | None = None
    exit_status: int = 0
    engine: str | None = None
    network: list[dict[str, Any]] = field(default_factory=list)
    faults: list[dict[str, Any]] = field(default_factory=list)
    final_reconcile: FinalReconcile | None = None
    mission_s: float = 0.0
    settled: bool = False
    cycle: Cycle | None = None
    counters: dict[str, Any] | None = None
    datagrams: dict[str, dict[str, int]] = field(default_factory=dict)
    channel: dict[str, Any] | None = None
    """Frames on a shared channel."""
    capture: dict[str, dict[str, int]] | None = None
    agents: dict[str, Any] = field(default_factory=dict)
    vehicles: dict[str, Any] = field(default_factory=dict)
    ground_station: dict[str, Any] | None = None
    unmatched_fates: list[str] = field(default_factory=list)

    def end_early(self, outcome: Outcome, error: HarnessError) -> None:
        """The mission did not end normally, because of `error`."""
        self.outcome = "not supported" if isinstance(error, UnsupportedError) else outcome
        self.outcome_detail = str(error)
        self.exit_status = error.exit_status

    def record(self, change: dict[str, Any]) -> None:
        """Take down a change that was made; of those that flight makes, only who is connected to whom."""
        if change["what"] == RANGE and self.network and _same_connections(change, self.network[-1]):
            return
        if "fully_connected" in change:
            self.network.append(change)
        if change["what"] != "start":
            self.faults.append(change)


@dataclass(frozen=True)
class Sought:
    """A run of a handler that somebody waits for. None means any branch, or any agent."""

    handler: str
    branch: str | None = None
    agent: int | None = None

    def is_met_by(self, agent_id: int, run: HandlerRun) -> bool:
        return run.handler == self.handler and self.branch in (None, run.branch) and self.agent in (None, agent_id)


def _same_connections(now: dict[str, Any], before: dict[str, Any]) -> bool:
    return all(now[key] == before[key] for key in ("what", "detail", "fully_connected"))


class Swarm(Protocol):
    """Agents that a mission is played with; times are mission seconds."""

    played: RunOutcome

    def now(self) -> float: ...

    def enter(self, stage: str) -> None:
        """Say to whoever watches what comes now."""

    async def begin(self, first: Change) -> None:
        """Start everybody, under these conditions, and with them the mission's clock."""

    async def until(self, mission_s: float) -> None: ...

    async def until_run(self, sought: Sought, mission_s: float) -> int | None:
        """As `until`, but no further than until an agent runs what is sought; its ID, None if nobody has.

        What came of the last change counts, too, and of real processes what has come since the last `until`.
        """

    async def apply(self, change: Change) -> None:
        """Make the change, and take it down in `played`."""

    async def hold(self, fate: Fate) -> int:
        """Hold back what fits the fate, from its `from_s` on, until `release`; the hold's number.

        Raises ScenarioError if messages cannot be held here.
        """

    async def release(self, number: int, fate: Fate) -> None:
        """End a hold: by now it is known until when it lasts, which is `until_s` and `hold_until_s` of `fate`."""

    async def stop_events(self) -> None: ...

    async def until_idle(self, limit_s: float) -> bool:
        """Wait until all living agents are idle and nothing is on its way; False if `limit_s` pass before."""

    async def keep_chains(self) -> None:
        """Keep the chains as they stand, before anybody puts them in order."""

    async def reconcile(self, agent_id: int) -> None:
        """Have the agent begin a reconcile."""

    async def top_chain_hashes(self) -> dict[int, str]:
        """Of every living agent."""

    async def completed(self) -> dict[int, int]:
        """How many blocks of its own each agent has completed that is neither dead nor paused."""

    async def snapshot(self) -> RunOutcome:
        """What has been played by now, with exports and traces up to now, for whoever judges a run that goes on."""


Story = Callable[[Swarm, Scenario], Awaitable[None]]
"""What a swarm is led through, from its beginning to its end."""


async def play(swarm: Swarm, scenario: Scenario) -> None:
    """Play the mission with `swarm`; `swarm.played` tells how it went."""
    first, *changes = timeline_of(scenario)
    await swarm.begin(first)
    swarm.enter("mission")
    for change in changes:
        await swarm.until(change.at_s)
        await swarm.apply(change)
    await swarm.until(scenario.duration_s)
    await settle(swarm, scenario)


async def play_on(opening: AbstractAsyncContextManager[Swarm], scenario: Scenario, story: Story = play) -> RunOutcome:
    """Lead the swarm that opens through the story; what became of it."""
    async with opening as swarm:
        await story(swarm, scenario)
    return swarm.played


async def settle(swarm: Swarm, scenario: Scenario) -> None:
    """The end of a mission: no more events; the agents finish, and reconcile finally if the scenario asks for it."""
    swarm.enter("settling")
    await swarm.stop_events()
    swarm.played.settled = await swarm.until_idle(scenario.settle.limit_s)
    if scenario.final_reconcile:
        await reconcile_finally(swarm, scenario.settle.limit_s)


async def reconcile_finally(swarm: Swarm, limit_s: float) -> None:
    """Clear all conditions and let one agent after another reconcile, until a round changes no chain."""
    await swarm.keep_chains()
    swarm.enter("final reconcile")
    began_s = swarm.now()
    done = swarm.played.final_reconcile = FinalReconcile(at_s=round(began_s, 3), rounds=0, complete=False)
    await swarm.apply(final_reconcile(began_s))
    for number in range(1, MAX_FINAL_ROUNDS + 1):
        before = await swarm.top_chain_hashes()
        for agent_id in before:
            await swarm.reconcile(agent_id)
            if not await swarm.until_idle(limit_s):
                return
        done.rounds = number
        if await swarm.top_chain_hashes() == before:
            done.complete = True
            return
