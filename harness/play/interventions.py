"""Handle interventions: events that a user causes by hand while a mission runs. Interventions are added to the timeline
of the run.

`harness.run.run.run` takes an `Interventions` object. Any thread may then use it:

    interventions = Interventions(scenario, virtual_time=True, factor=20.0)
    interventions.ask({"partition": [[1, 2], [3, 4, 5]]}).result()      # -> 312.472, the mission second of the event
    interventions.ask({"reboot": [3], "down_s": 30, "disk": "kept"})
    interventions.pause().result(), interventions.step(10.0), interventions.resume(), interventions.set_factor(None)

A request is an entry of the scenario's timeline without `at_s`, because the run executes it at once. The code that
checks and applies entries of a scenario also handles requests. The timeline in run.json then contains the entry, and
the record of its fault has the mark `by_hand`. The scenario `replay.yaml` in the run directory repeats the whole run. A
lasting request ends an earlier temporary change of the same conditions. An impossible request raises ScenarioError and
changes nothing. Each request gets an answer, at the latest when the run ends.
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
from harness.play._pace import NEXT_RUN, VirtualTimePace
from harness.play._vehicle_keys import refuse_revocations
from harness.play.mission import Swarm
from harness.scenario import Scenario
from harness.scenario.changes import Change, NetworkChange, timeline_of
from harness.scenario.load import parse
from harness.scenario.network_states import changed_values
from harness.scenario.timeline import TimelineEntry

INSTANT_S = 0.001
"""Mission seconds between the timeline entries of two requests that arrive at the same moment."""

_NAMED = re.compile(r"(?P<list>timeline|fates)\.(?P<number>\d+)(?P<rest>\.|: )?")


class GrowingTimeline:
    """The timeline of an active mission. A user can add entries to the timeline during the mission."""

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        """The scenario with all entries that were added so far."""
        self._played_s = 0.0
        """Mission second up to which the mission has been carried out."""

    def next_instant(self, swarm: Swarm) -> float:
        """Return the mission second for a new entry of the timeline, in whole milliseconds."""
        return math.ceil(max(swarm.now(), self._played_s + INSTANT_S) * 1000) / 1000

    def replace_scenario(self, document: dict[str, Any]) -> None:
        """Replace the scenario of the active mission. Raises ScenarioError if the new one is invalid."""
        try:
            self.scenario = parse(document)
        except ScenarioError as error:
            raise ScenarioError(_error_of_last_entry(str(error), document["timeline"])) from None

    async def until(self, swarm: Swarm, mission_s: float) -> None:
        """Run the mission up to `mission_s`, and apply the changes of the timeline that are due."""
        for change in [change for change in timeline_of(self.scenario) if self._played_s < change.at_s <= mission_s]:
            await swarm.until(change.at_s)
            await swarm.apply(self.with_origin(change))
            self._played_s = change.at_s
        await swarm.until(mission_s)

    def with_origin(self, change: Change) -> Change:
        """Return the change. If a user requested it, the returned change has the mark `by_hand`."""
        return change


def _error_of_last_entry(problem: str, timeline: list[dict[str, Any]]) -> str:
    """Return an error message about the last entry of the timeline, for the user who added this entry."""
    last = len(timeline) - 1

    def name(named: re.Match[str]) -> str:
        number, rest = int(named["number"]), named["rest"]
        if named["list"] == "fates" or number >= last:
            return "" if rest else "this"
        return f"the timeline's entry at {timeline[number]['at_s']:g} s{', ' if rest == '.' else rest or ''}"

    return _NAMED.sub(name, problem)


MAX_WAITING = 100
"""Maximum number of user requests that may wait at the same time. Further requests are refused."""

MAX_FACTOR = 1e6
MAX_STEP_S = 31 * 86400.0

Entry = dict[str, Any]


class Interventions(GrowingTimeline):
    """Events that a user requests during one run. Any thread may use the public methods and properties."""

    def __init__(
        self, scenario: Scenario, *, virtual_time: bool, factor: float | None = None, paused: bool = False
    ) -> None:
        """Create the object. `factor` and `paused` apply only to virtual time. If `paused` is true, virtual time stops
        at mission second 0.
        """
        super().__init__(scenario)
        self._initial_scenario = scenario
        self.pace = VirtualTimePace(factor, paused=paused) if virtual_time else None
        """The speed of virtual time, which the backend reads. The value is None if the run uses real time."""
        self.on_entry_added: Callable[[], None] = lambda: None
        """A function that the thread of the run calls each time an entry was added."""
        self._lock = threading.Lock()
        self._loop: asyncio.AbstractEventLoop | None = None
        """The event loop of the run, or None before its start and after its end."""
        self._swarm: Swarm | None = None
        self._closed: str | None = "the mission has not started"
        """Reason why the run does not accept requests of the user, or None while the run accepts requests."""
        self._requests: deque[tuple[Entry, Future[float]]] = deque()
        self._request_arrived = asyncio.Event()
        self._by_hand: dict[float, TimelineEntry] = {}

    # For any thread

    @property
    def by_hand(self) -> list[TimelineEntry]:
        """The timeline entries that the user has requested."""
        return list(self._by_hand.values())

    @property
    def closed(self) -> str | None:
        """The reason why the run does not accept requests of the user now, or None if the run accepts requests."""
        return self._closed

    @property
    def prepares_all_agents(self) -> bool:
        """True if all agents are prepared for every event that the user may request. For example, each agent has a
        disk, so that it can reboot. False if the swarm has foreign agents, because these may not support a reboot.
        """
        return not self._initial_scenario.foreign

    @property
    def now_s(self) -> float:
        """The current mission second."""
        return self._swarm.now() if self._swarm is not None else 0.0

    @property
    def paused(self) -> bool:
        """True if virtual time is paused. Single steps can still advance paused virtual time."""
        return self.pace is not None and self.pace.paused

    @property
    def factor(self) -> float | None:
        """The number of mission seconds per second of wall time. If it is None, the speed is unlimited."""
        return self.pace.factor if self.pace is not None else self.scenario.speedup

    def ask(self, entry: Mapping[str, Any]) -> Future[float]:
        """Request an event. `entry` is a timeline entry without `at_s`. The future returns the mission second at which
        the event happens.

        The future raises ScenarioError if the event is impossible. An impossible event changes nothing in the run.
        """
        answer: Future[float] = Future()
        with self._lock:
            if self._loop is None or self._closed is not None:
                answer.set_exception(ScenarioError(self._closed or "the run has ended"))
            elif len(self._requests) >= MAX_WAITING:
                answer.set_exception(ScenarioError(f"{MAX_WAITING} commands are waiting: repeat this command later"))
            else:
                self._requests.append((dict(entry), answer))
                self._loop.call_soon_threadsafe(self._request_arrived.set)
        return answer

    def pause(self) -> Future[float]:
        """Pause virtual time. The future returns the mission second of the pause.

        In real time and after the end of the run, the futures of all methods that control time raise ScenarioError.
        """
        return self._change_pace(lambda pace, _: pace.pause())

    def resume(self) -> Future[float]:
        return self._change_pace(lambda pace, _: pace.resume())

    def set_factor(self, factor: float | None) -> Future[float]:
        """Set the number of mission seconds per second of wall time. If it is None, the speed is unlimited."""
        if factor is not None and not 0 < factor <= MAX_FACTOR:
            return _refused(f"{factor:g} is not a speed: use a number above 0 and at most {MAX_FACTOR:g}")
        return self._change_pace(lambda pace, _: pace.set_factor(factor))

    def step(self, seconds: float) -> Future[float]:
        """Advance virtual time by this number of mission seconds, and then pause. The future returns the mission second
        at the end.
        """
        if not 0 < seconds <= MAX_STEP_S:
            return _refused(f"{seconds:g} s is not a step: use a time above 0 and at most {MAX_STEP_S:g} s")
        return self._change_pace(lambda pace, answer: pace.step(self.now_s + seconds, answer), answers=False)

    def step_to_next_run(self) -> Future[float]:
        """Advance virtual time to the next handler run of any agent, and then pause. The future returns the mission
        second of this run.
        """
        return self._change_pace(lambda pace, answer: pace.step(NEXT_RUN, answer), answers=False)

    def _change_pace(
        self, do: Callable[[VirtualTimePace, Future[float]], None], *, answers: bool = True
    ) -> Future[float]:
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

    # For the thread of the run. `story` is a harness.play.mission.Story

    async def story(self, swarm: Swarm, scenario: Scenario) -> None:
        """Run the mission like `harness.play.mission.play`, and also execute the user's requests."""
        try:
            first, *_ = timeline_of(self.scenario)
            await swarm.begin(first)
            swarm.enter("mission")
            self._open(swarm)
            await self._play_mission(swarm)
            self._close(f"the mission is over: no event is possible after {self.scenario.duration_s:g} s")
            await mission.settle(swarm, self.scenario)
        finally:
            self._close("the run has ended")
            self._detach()

    def _open(self, swarm: Swarm) -> None:
        with self._lock:
            self._swarm, self._closed, self._loop = swarm, None, asyncio.get_running_loop()

    def _close(self, why: str) -> None:
        with self._lock:
            self._closed = why
            refused = [answer for _, answer in self._requests if answer.set_running_or_notify_cancel()]
            self._requests.clear()
        for answer in refused:
            answer.set_exception(ScenarioError(why))

    def _detach(self) -> None:
        with self._lock:
            self._loop = None
        if self.pace is not None:
            self.pace.end_step()

    async def _play_mission(self, swarm: Swarm) -> None:
        end_s = self.scenario.duration_s
        while self._played_s < end_s:
            until_s = min([end_s, *(change.at_s for change in self._remaining_changes())])
            is_reached = await self._play_until(swarm, until_s)
            if self._requests:
                await self._intervene(swarm, *self._requests.popleft())
            elif is_reached:
                await self.until(swarm, until_s)
                self._played_s = until_s

    def _remaining_changes(self) -> list[Change]:
        return [change for change in timeline_of(self.scenario) if change.at_s > self._played_s]

    async def _play_until(self, swarm: Swarm, mission_s: float) -> bool:
        """Run the mission until `mission_s` or until a request arrives. Return true if `mission_s` was reached. The
        method may also return early without a new request, because the signal of an earlier request can arrive late.
        """
        if self._requests:
            return False
        self._request_arrived.clear()
        requested = asyncio.create_task(self._request_arrived.wait())
        playing = asyncio.create_task(_until(swarm, mission_s))
        try:
            await asyncio.wait({requested, playing}, return_when=asyncio.FIRST_COMPLETED)
        finally:
            requested.cancel()
            playing.cancel()
            await asyncio.wait({requested, playing})
        if playing.cancelled():
            return False
        playing.result()
        return True

    async def _intervene(self, swarm: Swarm, entry: Entry, answer: Future[float]) -> None:
        if not answer.set_running_or_notify_cancel():
            return
        before = self.scenario
        try:
            at_s = await self._apply_entry(swarm, entry)
        except ScenarioError as error:
            self.scenario = before
            answer.set_exception(error)
        except BaseException:
            answer.set_exception(ScenarioError("the run has ended"))
            raise
        else:
            self.on_entry_added()
            answer.set_result(at_s)

    async def _apply_entry(self, swarm: Swarm, entry: Entry) -> float:
        if "at_s" in entry:
            raise ScenarioError("a command acts now: leave out `at_s`")
        at_s, document = self.next_instant(swarm), self.scenario.model_dump()
        document["timeline"].append({"at_s": at_s, **entry})
        self._end_replaced_changes(document["timeline"])
        self.replace_scenario(document)
        self._refuse_unprepared(self.scenario.timeline[-1])
        self._by_hand[at_s] = self.scenario.timeline[-1]
        try:
            with self.pace.unlimited() if self.pace else nullcontext():
                await self.until(swarm, at_s)
        except ScenarioError:  # the backend does not support the entry
            del self._by_hand[at_s]
            raise
        return at_s

    def _end_replaced_changes(self, timeline: list[Entry]) -> None:
        """End temporary changes that the newest entry replaces, such as a partition before a permanent `heal`."""
        try:
            entry = TimelineEntry.model_validate(timeline[-1])
        except ValidationError:
            return  # the check of the scenario reports the error
        for number, earlier in enumerate(self.scenario.timeline):
            is_under_way = earlier.for_s is not None and earlier.at_s < entry.at_s < earlier.ends_at_s
            if is_under_way and entry.for_s is None and {*changed_values(earlier)} <= {*changed_values(entry)}:
                timeline[number]["for_s"] = round(entry.at_s - earlier.at_s, 6)

    def _refuse_unprepared(self, entry: TimelineEntry) -> None:
        """Raise ScenarioError if the entry is possible only in a run that was prepared for it at the start. Also raise
        ScenarioError for a revocation that this machine cannot sign.
        """
        if entry.fault is not None and entry.fault.needs_keys:
            refuse_revocations(self.scenario)
        if self.prepares_all_agents:
            return
        if entry.injection and self._initial_scenario.rogue is None:
            raise ScenarioError(
                f"`{entry.injection[0]}` needs a rogue node; a run with other agents than the harness's own has one "
                "only if the timeline of its scenario injects something"
            )
        ready = self._initial_scenario.with_disk()
        if (fault := entry.fault) is not None and fault.disk_after == "kept" and (diskless := {*fault.agents} - ready):
            raise ScenarioError(
                f"agent {min(diskless)} has no disk: in a swarm with other agents than the harness's own an agent has "
                "a disk only if the timeline of its scenario reboots it with `disk: kept`; use `disk: lost`"
            )

    def with_origin(self, change: Change) -> Change:
        entry = self._by_hand.get(change.at_s)
        if entry is None:
            return change
        is_own = entry.network_key if isinstance(change, NetworkChange) else change.what in entry.model_fields_set
        return replace(change, by_hand=True) if is_own else change


async def _until(swarm: Swarm, mission_s: float) -> None:
    await swarm.until(mission_s)


def _refused(why: str) -> Future[float]:
    answer: Future[float] = Future()
    answer.set_exception(ScenarioError(why))
    return answer
