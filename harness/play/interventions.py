"""Interventions: a user's requests to a running mission, and the timeline that grows by them.

`Interventions` is given to `harness.run.run.run`, and may then be asked from any thread:

    hand = Interventions(scenario, virtual_time=True, factor=20.0)
    hand.ask({"partition": [[1, 2], [3, 4, 5]]}).result()      # -> 312.472, the mission second of it
    hand.ask({"kill": [2]}), hand.ask({"reboot": [3], "down_s": 30, "disk": "kept"}), hand.ask({"loss": 0.5})
    hand.pause().result(), hand.step(10.0), hand.step_to_next_run(), hand.go_on(), hand.set_factor(None)

What is asked is an entry of the scenario's timeline without its `at_s`, which is now: same keys, same check, same
sentences, made by the same code as one that was scheduled. It then stands in the timeline of run.json and is marked
`by_hand` among the faults there; `replay.yaml` in the run's directory plays it all again. What was to last for a while,
and is changed by hand for good, is over by then. What cannot be is a ScenarioError, one sentence, and changes nothing.
Every answer comes, if only that the run has ended.
"""

import asyncio
import math
import re
import threading
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

from pydantic import ValidationError

from harness.errors import ScenarioError
from harness.play import mission
from harness.play._pace import NEXT_RUN, Pace
from harness.play._vehicle_keys import refuse_revocations
from harness.play.mission import Swarm
from harness.scenario import Scenario
from harness.scenario.changes import Change, NetworkChange, timeline_of
from harness.scenario.load import parse
from harness.scenario.network_states import changed_values
from harness.scenario.timeline import TimelineEntry

INSTANT_S = 0.001
"""Of two entries in one instant the second comes a millisecond later."""

_NAMED = re.compile(r"(?P<list>timeline|fates)\.(?P<number>\d+)(?P<rest>\.|: )?")


class GrowingTimeline:
    """What is played of a scenario by now, and may yet be added to it."""

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        """With everything in its timeline that was told by now."""
        self._played_s = 0.0
        """Until when the timeline has been played."""

    def next_instant(self, swarm: Swarm) -> float:
        """The first whole millisecond, in mission seconds, at which something may happen that is told now."""
        return math.ceil(max(swarm.now(), self._played_s + INSTANT_S) * 1000) / 1000

    def retell(self, document: dict[str, Any]) -> None:
        """From now on this is the scenario. Raises ScenarioError if there can be no such scenario."""
        try:
            self.scenario = parse(document)
        except ScenarioError as error:
            raise ScenarioError(_of_the_last(str(error), document["timeline"])) from None

    async def until(self, swarm: Swarm, mission_s: float) -> None:
        """Go on until then, with what the timeline has in between."""
        for change in [change for change in timeline_of(self.scenario) if self._played_s < change.at_s <= mission_s]:
            await swarm.until(change.at_s)
            await swarm.apply(self.as_asked(change))
            self._played_s = change.at_s
        await swarm.until(mission_s)

    def as_asked(self, change: Change) -> Change:
        """The change, with what is known of who asked for it."""
        return change


def _of_the_last(problem: str, timeline: list[dict[str, Any]]) -> str:
    """What is wrong with a timeline, in the words of whoever told its last entry."""
    last = len(timeline) - 1

    def name(named: re.Match[str]) -> str:
        number, rest = int(named["number"]), named["rest"]
        if named["list"] == "fates" or number >= last:
            return "" if rest else "this"
        return f"the timeline's entry at {timeline[number]['at_s']:g} s{', ' if rest == '.' else rest or ''}"

    return _NAMED.sub(name, problem)


MOST_WAITING = 100
"""Things that are asked for and have not been done yet; more are refused."""

MOST_FACTOR = 1e6
MOST_STEP_S = 31 * 86400.0

Entry = dict[str, Any]


