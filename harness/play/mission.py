"""Carry out a mission with any backend.

The class `Swarm` is the interface of a backend. During a mission, the harness applies the timeline. It then stops the
logging of events, and waits until the agents are idle. If the scenario asks for a final reconcile, the mission ends
with this reconcile.
"""

from collections.abc import Awaitable, Callable, Mapping
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

from harness.archive.run_record import (
    AgentRecord,
    CapturedFrames,
    ChannelRecord,
    Counters,
    Cycle,
    DatagramsRead,
    FaultRecord,
    FinalReconcile,
    GroundStationRecord,
    NetworkState,
    RemoteRecord,
)
from harness.archive.traces import Trace
from harness.errors import HarnessError, UnsupportedError
from harness.scenario import Scenario
from harness.scenario.changes import RANGE, Change, final_reconcile, timeline_of
from harness.scenario.fates import Fate
from ucp.trace import HandlerRun

MAX_FINAL_ROUNDS = 20
"""Maximum number of rounds of a final reconcile. In each round every agent reconciles once."""

Outcome = Literal["completed", "interrupted", "failed", "not supported"]


@dataclass
class RunOutcome:
    """The result of a mission, before the checker judges this result."""

    outcome: Outcome = "completed"
    outcome_detail: str | None = None
    exit_status: int = 0
    engine: str | None = None
    network: list[NetworkState] = field(default_factory=list)
    faults: list[FaultRecord] = field(default_factory=list)
    final_reconcile: FinalReconcile | None = None
    mission_s: float = 0.0
    settled: bool = False
    cycle: Cycle | None = None
    counters: Counters | None = None
    datagrams: dict[str, DatagramsRead] = field(default_factory=dict)
    channel: ChannelRecord | None = None
    """The counts of frames on a shared channel, or None if the run has no such channel."""
    capture: dict[str, CapturedFrames] | None = None
    agents: dict[str, AgentRecord] = field(default_factory=dict)
    vehicles: dict[str, dict[str, Any]] = field(default_factory=dict)
    ground_station: GroundStationRecord | None = None
    remote: dict[str, RemoteRecord] = field(default_factory=dict)
    unmatched_fates: list[str] = field(default_factory=list)
    traces: dict[int, Trace] | None = field(default=None, repr=False)  # asyncio builds the text of a result
    """The trace of each agent, with the same content as the files in the run directory. The value is None if the traces
    are only in files.
    """

    def end_early(self, outcome: Outcome, error: HarnessError) -> None:
        """Record that the mission ended early because of `error`."""
        self.outcome = "not supported" if isinstance(error, UnsupportedError) else outcome
        self.outcome_detail = str(error)
        self.exit_status = error.exit_status

    def record(self, change: Mapping[str, object]) -> None:
        """Record a network change, a fault or an injection. The record has the format of a line of `network.jsonl`. A
        movement of vehicles is recorded only if it changes which vehicles can receive each other.
        """
        if "fully_connected" in change:
            state = NetworkState.model_validate(change)
            if state.what == RANGE and self.network and _same_connections(state, self.network[-1]):
                return
            self.network.append(state)
        if change["what"] != "start":
            self.faults.append(FaultRecord.model_validate(change))


@dataclass(frozen=True)
class SoughtRun:
    """A handler run for which a caller waits."""

    handler: str
    branch: str | None = None
    """The branch of the handler run. If it is None, every branch matches."""
    agent: int | None = None
    """The ID of the agent. If it is None, every agent matches."""

    def matches(self, agent_id: int, run: HandlerRun) -> bool:
        """Return true if the handler run matches this description."""
        return run.handler == self.handler and self.branch in (None, run.branch) and self.agent in (None, agent_id)


def _same_connections(now: NetworkState, before: NetworkState) -> bool:
    return (now.what, now.detail, now.fully_connected) == (before.what, before.detail, before.fully_connected)


class Swarm(Protocol):
    """The interface to the agents of a mission. All times are mission seconds."""

    played: RunOutcome

    def now(self) -> float: ...

    def enter(self, stage: str) -> None:
        """Show the current stage of the mission to the user."""

    async def begin(self, first: Change) -> None:
        """Apply the initial conditions, start all agents, and start the clock of the mission."""

    async def until(self, mission_s: float) -> None: ...

    async def until_run(self, sought: SoughtRun, mission_s: float) -> int | None:
        """Wait until an agent runs this handler, but at most until `mission_s`.

        Return the ID of the agent. Return None if no agent ran the handler. The wait also ends at once if the last
        change of the timeline has already caused such a handler run. With processes, each handler run since the last
        call of `until` counts, too.
        """

    async def apply(self, change: Change) -> None:
        """Apply a network change, a fault or an injection, and record it in `played`."""

    async def hold(self, fate: Fate) -> int:
        """Hold back the messages that match `fate` and are sent at `fate.from_s` or later. Return the number of this
        hold, for the method `release`. Raises ScenarioError if this backend cannot hold messages.
        """

    async def release(self, number: int, fate: Fate) -> None:
        """End the hold (a rule that delays messages) with this number. Its messages that are sent before `fate.until_s`
        arrive at `fate.hold_until_s` or later.
        """

    async def stop_events(self) -> None: ...

    async def until_idle(self, limit_s: float) -> bool:
        """Wait until all living agents are idle and no message is in transit. Return false if this takes longer than
        `limit_s` mission seconds.
        """

    async def keep_chains(self) -> None:
        """Export all chains, before the final reconcile changes them."""

    async def reconcile(self, agent_id: int) -> None:
        """Let the agent begin a reconcile."""

    async def top_chain_hashes(self) -> dict[int, str]:
        """Return the top chain hash of each living agent."""

    async def completed(self) -> dict[int, int]:
        """Return the number of completed blocks of each agent. Dead and paused agents are omitted."""

    async def snapshot(self) -> RunOutcome:
        """Return the result of an active run so far, with exports and traces, so that the checker can judge it."""


Story = Callable[[Swarm, Scenario], Awaitable[None]]
"""A function that carries out a mission with a swarm, from start to end."""


async def play(swarm: Swarm, scenario: Scenario) -> None:
    """Carry out the mission with the agents of `swarm`. Afterwards, `swarm.played` contains the result."""
    first, *changes = timeline_of(scenario)
    await swarm.begin(first)
    swarm.enter("mission")
    for change in changes:
        await swarm.until(change.at_s)
        await swarm.apply(change)
    await swarm.until(scenario.duration_s)
    await settle(swarm, scenario)


async def play_on(opening: AbstractAsyncContextManager[Swarm], scenario: Scenario, story: Story = play) -> RunOutcome:
    """Start the agents, carry out the mission with the function `story`, and return the result."""
    async with opening as swarm:
        await story(swarm, scenario)
    return swarm.played


async def settle(swarm: Swarm, scenario: Scenario) -> None:
    """End a mission: stop the events, wait until the agents are idle, and carry out a final reconcile if the scenario
    asks for it.
    """
    swarm.enter("settling")
    await swarm.stop_events()
    swarm.played.settled = await swarm.until_idle(scenario.settle.limit_s)
    if scenario.final_reconcile:
        await reconcile_finally(swarm, scenario.settle.limit_s)


async def reconcile_finally(swarm: Swarm, limit_s: float) -> None:
    """Remove all network conditions. Then let each agent in turn reconcile, and repeat this until no chain changes in a
    round.
    """
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
