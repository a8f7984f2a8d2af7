"""Simulate a swarm in virtual time, with the same agent code that `ucp.node` runs.

The simulation never waits for real time, and its result does not depend on the machine. The same scenario and seed give
the same run to the last bit. The events of each agent, the network effects on each sender and the quirks of each agent
use separate random streams. Another fault in the scenario therefore does not change the random numbers of other agents.
Vehicles are only flight paths without telemetry, so agents log random events (Algorithm 21).
"""

import base64
import dataclasses
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

from harness.archive.run_record import AgentFailure, AgentRecord, ChannelRecord, Cycle, HandlerRuns, NetworkState
from harness.errors import AgentFailedError, ScenarioError
from harness.play._radio_range import TRACK_S, RadioRange, tracks_of
from harness.play.agent_control import AgentStatus
from harness.play.mission import RunOutcome, SoughtRun
from harness.play.rogue.rogue_line import OF_NO_INJECTION, line_of
from harness.play.simulation._event_loop import ANY_INCARNATION, EventLoop
from harness.play.simulation._recurrence import CHECK_AFTER_S, AgentAtRest, RecurrenceSearch
from harness.play.simulation._simulated_agent import DiskContents
from harness.play.simulation.air import NEVER, StrayDatagram, VirtualAir
from harness.play.simulation.fate_script import FateScript, NameOf
from harness.play.simulation.incarnations import SimulatedIncarnation
from harness.play.simulation.run_files import Recorder
from harness.scenario import Scenario
from harness.scenario.changes import NO_MORE_FATES, Change, NetworkChange, TimedInjection, silent_injections
from harness.scenario.fates import Fate
from harness.scenario.faults import VehicleFault
from netem.radio import Place
from sitl.circumstances import SimulatedFailure
from sitl.track import VehicleTrack
from ucp.trace import HandlerRun

if TYPE_CHECKING:
    from harness.play._pace import VirtualTimePace
    from harness.play.simulation.foreign._answer import AgentLacksError
    from harness.play.simulation.foreign._foreign_agent import IncarnationRecord
    from harness.play.simulation.foreign._program_pool import ProgramPool

Returned = TypeVar("Returned")

ENGINE = "virtual time"
PROGRESS_S = 20.0
"""Mission seconds between two calls of `on_progress`."""


class _AnyHandlerRun(SoughtRun):
    """An object that matches every handler run."""

    def matches(self, agent_id: int, run: HandlerRun) -> bool:
        return True


ANY_RUN = _AnyHandlerRun("any")