class Interventions(GrowingTimeline):
    """Of one run; see above. All that is public may be used in any thread."""

    def __init__(
        self, scenario: Scenario, *, virtual_time: bool, factor: float | None = None, paused: bool = False
    ) -> None:
        """In virtual time only: `factor` is as for `set_factor`; `paused`: it stands at second 0, and waits."""
        super().__init__(scenario)
        self._begun_with = scenario
        self.pace = Pace(factor, paused=paused) if virtual_time else None
        """For the backend's own use."""
        self.taken_down: Callable[[], None] = lambda: None
        """Called in the run's thread whenever the timeline has grown."""
        self._lock = threading.Lock()
        self._loop: asyncio.AbstractEventLoop | None = None
        """Of the run, while it goes on."""
        self._swarm: Swarm | None = None
        self._closed: str | None = "the mission has not started"
        """Why nothing can happen to the swarm any more, or yet."""
        self._asked: deque[tuple[Entry, Future[float]]] = deque()
        self._something_is_asked = asyncio.Event()
        self._by_hand: dict[float, TimelineEntry] = {}

    # For whoever asks, in any thread

    @property
    def by_hand(self) -> list[TimelineEntry]:
        """What has been done by now."""
        return list(self._by_hand.values())

    @property
    def closed(self) -> str | None:
        """Why nothing can happen to the swarm any more, or yet; None if it can."""
        return self._closed

    @property
    def readies_all(self) -> bool:
        """Whether all agents are made ready for what they may be told: ours are; others may lack what that takes."""
        return not self._begun_with.foreign

    @property
    def now_s(self) -> float:
        """Mission seconds since the start."""
        return self._swarm.now() if self._swarm is not None else 0.0

    @property
    def paused(self) -> bool:
        """Whether virtual time stands still but for steps."""
        return self.pace is not None and self.pace.paused

    @property
    def factor(self) -> float | None:
        """Mission seconds per second of wall time; None: as fast as it can."""
        return self.pace.factor if self.pace is not None else self.scenario.speedup

    def ask(self, entry: Mapping[str, Any]) -> Future[float]:
        """Have this entry of a timeline, without its `at_s`, happen now; the answer is its mission second.

        The answer raises ScenarioError if it cannot be, and leaves everything as it is.
        """
        answer: Future[float] = Future()
        with self._lock:
            if self._loop is None or self._closed is not None:
                answer.set_exception(ScenarioError(self._closed or "the run has ended"))
            elif len(self._asked) >= MOST_WAITING:
                answer.set_exception(ScenarioError(f"{MOST_WAITING} commands are waiting: repeat this command later"))
            else:
                self._asked.append((dict(entry), answer))
                self._loop.call_soon_threadsafe(self._something_is_asked.set)
        return answer

    def pause(self) -> Future[float]:
        """Stand still; the answer is the mission second.

        This and what is below raises ScenarioError where time is real, and once the run has ended.
        """
        return self._at_pace(lambda pace, _: pace.pause())

    def go_on(self) -> Future[float]:
        return self._at_pace(lambda pace, _: pace.go_on())

    def set_factor(self, factor: float | None) -> Future[float]:
        """Mission seconds per second of wall time, more than 0; None: as fast as it can."""
        if factor is not None and not 0 < factor <= MOST_FACTOR:
            return _refused(f"{factor:g} is not a speed: use a number above 0 and at most {MOST_FACTOR:g}")
        return self._at_pace(lambda pace, _: pace.set(factor))

    def step(self, seconds: float) -> Future[float]:
        """Pause, but go on for so many mission seconds; the answer is the mission second at which it stands again."""
        if not 0 < seconds <= MOST_STEP_S:
            return _refused(f"{seconds:g} s is not a step: use a time above 0 and at most {MOST_STEP_S:g} s")
        return self._at_pace(lambda pace, answer: pace.step(self.now_s + seconds, answer), answers=False)

    def step_to_next_run(self) -> Future[float]:
        """As `step`, until an agent has run a handler."""
        return self._at_pace(lambda pace, answer: pace.step(NEXT_RUN, answer), answers=False)

    def _at_pace(self, do: Callable[[Pace, Future[float]], None], *, answers: bool = True) -> Future[float]:
        answer: Future[float] = Future()
        pace = self.pace
        if pace is None:
            return _refused("the time of real processes cannot be paused: use --backend sim, where time is virtual")

        def act() -> None:
            if not answer.set_running_or_notify_cancel():
                return
            do(pace, answer)
            if answers:
                answer.set_result(self.now_s)

        with self._lock:
            if self._loop is None:
                return _refused("the run is not active: it has not started, or has ended")
            self._loop.call_soon_threadsafe(act)
        return answer

    # The story, in the thread that plays it: see harness.play.mission.Story

    async def story(self, swarm: Swarm, scenario: Scenario) -> None:
        """As `harness.play.mission.play`, with what is asked for."""
        try:
            first, *_ = timeline_of(self.scenario)
            await swarm.begin(first)
            swarm.enter("mission")
            self._open(swarm)
            await self._mission(swarm)
            self._close(f"the mission is over: no event is possible after {self.scenario.duration_s:g} s")
            await mission.settle(swarm, self.scenario)
        finally:
            self._close("the run has ended")
            self._leave()

    def _open(self, swarm: Swarm) -> None:
        with self._lock:
            self._swarm, self._closed, self._loop = swarm, None, asyncio.get_running_loop()

    def _close(self, why: str) -> None:
        with self._lock:
            self._closed = why
            refused = [answer for _, answer in self._asked if answer.set_running_or_notify_cancel()]
            self._asked.clear()
        for answer in refused:
            answer.set_exception(ScenarioError(why))

    def _leave(self) -> None:
        with self._lock:
            self._loop = None
        if self.pace is not None:
            self.pace.stop_stepping()

    async def _mission(self, swarm: Swarm) -> None:
        end_s = self.scenario.duration_s
        while self._played_s < end_s:
            until_s = min([end_s, *(change.at_s for change in self._coming())])
            is_reached = await self._goes_on_until(swarm, until_s)
            if self._asked:
                await self._intervene(swarm, *self._asked.popleft())
            elif is_reached:
                await self.until(swarm, until_s)
                self._played_s = until_s

    def _coming(self) -> list[Change]:
        return [change for change in timeline_of(self.scenario) if change.at_s > self._played_s]

    async def _goes_on_until(self, swarm: Swarm, mission_s: float) -> bool:
        """Go on until then, or until something is asked for; whether it is then.

        It may also be woken up for what it has done already, as that had been asked for before it could fall asleep.
        """
        if self._asked:
            return False
        self._something_is_asked.clear()
        asked = asyncio.create_task(self._something_is_asked.wait())
        going = asyncio.create_task(_until(swarm, mission_s))
        try:
            await asyncio.wait({asked, going}, return_when=asyncio.FIRST_COMPLETED)
        finally:
            asked.cancel()
            going.cancel()
            await asyncio.wait({asked, going})
        if going.cancelled():
            return False
        going.result()
        return True

    async def _intervene(self, swarm: Swarm, entry: Entry, answer: Future[float]) -> None:
        if not answer.set_running_or_notify_cancel():
            return
        before = self.scenario
        try:
            at_s = await self._happen(swarm, entry)
        except ScenarioError as error:
            self.scenario = before
            answer.set_exception(error)
        except BaseException:
            answer.set_exception(ScenarioError("the run has ended"))
            raise
        else:
            self.taken_down()
            answer.set_result(at_s)

    async def _happen(self, swarm: Swarm, entry: Entry) -> float:
        if "at_s" in entry:
            raise ScenarioError("a command acts now: leave out `at_s`")
        at_s, document = self.next_instant(swarm), self.scenario.model_dump()
        document["timeline"].append({"at_s": at_s, **entry})
        self._end_what_it_takes_the_place_of(document["timeline"])
        self.retell(document)
        self._refuse_what_nobody_is_ready_for(self.scenario.timeline[-1])
        self._by_hand[at_s] = self.scenario.timeline[-1]
        try:
            with self.pace.unheeded() if self.pace else nullcontext():
                await self.until(swarm, at_s)
        except ScenarioError:  # the backend cannot
            del self._by_hand[at_s]
            raise
        return at_s

    def _end_what_it_takes_the_place_of(self, timeline: list[Entry]) -> None:
        """What is changed for a while, and by the last entry for good, is over now: to heal ends any partition."""
        try:
            entry = TimelineEntry.model_validate(timeline[-1])
        except ValidationError:
            return  # what is wrong with it is said by whoever checks the scenario
        for number, earlier in enumerate(self.scenario.timeline):
            is_under_way = earlier.for_s is not None and earlier.at_s < entry.at_s < earlier.ends_at_s
            if is_under_way and entry.for_s is None and {*changed_values(earlier)} <= {*changed_values(entry)}:
                timeline[number]["for_s"] = round(entry.at_s - earlier.at_s, 6)

    def _refuse_what_nobody_is_ready_for(self, entry: TimelineEntry) -> None:
        """Raises ScenarioError for what agents had to be ready for from the start, where some may not have been.

        Also for a revocation that nobody here can sign.
        """
        if entry.fault is not None and entry.fault.needs_keys:
            refuse_revocations(self.scenario)
        if self.readies_all:
            return
        if entry.injection and self._begun_with.rogue is None:
            raise ScenarioError(
                f"`{entry.injection[0]}` needs a rogue node; a run with other agents than the harness's own has one "
                "only if the timeline of its scenario injects something"
            )
        ready = {
            agent_id
            for fault in self._begun_with.faults_in_order()
            if fault.disk_after == "kept"
            for agent_id in fault.agents
        }
        if (fault := entry.fault) is not None and fault.disk_after == "kept" and (diskless := {*fault.agents} - ready):
            raise ScenarioError(
                f"agent {min(diskless)} has no disk: in a swarm with other agents than the harness's own an agent has "
                "a disk only if the timeline of its scenario reboots it with `disk: kept`; use `disk: lost`"
            )

    def as_asked(self, change: Change) -> Change:
        entry = self._by_hand.get(change.at_s)
        if entry is None:
            return change
        its_own = entry.network_key if isinstance(change, NetworkChange) else change.what in entry.model_fields_set
        return replace(change, by_hand=True) if its_own else change


async def _until(swarm: Swarm, mission_s: float) -> None:
    await swarm.until(mission_s)


def _refused(why: str) -> Future[float]:
    answer: Future[float] = Future()
    answer.set_exception(ScenarioError(why))
    return answer
