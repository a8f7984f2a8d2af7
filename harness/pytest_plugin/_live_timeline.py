"""A mission that is told while it is played: a timeline that grows, sentence by sentence.

The sentences come from another thread than that of the mission's loop, so that real processes are watched, and vehicles
flown, while a test thinks or somebody looks at it in a debugger. Each sentence that changes something becomes an entry
of the scenario's timeline: it is checked as an entry is, and what was told can be played again.
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
from harness.play.mission import RunOutcome, Sought
from harness.scenario import Scenario
from harness.scenario.changes import timeline_of
from harness.scenario.load import explain
from harness.scenario.timeline import TimelineEntry
from ucp.agent import HANDLERS

HOLDABLE = ("message", "sender", "receiver", "block", "count")
"""Keys of a fate that say which messages it is about."""
LOOK_EVERY_S = 5.0
"""Mission seconds between two looks at who has voted."""

HANDLER_BRANCHES = {name: handler.branches for name, handler in HANDLERS.items()}

Sentence = Callable[[mission.Swarm], Awaitable[Any]]


class Told(GrowingTimeline):
    """Play its `story`, wait until it has `begun`, then let it `hear` what happens, in the thread that plays it."""

    def __init__(self, scenario: Scenario) -> None:
        super().__init__(scenario)
        self.begun: Future[Any] = Future()
        self._sentences: asyncio.Queue[tuple[Sentence, Future[Any]] | None] = asyncio.Queue()
        self._holds: dict[int, dict[str, Any]] = {}
        """What is held back, as it was told, by the number of its fate."""
        self._completed: dict[int, int] = {}
        """How many blocks each agent had completed when something was last told."""

    async def story(self, swarm: mission.Swarm, scenario: Scenario) -> None:
        first, *_ = timeline_of(scenario)
        await swarm.begin(first)
        swarm.enter("mission")
        self.begun.set_result(None)
        while asked := await self._sentences.get():
            sentence, answer = asked
            try:
                result = await sentence(swarm)
            except ScenarioError as mistake:  # of whoever tells, who may go on
                answer.set_exception(mistake)
            else:
                answer.set_result(result)
        await self.release(swarm)

    def hear(self, sentence: Sentence, answer: Future[Any]) -> None:
        """Take the next sentence. What it says, or a mistake in it, is set in `answer`, unless the run ends first."""
        self._sentences.put_nowait((sentence, answer))

    def stop(self) -> None:
        """There are no more sentences."""
        self._sentences.put_nowait(None)

    # Sentences

    async def change(self, swarm: mission.Swarm, **entry: Any) -> float:
        """Make this entry of a timeline happen now; its `at_s`. Raises ScenarioError if it cannot."""
        at_s = self.next_instant(swarm)
        before, document = self.scenario, self.scenario.model_dump()
        document["timeline"].append({"at_s": at_s, **entry})
        document["duration_s"] = max(self.scenario.duration_s, _entry(at_s, entry).ends_at_s)
        self.retell(document)
        try:
            await self.until(swarm, at_s)
        except ScenarioError:  # the backend cannot
            self.scenario = before
            raise
        self._completed = await swarm.completed()
        return at_s

    async def undo(self, swarm: mission.Swarm, at_s: float) -> None:
        """Have the entry with this `at_s`, which changes the network, last no longer than until now."""
        document = self.scenario.model_dump()
        (entry,) = (entry for entry in document["timeline"] if entry["at_s"] == at_s)
        over_s = _next_instant(max(swarm.now(), self._played_s))
        for_s = round(over_s - at_s, 3)
        if entry["for_s"] is not None and entry["for_s"] <= for_s:
            return
        entry["for_s"] = for_s
        document["duration_s"] = max(self.scenario.duration_s, over_s)
        try:
            self.retell(document)
        except ScenarioError:
            raise ScenarioError(
                "the `with` block cannot undo its change, because the same condition was changed inside it for a "
                "longer time: give that change its own `with` block, or a `for_s` that ends earlier"
            ) from None
        await self.until(swarm, over_s)
        self._completed = await swarm.completed()

    async def hold(self, swarm: mission.Swarm, **which: Any) -> int:
        """From now on hold back the messages that a fate with these keys is about; its number. Raises ScenarioError."""
        if unknown := next((key for key in which if key not in HOLDABLE), None):
            raise ScenarioError(f"`{unknown}` is unknown: use one of {', '.join(HOLDABLE)}")
        if which in self._holds.values():
            raise ScenarioError(f"{_in_words(which)} is held already")
        now = swarm.now()
        document = self.scenario.model_dump()
        document["fates"].append({**which, "from_s": _next_instant(now), **_until(_next_instant(now + INSTANT_S))})
        before = self.scenario
        self.retell(document)
        try:
            number = await swarm.hold(self.scenario.fates[-1])
        except ScenarioError:  # the backend cannot
            self.scenario = before
            raise
        self._holds[number] = which
        return number

    async def release(self, swarm: mission.Swarm, **which: Any) -> None:
        """Let go of what was held by these words, or of everything. Raises ScenarioError if there is no such hold."""
        if which and which not in self._holds.values():
            held = ", ".join(map(_in_words, self._holds.values())) or "nothing"
            raise ScenarioError(f"{_in_words(which)} is not held; held: {held}")
        for number in [number for number, held in self._holds.items() if which in ({}, held)]:
            await self.let_go(swarm, number)

    async def let_go(self, swarm: mission.Swarm, number: int) -> None:
        """End this hold, if nobody has."""
        if self._holds.pop(number, None) is None:
            return
        document = self.scenario.model_dump()
        fate = document["fates"][number]
        fate |= _until(_next_instant(max(swarm.now(), fate["from_s"])))
        self.retell(document)
        await swarm.release(number, self.scenario.fates[number])

    async def until_run(self, swarm: mission.Swarm, sought: Sought, limit_s: float) -> int | None:
        """Go on until an agent runs what is sought; its ID, or None if that takes longer. Raises ScenarioError."""
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

    def _check(self, sought: Sought) -> None:
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
        """As `until`. Raises ScenarioError if that is over, or never comes."""
        if not swarm.now() <= mission_s < math.inf:
            raise ScenarioError(f"a mission cannot run until {mission_s:g} s: it is at {swarm.now():g} s")
        await self.until(swarm, mission_s)

    async def until_idle(self, swarm: mission.Swarm, limit_s: float) -> RunOutcome | None:
        """Go on until everybody has voted since something was last told, and all are idle; None if that takes longer.

        What has been played by then is taken while nobody stirs: real processes go on. A vote is what makes an agent
        notice that its chain is another than the others' (Section 3.2).
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
            busy = any(agent.get("idle") is False for agent in played.agents.values())
            if not busy and await swarm.top_chain_hashes() == chains:
                return played
        return None

    def _silent(self) -> set[int]:
        """Agents that log nothing more, and so will never vote on a block of their own."""
        silent: set[int] = set()
        for fault in self.scenario.faults_in_order():
            if fault.stops_events:
                silent.update(fault.agents)
            elif fault.begins_a_life:
                silent.difference_update(fault.agents)
        return silent

    async def end(self, swarm: mission.Swarm, *, reconcile_finally: bool) -> None:
        """The end of the mission, if it has not been. Raises ScenarioError if a second final reconcile is asked for."""
        if swarm.played.final_reconcile is not None:
            if reconcile_finally:
                raise ScenarioError("the final reconcile is over: a mission has one, at its end")
            return
        await self.release(swarm)
        if not self.scenario.schedule:  # which lasts as long as the mission was meant to
            last_s = max([0.0, *(entry.ends_at_s for entry in self.scenario.timeline)])
            await self.until(swarm, last_s)  # agents come back, and what is for a while passes
            self._set(duration_s=max(swarm.now(), INSTANT_S))
        self._set(final_reconcile=reconcile_finally or self.scenario.final_reconcile)
        await mission.settle(swarm, self.scenario)

    async def break_off(self, swarm: mission.Swarm) -> None:
        """End the mission here, so that the recorded scenario ends at the moment at which the test failed.

        A scenario lasts at least as long as its timeline. If a change lasts longer, the recorded duration stays.
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
    """A little later: what is sent by then has been sent."""
    return round(mission_s + INSTANT_S, 3)


def _until(mission_s: float) -> dict[str, float]:
    return {"until_s": mission_s, "hold_until_s": mission_s}


def _in_words(which: dict[str, Any]) -> str:
    """As a test says it."""
    return ", ".join(f"{key}={value!r}" for key, value in which.items()) or "every message"


def _ids(agents: Iterable[int]) -> str:
    return ", ".join(map(str, agents))


def _entry(at_s: float, keys: dict[str, Any]) -> TimelineEntry:
    """Raises ScenarioError."""
    try:
        return TimelineEntry.model_validate({"at_s": at_s, **keys})
    except ValidationError as error:
        raise ScenarioError(explain(error, TimelineEntry)) from None
