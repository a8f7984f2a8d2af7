"""Run a mission that a test controls. Each action of the test is added to the timeline during the run.

The test and the mission run in different threads. Real processes therefore continue, and vehicles fly, while the test
computes or stops in a debugger. Each action that changes the swarm or the network becomes an entry of the scenario's
timeline. The entry is validated like any other entry, and the recorded scenario can be run again.
"""

import asyncio
import math
from collections.abc import Awaitable, Callable, Iterable
from concurrent.futures import Future
from typing import Any

from pydantic import ValidationError

from harness.errors import ScenarioError
from harness.play import mission
from harness.play.interventions import INSTANT_S, GrowingTimeline
from harness.play.mission import RunOutcome, SoughtRun
from harness.scenario import Scenario
from harness.scenario.changes import timeline_of
from harness.scenario.load import explain
from harness.scenario.timeline import TimelineEntry
from ucp.agent import HANDLERS

HOLDABLE = ("message", "sender", "receiver", "block", "count")
"""Keys of an entry in `fates` that select the messages to hold back."""
LOOK_EVERY_S = 5.0
"""Mission seconds between two checks whether all agents have voted."""

HANDLER_BRANCHES = {name: handler.branches for name, handler in HANDLERS.items()}

Action = Callable[[mission.Swarm], Awaitable[Any]]