class Simulation(EventLoop):
    """The simulation of a swarm in virtual time. It implements the interface `harness.play.mission.Swarm`."""

    def __init__(
        self,
        scenario: Scenario,
        seed: int,
        recorder: Recorder,
        *,
        deliver_all: bool = False,
        interactive: bool = False,
        on_progress: Callable[["Simulation"], Awaitable[None]] | None = None,
        pace: "VirtualTimePace | None" = None,
        fate_script: Callable[[Sequence[Fate], Sequence[int], NameOf], FateScript] = FateScript,
        air: Callable[..., VirtualAir] = VirtualAir,
        programs: "ProgramPool | None" = None,
    ) -> None:
        """Create a swarm whose mission has not begun.

        - `on_progress`: a function that is awaited every `PROGRESS_S` mission seconds.
        - `pace`: limits the speed of virtual time.

        `EventLoop` describes the other options.
        """
        super().__init__(
            scenario,
            seed,
            _initial_data(scenario, seed),
            recorder,
            deliver_all=deliver_all,
            interactive=interactive,
            fate_script=fate_script,
            air=air,
            programs=programs,
        )
        self.played = RunOutcome(engine=ENGINE)
        self.stage = "mission"
        self.network = ""
        self._breathe = on_progress
        self._pace = pace
        self._disks: dict[int, DiskContents] = {}
        """The content of the disk of each agent that is switched off and will reboot with this disk, by agent number.
        """
        self._switched_off: dict[int, SimulatedIncarnation] = {}
        self._failures: dict[int, AgentFailedError | AgentLacksError] = {}
        """The last failure of each agent, by agent number."""
        self.failures: list[AgentFailedError] = []
        """The failures of agents that crashed or hung, in the order of time."""
        self._failed_incarnations: list[list[AgentFailure]] = [[] for _ in self.roster]
        """The failures of each agent, for run.json. The agents have the order of the roster."""
        self._reach = RadioRange(scenario)
        self._tracks = tracks_of(scenario)
        self._move_every_s = radio.update_s if (radio := scenario.network.radio) else TRACK_S
        self._all_rest_from_s = NEVER
        """The time after which no vehicle moves any more. The time is known only if the shared channel is the only part
        of the scenario that needs positions.
        """
        if self._channel and not (scenario.flight or scenario.gcs):
            self._all_rest_from_s = max(track.course.rests_from_s for track in self._tracks.values())
        self._moves_at = NEVER
        self.lost_vehicles: set[int] = set()
        """Vehicles that a ground station no longer sees, because they were shot down, fell, or were switched off."""
        self._injected: list[TimedInjection] = []
        """The injections that were requested from the rogue node."""

    @property
    def tracks(self) -> Mapping[int, VehicleTrack]:
        """The flight paths of the vehicles. The result is empty if the scenario needs no positions."""
        return self._tracks

    # The methods of harness.play.mission.Swarm

    def now(self) -> float:
        return self._now

    def enter(self, stage: str) -> None:
        self.stage = stage

    async def begin(self, first: Change) -> None:
        await self.apply(first)
        self._recent_runs = None
        self._move()
        if self._foreign_swarm is not None:
            self._foreign_swarm.start()
        for number in range(len(self.roster)):
            with self._containing_failure(number):
                self._start(number)
        for event in self.scenario.events.script:
            logged = ANY_INCARNATION, event.event_id, event.event_data, event.timestamp_us
            self._air.schedule(event.at_s, self._number[event.agent], logged)
        for scripted in self.scenario.datagrams:
            stray = StrayDatagram(scripted.source, base64.b64decode(scripted.datagram))
            for agent_id, at_s in scripted.reaches.items():
                self._air.inject(at_s, stray, [self._number[agent_id]])
            at_s = min(scripted.reaches.values())
            self._recorder.injected(line_of(at_s, OF_NO_INJECTION, "datagram", stray.source, stray.datagram))

    async def until(self, mission_s: float) -> None:
        if self._breathe is None and not self._tracks:
            self.run(mission_s)
            return
        while (self._now < mission_s or self._stopped_within_instant) and self._found is None:
            breath_s = self._now + PROGRESS_S if self._breathe is not None else NEVER
            furthest = min(mission_s, breath_s, self._moves_at)
            if self._pace is None:
                self.run(furthest)
            else:
                await self._run_at(self._pace, furthest)
            if self._now == self._moves_at and not self._stopped_within_instant:
                self._move()
            if self._breathe is not None:
                await self._breathe(self)

    async def _run_at(self, pace: "VirtualTimePace", furthest: float) -> None:
        """Run the simulation like `run`, but only up to the mission second that the requested speed allows now."""
        allowed_s = await pace.allowed_until(self._now)
        if allowed_s is None:
            return
        if not pace.stops_at_next_run:
            self.run(min(furthest, allowed_s))
            return
        self._sought = ANY_RUN
        self.run(furthest)
        if self._found is not None:
            pace.record_run(self._now)
        self._sought = self._found = None

    async def until_run(self, sought: SoughtRun, mission_s: float) -> int | None:
        self._deliver_all = True  # a handler run without effect also counts
        self._air.deliver_everything()
        recent_runs, self._recent_runs = self._recent_runs or [], None
        for index, (agent_id, run) in enumerate(recent_runs):
            if sought.matches(agent_id, run):
                self._recent_runs = recent_runs[index + 1 :]
                return agent_id
        self._sought, self._found = sought, None
        await self.until(mission_s)
        found: int | None = self._found
        self._sought = self._found = None
        return found

    async def hold(self, fate: Fate) -> int:
        return self._script.hold(fate)

    async def release(self, number: int, fate: Fate) -> None:
        assert fate.hold_until_s is not None, "a release sets the end of the hold"
        self._script.release(number, fate)
        self._air.release(number, fate.hold_until_s)

    async def apply(self, change: Change) -> None:
        self._recent_runs = []
        if isinstance(change, NetworkChange):
            self._apply_conditions(self._reach.change_timeline(change), asked=change.conditions.to_json())
            return
        if isinstance(change, VehicleFault):
            raise ScenarioError(no_vehicles([change.what]))
        record = change.to_json(round(self._now, 3))
        self.played.record(record)
        if isinstance(change, TimedInjection):
            self._injected.append(change)
            if self._rogue is None:
                self._rogue = self._late_rogue()
            self._rogue.begin(change, self._now)
            return
        for agent_id in change.agents:
            with self._containing_failure(self._number[agent_id]):
                await change.apply(self, agent_id)
        self._recorder.changed(record)

    def _apply_conditions(self, change: NetworkChange, **more: Any) -> None:
        self._air.apply(change.conditions, self._now, clears_all=change.clears_all)
        self.network = change.detail
        record = change.to_json(round(self._now, 3))
        self.played.record(record)
        self._recorder.changed({**record, **more})

    def _move(self) -> None:
        """Move the vehicles to their current positions, and update the radio losses."""
        if not self._tracks:
            return
        places = {vehicle: Place(*track.in_field(self._now)) for vehicle, track in self._tracks.items()}
        self._recorder.moved(self._now, places)
        self._air.move(places, self._now)
        if change := self._reach.move(self._now, places):
            self._apply_conditions(change)
        self._moves_at = self._now + self._move_every_s if self._now < self._all_rest_from_s else NEVER

    async def stop_events(self) -> None:
        self._generating = False

    async def until_idle(self, limit_s: float) -> bool:
        limit, look_at = self._now + limit_s, self._now + CHECK_AFTER_S
        recurrence, self._recurrence, self.played.cycle = self._new_recurrence(), None, None
        while self._now < limit:
            awake = (incarnation for incarnation in self.living() if incarnation.waiting is None)
            last = max([self._air.quiet_at, *(incarnation.deadline or 0.0 for incarnation in awake)])
            if last <= self._now:
                return self.survive(self._is_settled)
            if recurrence is None or self._now < look_at:
                await self.until(min(limit, last))
            elif await self._run_until_recurrence(min(limit, last), recurrence):
                return False
        return False

    def _is_settled(self) -> bool:
        """Return true if all agents are idle. If some agents can never become idle, record them in `played`.

        Call this only if no message is in transit and no timer runs.
        """
        hanging = [
            incarnation.agent for incarnation in self.living() if incarnation.waiting is None and not incarnation.idle
        ]
        if hanging and not self._generating:
            agents = [agent.agent_id for agent in hanging]
            self.played.cycle = Cycle(since_s=round(self._now, 3), proven=True, agents=agents)
        return not hanging and all(incarnation.waiting is None for incarnation in self.living())

    def _new_recurrence(self) -> RecurrenceSearch | None:
        """Return a search for an endless cycle. Return None if the future depends on random numbers or on further
        inputs.
        """
        moving = bool(self._tracks) and self.scenario.network.radio and self.played.final_reconcile is None
        delays = self._medium.certain_delays()
        unknown = self._has_unknown_agents or self._rogue is not None
        spread = self.scenario.settings.answer_spread_s > 0  # the waiting times of answers differ in each cycle
        if self._generating or moving or unknown or delays is None or self._channel is not None or spread:
            return None
        return RecurrenceSearch(delays)

    async def _run_until_recurrence(self, mission_s: float, recurrence: RecurrenceSearch) -> bool:
        """Run until `mission_s`, or until the swarm repeats a cycle forever. Return true if the swarm repeats
        a cycle.
        """
        self._recurrence = recurrence
        while self._now < mission_s:
            if self._air.quiet_at > self._now:
                await self.until(min(mission_s, self._air.quiet_at))
                continue
            incarnations = {
                number: incarnation
                for number, incarnation in enumerate(self._alive)
                if incarnation and incarnation.waiting is None
            }
            for number, incarnation in incarnations.items():
                with self._containing_failure(number):
                    self._tally_answers(number, incarnation)
            if any(self._alive[number] is not incarnation for number, incarnation in incarnations.items()):
                return False  # an agent crashed
            wakes_s = {
                number: incarnation.deadline
                for number, incarnation in incarnations.items()
                if incarnation.deadline is not None
            }
            next_s = min(wakes_s.values())
            swarm = [
                AgentAtRest(incarnation.state, incarnation.local_s(next_s), incarnation.deadline)
                for incarnation in incarnations.values()
                if incarnation.state is not None
            ]
            fates = self._script.settled_counts(self._now)
            order = [
                *self._air.timer_order(wakes_s),
                *(name for late in self._late.values() for name in late.running),
            ]
            all_on_time = all(late.late_ones_have_ended for late in self._late.values())
            if all_on_time and fates is not None and recurrence.check(swarm, order, fates, self._script.last_s or 0.0):
                self.played.cycle = recurrence.cycle(swarm)
                return True
            await self.until(min(mission_s, next_s))
            recurrence.record_state_after_timers(swarm)
        return False

    async def keep_chains(self) -> None:
        self.survive(lambda: self._recorder.keep_chains(self._now, self.exporting()))

    async def reconcile(self, agent_id: int) -> None:
        number = self._number[agent_id]
        incarnation = self._alive[number]
        if incarnation is not None and incarnation.waiting is None:
            with self._containing_failure(number):
                self._tally_answers(number, incarnation)
                incarnation.agent.begin_reconcile(incarnation.local_s(self._now))
                self._finish_input(number, incarnation)

    async def top_chain_hashes(self) -> dict[int, str]:
        return self.survive(
            lambda: {incarnation.agent.agent_id: incarnation.top_chain_hash for incarnation in self.living()}
        )

    async def completed(self) -> dict[int, int]:
        return self.survive(
            lambda: {
                incarnation.agent.agent_id: len(incarnation.agent.completed())
                for incarnation in self.living()
                if incarnation.waiting is None
            }
        )

    async def snapshot(self) -> RunOutcome:
        self.survive(lambda: self._recorder.export(self._now, self.exporting()))
        return self.survive(self._outcome_so_far)

    def survive(self, query: Callable[[], Returned]) -> Returned:
        """Return the result of a query to the living agents. If an agent crashes or hangs, query the other agents
        again.
        """
        while True:
            try:
                return query()
            except AgentFailedError as error:
                self.fail(error)

    def fail(self, error: "AgentFailedError | AgentLacksError") -> None:
        """Record that an agent crashed, hung, or does not support the mission, and end the record of this agent."""
        number = self._number[error.agent_id]
        if (incarnation := self._alive[number]) is not None:
            incarnation.ended_at = self._now
            incarnation.drop_unfinished_input()
        if self._foreign_swarm is not None:
            self._foreign_swarm.ended(error.agent_id)
        self._alive[number] = None
        self._air.remove_agent(number)
        self._failures[number] = error
        if isinstance(error, AgentFailedError):
            self.failures.append(error)
        which = len(self._incarnations[number]) + (incarnation is None)
        failure = AgentFailure(at_s=round(self._now, 3), incarnation=which, detail=error.detail)
        self._failed_incarnations[number].append(failure)
        if self.played.outcome == "completed":
            self.played.end_early("failed", error)

    def close(self) -> None:
        """Release the programs of foreign agents."""
        if self._foreign_swarm is not None:
            self._foreign_swarm.close()

    def end(self) -> None:
        """Store the result of the run at the end of the mission."""
        if self._rogue is not None:
            self._rogue.close()
        self.played = self._outcome_so_far()

    def _outcome_so_far(self) -> RunOutcome:
        for number, incarnation in enumerate(self._alive):
            if incarnation is not None:
                with self._containing_failure(number):
                    self._tally_answers(number, incarnation)
        last_s, network = self._script.last_s, self.played.network
        return dataclasses.replace(
            self.played,
            mission_s=round(self._now, 3),
            network=network if last_s is None else _disconnected_until(last_s, network),
            channel=self._channel_record(),
            unmatched_fates=[*self._air.unmatched_fates(), *self._injected_nothing()],
            agents={str(agent_id): self._agent_record(number) for agent_id, number in self._number.items()},
        )

    def _channel_record(self) -> ChannelRecord | None:
        asked = self.scenario.network.channel
        if self._channel is None or asked is None:
            return None
        return ChannelRecord.model_validate({"model": asked.to_json(), **self._channel.totals.to_json()})

    def _injected_nothing(self) -> list[str]:
        return silent_injections(self._injected, self._rogue.sent) if self._rogue is not None else []

    # State of the agents

    def living(self) -> Iterator[SimulatedIncarnation]:
        return (incarnation for incarnation in self._alive if incarnation is not None)

    def exporting(self) -> Iterator[SimulatedIncarnation]:
        """Yield the agents that have a chain export, in the order of the roster. These are living agents and agents
        that were switched off.
        """
        for number, incarnation in enumerate(self._alive):
            if (leaves := self._switched_off.get(number, incarnation)) is not None:
                yield leaves

    def records(self) -> list["IncarnationRecord"]:
        """Return the recorded inputs and answers of the foreign agents, for each of their starts."""
        return [] if self._foreign_swarm is None else self._foreign_swarm.records

    def _agent_record(self, number: int) -> AgentRecord:
        incarnations = self._incarnations[number]
        off, failure = self._switched_off.get(number), self._failures.get(number)
        incarnation = off or self._alive[number]
        completed = dict.fromkeys(
            block.hex() for incarnation in incarnations for block in incarnation.agent.completed()
        )
        for block in incarnation.agent.completed() if incarnation else ():
            del completed[block.hex()]
        reboots = sum(incarnation.rebooted for incarnation in incarnations)
        known = [incarnation.agent.known_status() for incarnation in incarnations]
        dropped = sum((Counter(status.dropped) for status in known if status), Counter[str]())
        gone = "rebooting" if number in self._disks else "killed" if incarnations else "not started"
        ended = failure.outcome if failure else gone
        detail = failure.detail if failure else f"switched off at {off.ended_at:g} s" if off else None
        agent_id, foreign = self.roster[number], self._foreign_swarm
        is_foreign = foreign is not None and agent_id in foreign
        return AgentRecord(
            outcome="exported" if incarnation else ended,
            detail=detail,
            command=foreign.command_of(agent_id) if foreign is not None and is_foreign else None,
            version=next((status.version for status in reversed(known) if status), None) if is_foreign else None,
            restarts=max(0, len(incarnations) - 1 - reboots),
            reboots=reboots,
            failures=self._failed_incarnations[number],
            completed_before=list(completed),
            idle=incarnation.idle if incarnation else None,
            bytes_sent=sum(incarnation.bytes_sent for incarnation in incarnations),
            dropped=dict(dropped) if self._rogue is not None or self._keys is not None else None,
            messages_sent=sum(incarnation.agent.messages_sent for incarnation in incarnations),
            reconciles=sum(status.reconciles for status in known if status) if all(known) else None,
            chain_changed_at_s=_rounded(incarnation.chain_changed_at) if incarnation else None,
            handler_runs=[self._handler_runs(*each) for each in zip(incarnations, known, strict=True)]
            if self._tracing
            else [],
        )

    def _handler_runs(self, incarnation: SimulatedIncarnation, status: AgentStatus | None) -> HandlerRuns | None:
        """Return the number of handler runs of the agent, with the time of the count. A foreign agent counts its
        handler runs itself. Return None if the status of the agent is unknown.
        """
        if status is None:
            return None
        at_s = self._now if incarnation.ended_at is None else incarnation.ended_at
        counted = status.handled if incarnation.state is None else incarnation.handler_runs
        return HandlerRuns(counted=counted, from_s=round(at_s, 3), until_s=round(at_s, 3))

    # The methods of harness.scenario.faults.AgentOperations

    async def end_incarnation(self, agent_id: int, *, with_vehicle: bool = False, disk_kept: bool = False) -> None:
        number = self._number[agent_id]
        if with_vehicle:
            self.lost_vehicles.add(agent_id)
        if (incarnation := self._alive[number]) is not None:
            self._tally_answers(number, incarnation)
            incarnation.ended_at = self._now
            if disk_kept:
                self._disks[number] = incarnation.agent.stored(incarnation.local_s(self._now))
            incarnation.agent.end(incarnation.local_s(self._now))
            if self._foreign_swarm is not None:
                self._foreign_swarm.ended(agent_id)
        elif disk_kept and (stored := self._disk_after_death(number)) is not None:
            self._disks[number] = stored
        self._alive[number] = None
        self._air.remove_agent(number)

    def _disk_after_death(self, number: int) -> DiskContents | None:
        """Return the content of the disk of an agent that crashed. Return None if the agent stored no data."""
        if not self._incarnations[number]:
            return None
        dead = self._incarnations[number][-1]
        if dead.state is not None:
            return dead.disk
        from harness.play.simulation.foreign._disk_after_death import disk_after_death

        record = next(record for record in reversed(self.records()) if record.agent_id == self.roster[number])
        return disk_after_death(record, tracing=self._tracing)

    async def begin_incarnation(self, agent_id: int, *, new_vehicle: bool = False) -> None:
        number = self._number[agent_id]
        self.lost_vehicles.discard(agent_id)
        self._start(number, self._disks.pop(number, None))

    async def fall(self, agent_id: int) -> None:
        """Remove the vehicle from the ground station's display. The flight path of the vehicle does not change."""
        self.lost_vehicles.add(agent_id)

    async def revoke(self, agent_id: int, heard_by: Sequence[int]) -> None:
        assert self._keys is not None, "a revocation without keys is refused"
        revocation = self._keys.mission.revoke(agent_id)
        for number in map(self._number.__getitem__, heard_by):
            incarnation = self._alive[number]
            if incarnation is not None and incarnation.waiting is None and incarnation.secured is not None:
                self._tally_answers(number, incarnation)
                incarnation.secured.revoke(revocation, incarnation.local_s(self._now))
                self._finish_input(number, incarnation)

    async def set_circumstance(
        self, agent_id: int, what: str, circumstance: SimulatedFailure, *, by_hand: bool
    ) -> None:
        raise AssertionError("faults of vehicles are refused")

    async def pause(self, agent_id: int) -> None:
        number = self._number[agent_id]
        if (incarnation := self._alive[number]) is not None:
            self._tally_answers(number, incarnation)
            incarnation.waiting = []
            self._air.paused_at[number] = self._now

    async def resume(self, agent_id: int) -> None:
        number = self._number[agent_id]
        incarnation = self._alive[number]
        if incarnation is not None and incarnation.waiting is not None:
            self._resume(number, incarnation, incarnation.waiting)

    async def stop_logging(self, agent_id: int) -> None:
        if (incarnation := self._alive[self._number[agent_id]]) is not None:
            incarnation.logs = False

    async def switch_off(self, agent_id: int) -> None:
        number = self._number[agent_id]
        incarnation = self._alive[number]
        await self.end_incarnation(agent_id, with_vehicle=True)
        if incarnation is not None:
            self._switched_off[number] = incarnation