class LiveTimeline(GrowingTimeline):
    """The object that runs a mission and performs the actions of the test.

    `play` runs in the thread of the event loop. `started` is set when the mission begins. `queue_action` queues an
    action.
    """

    def __init__(self, scenario: Scenario) -> None:
        super().__init__(scenario)
        self.started: Future[Any] = Future()
        self._actions: asyncio.Queue[tuple[Action, Future[Any]] | None] = asyncio.Queue()
        self._holds: dict[int, dict[str, Any]] = {}
        """Number of an active hold (a rule that holds messages back) -> the keys that select its messages."""
        self._completed: dict[int, int] = {}
        """Agent ID -> number of blocks that the agent had completed at the last action."""

    async def play(self, swarm: mission.Swarm, scenario: Scenario) -> None:
        first, *_ = timeline_of(scenario)
        await swarm.begin(first)
        swarm.enter("mission")
        self.started.set_result(None)
        while queued := await self._actions.get():
            action, answer = queued
            try:
                result = await action(swarm)
            except ScenarioError as error:  # a mistake of the test, which may continue
                answer.set_exception(error)
            else:
                answer.set_result(result)
        await self.release(swarm)

    def queue_action(self, action: Action, answer: Future[Any]) -> None:
        """Queue an action. `answer` receives the result or the error of the action, unless the run ends before the
        action.
        """
        self._actions.put_nowait((action, answer))

    def stop(self) -> None:
        """Reject all further actions of the test."""
        self._actions.put_nowait(None)

    async def change(self, swarm: mission.Swarm, **entry: Any) -> float:
        """Apply a timeline entry now, and return its `at_s`. Raises ScenarioError if that is impossible."""
        at_s = self.next_instant(swarm)
        before, document = self.scenario, self.scenario.model_dump()
        document["timeline"].append({"at_s": at_s, **entry})
        document["duration_s"] = max(self.scenario.duration_s, _entry(at_s, entry).ends_at_s)
        self.replace_scenario(document)
        try:
            await self.until(swarm, at_s)
        except ScenarioError:  # the backend does not support it
            self.scenario = before
            raise
        self._completed = await swarm.completed()
        return at_s

    async def undo(self, swarm: mission.Swarm, at_s: float) -> None:
        """End the network change that began at `at_s`. Do nothing if the change has ended already."""
        document = self.scenario.model_dump()
        (entry,) = (entry for entry in document["timeline"] if entry["at_s"] == at_s)
        over_s = _next_instant(max(swarm.now(), self._played_s))
        for_s = round(over_s - at_s, 3)
        if entry["for_s"] is not None and entry["for_s"] <= for_s:
            return
        entry["for_s"] = for_s
        document["duration_s"] = max(self.scenario.duration_s, over_s)
        try:
            self.replace_scenario(document)
        except ScenarioError:
            raise ScenarioError(
                "the `with` block cannot undo its change, because the same condition was changed inside it for a "
                "longer time: give that change its own `with` block, or a `for_s` that ends earlier"
            ) from None
        await self.until(swarm, over_s)
        self._completed = await swarm.completed()

    async def hold(self, swarm: mission.Swarm, **which: Any) -> int:
        """Hold back matching messages from now on. Return the number of the new rule, which `let_go` needs. Raises
        ScenarioError.
        """
        if unknown := next((key for key in which if key not in HOLDABLE), None):
            raise ScenarioError(f"`{unknown}` is unknown: use one of {', '.join(HOLDABLE)}")
        if which in self._holds.values():
            raise ScenarioError(f"{_in_words(which)} is held already")
        now = swarm.now()
        document = self.scenario.model_dump()
        document["fates"].append({**which, "from_s": _next_instant(now), **_until(_next_instant(now + INSTANT_S))})
        before = self.scenario
        self.replace_scenario(document)
        try:
            number = await swarm.hold(self.scenario.fates[-1])
        except ScenarioError:  # the backend does not support it
            self.scenario = before
            raise
        self._holds[number] = which
        return number

    async def release(self, swarm: mission.Swarm, **which: Any) -> None:
        """Deliver the messages that the rule with these keys holds back. If no keys are given, deliver the messages of
        all rules. Raises ScenarioError if no rule has these keys.
        """
        if which and which not in self._holds.values():
            held = ", ".join(map(_in_words, self._holds.values())) or "nothing"
            raise ScenarioError(f"{_in_words(which)} is not held; held: {held}")
        for number in [number for number, held in self._holds.items() if which in ({}, held)]:
            await self.let_go(swarm, number)

    async def let_go(self, swarm: mission.Swarm, number: int) -> None:
        """Deliver the messages that the hold with this number holds back, if it is still active."""
        if self._holds.pop(number, None) is None:
            return
        document = self.scenario.model_dump()
        fate = document["fates"][number]
        fate |= _until(_next_instant(max(swarm.now(), fate["from_s"])))
        self.replace_scenario(document)
        await swarm.release(number, self.scenario.fates[number])

    async def until_run(self, swarm: mission.Swarm, sought: SoughtRun, limit_s: float) -> int | None:
        """Continue until an agent runs this handler and takes this branch. Return the agent's ID, or None if no agent
        does this by `limit_s`.

        Raises ScenarioError for an unknown handler, branch or agent.
        """
        self._check(sought)
        end_s = swarm.now() + limit_s
        while swarm.now() <= end_s:
            coming = (change.at_s for change in timeline_of(self.scenario) if change.at_s > self._played_s)
            next_s = min([end_s, *coming])
            if (agent := await swarm.until_run(sought, next_s)) is not None:
                return agent
            await self.until(swarm, next_s)
            if next_s == end_s:
                break
        return None

    def _check(self, sought: SoughtRun) -> None:
        if sought.handler not in list(HANDLER_BRANCHES):
            raise ScenarioError(f"no handler {sought.handler!r}: use one of {', '.join(HANDLER_BRANCHES)}")
        branches = HANDLER_BRANCHES[sought.handler]
        by_the_book = not self.scenario.foreign and not self.scenario.has_wrong_agents
        if by_the_book and sought.branch is not None and sought.branch not in branches:
            named = ", ".join(map(repr, branches))
            raise ScenarioError(f"{sought.handler} has no branch {sought.branch!r}: use one of {named}")
        if sought.agent is not None and sought.agent not in self.scenario.roster:
            raise ScenarioError(f"no agent {sought.agent!r}: use one of {_ids(self.scenario.roster)}")

    async def from_now_until(self, swarm: mission.Swarm, mission_s: float) -> None:
        """Continue until `mission_s`. Raises ScenarioError if that time has passed or is infinite."""
        if not swarm.now() <= mission_s < math.inf:
            raise ScenarioError(f"a mission cannot run until {mission_s:g} s: it is at {swarm.now():g} s")
        await self.until(swarm, mission_s)

    async def until_idle(self, swarm: mission.Swarm, limit_s: float) -> RunOutcome | None:
        """Continue until all agents have voted since the last action and are idle. Return the state of the run. Return
        None if the agents are not idle by `limit_s`.

        The method reads the state at a time when no chain changes, because real processes continue to run. The method
        waits for votes, because an agent detects only by a vote that its chain differs from other chains (Section 3.2).
        """
        end_s = swarm.now() + limit_s
        while any(
            blocks <= self._completed.get(agent, 0)
            for agent, blocks in (await swarm.completed()).items()
            if agent not in self._silent()
        ):
            if swarm.now() >= end_s:
                return None
            await self.until(swarm, min(end_s, swarm.now() + LOOK_EVERY_S))
        while await swarm.until_idle(end_s - swarm.now()):
            chains = await swarm.top_chain_hashes()
            played = await swarm.snapshot()
            busy = any(agent.idle is False for agent in played.agents.values())
            if not busy and await swarm.top_chain_hashes() == chains:
                return played
        return None

    def _silent(self) -> set[int]:
        """Return the agents that log no more events. They will not vote on a block of their own again."""
        silent: set[int] = set()
        for fault in self.scenario.faults_in_order():
            if fault.stops_events:
                silent.update(fault.agents)
            elif fault.begins_incarnation:
                silent.difference_update(fault.agents)
        return silent

    async def end(self, swarm: mission.Swarm, *, reconcile_finally: bool) -> None:
        """End the mission if it still runs. Raises ScenarioError if a second final reconcile is requested."""
        if swarm.played.final_reconcile is not None:
            if reconcile_finally:
                raise ScenarioError("the final reconcile is over: a mission has one, at its end")
            return
        await self.release(swarm)
        if not self.scenario.schedule:  # a schedule lasts for the planned mission
            last_s = max([0.0, *(entry.ends_at_s for entry in self.scenario.timeline)])
            await self.until(swarm, last_s)  # agents restart, and temporary changes end
            self._set(duration_s=max(swarm.now(), INSTANT_S))
        self._set(final_reconcile=reconcile_finally or self.scenario.final_reconcile)
        await mission.settle(swarm, self.scenario)

    async def break_off(self, swarm: mission.Swarm) -> None:
        """End the mission now, because the test failed. The recorded scenario also ends now, unless a change in its
        timeline lasts longer or it has a schedule. In these cases, its duration stays the same.
        """
        await self.release(swarm)
        lasts_s = max([0.0, *(entry.ends_at_s for entry in self.scenario.timeline)])
        ended = swarm.played.settled or swarm.played.final_reconcile is not None
        if not ended and not self.scenario.schedule and lasts_s <= swarm.now():
            settle = self.scenario.settle.model_copy(update={"limit_s": INSTANT_S})
            self._set(duration_s=max(swarm.now(), INSTANT_S), settle=settle, final_reconcile=False)

    def _set(self, **keys: Any) -> None:
        self.scenario = self.scenario.model_copy(update=keys)


def _next_instant(mission_s: float) -> float:
    """Return a slightly later mission second. All messages that agents sent until now have left by then."""
    return round(mission_s + INSTANT_S, 3)


def _until(mission_s: float) -> dict[str, float]:
    return {"until_s": mission_s, "hold_until_s": mission_s}


def _in_words(which: dict[str, Any]) -> str:
    """Return the keys as text in the notation that a test uses."""
    return ", ".join(f"{key}={value!r}" for key, value in which.items()) or "every message"


def _ids(agents: Iterable[int]) -> str:
    return ", ".join(map(str, agents))


def _entry(at_s: float, keys: dict[str, Any]) -> TimelineEntry:
    """Return a validated timeline entry. Raises ScenarioError."""
    try:
        return TimelineEntry.model_validate({"at_s": at_s, **keys})
    except ValidationError as error:
        raise ScenarioError(explain(error, TimelineEntry)) from None