def no_vehicles(keys: Sequence[str]) -> str:
    """Return the error message for keys of the scenario that need flying vehicles."""
    named = ", ".join(f"`{key}`" for key in keys)
    return (
        f"{named} need{'s' if len(keys) == 1 else ''} flying vehicles, but virtual time computes the tracks: use "
        "--backend process, or leave it out"
    )


def _initial_data(scenario: Scenario, seed: int) -> bytes:
    if scenario.initial_data is not None:
        return base64.b64decode(scenario.initial_data)
    return f"{scenario.name}, seed {seed}".encode()


def _rounded(seconds: float | None) -> float | None:
    return None if seconds is None else round(seconds, 3)


def _disconnected_until(at_s: float, network: Sequence[NetworkState]) -> list[NetworkState]:
    """Return a copy of these records of network changes. The copy states that the network is not fully connected up to
    `at_s`, because scripted deliveries can lose messages until this time.
    """
    since = round(at_s + 0.001, 3)  # include messages of the same instant
    before = [state.model_copy(update={"fully_connected": False}) for state in network if state.at_s < since]
    after = [state for state in network if state.at_s >= since]
    again = {"at_s": since, "what": NO_MORE_FATES, "fully_connected": network[len(before) - 1].fully_connected}
    return [*before, before[-1].model_copy(update=again), *after]
