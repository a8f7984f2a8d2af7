"""The simulation backend: a scenario played in virtual time, by the very agents that `ucp.node` runs.

Nothing here waits, and nothing depends on the machine: the same scenario and seed give the same run, to the last bit.
Each agent's events, the lots of each sender, and each agent's quirks have random streams of their own, so that adding
one fault leaves the others as they are. Vehicles are tracks, without telemetry, so events are those of Algorithm 21.
"""

import base64
import dataclasses
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from harness.archive.run_record import Cycle
from harness.errors import AgentFailedError, ScenarioError
from harness.play._radio_range import TRACK_S, RadioRange, tracks_of
from harness.play.agent_control import Status
from harness.play.mission import RunOutcome, Sought
from harness.play.rogue.rogue_line import OF_NO_INJECTION, line_of
from harness.play.simulation._crash import crash_of
from harness.play.simulation._event_loop import ANY_LIFE, Clockwork
from harness.play.simulation._recurrence import LOOK_AFTER_S, Recurrence, Waiting
from harness.play.simulation._simulated_agent import Stored
from harness.play.simulation.air import NEVER, StrayDatagram, VirtualAir
from harness.play.simulation.fate_script import FateScript, NameOf
from harness.play.simulation.incarnations import Incarnation
from harness.play.simulation.run_files import Recorder
from harness.scenario import Scenario
from harness.scenario.changes import Change, NetworkChange, TimedInjection, disconnected_until, silent_injections
from harness.scenario.fates import Fate
from harness.scenario.faults import VehicleFault
from netem.radio import Place
from sitl.circumstances import Circumstance
from sitl.track import Track
from ucp.trace import HandlerRun

if TYPE_CHECKING:
    from harness.play._pace import Pace
    from harness.play.simulation.foreign._answer import AgentLacksError
    from harness.play.simulation.foreign._foreign_agent import LifeRecord
    from harness.play.simulation.foreign._virtual_program import Programs

ENGINE = "virtual time"
BREATH_S = 20.0
"""Mission seconds between two looks at whoever watches."""


class _AnyRun(Sought):
    def is_met_by(self, agent_id: int, run: HandlerRun) -> bool:
        return True


ANY_RUN = _AnyRun("any")


class Simulation(Clockwork):
    """A swarm in virtual time; see `harness.play.mission.Swarm`, and `Clockwork` for the options.

    `told`: the timeline is told while it is played, and may yet inject. `breathe` is awaited every few mission seconds,
    and time goes at this `pace`, if there is one.
    """

    def __init__(
        self,
        scenario: Scenario,
        seed: int,
        recorder: Recorder,
        *,
        deliver_all: bool = False,
        told: bool = False,
        breathe: Callable[["Simulation"], Awaitable[None]] | None = None,
        pace: "Pace | None" = None,
        fate_script: Callable[[Sequence[Fate], Sequence[int], NameOf], FateScript] = FateScript,
        air: Callable[..., VirtualAir] = VirtualAir,
        programs: "Programs | None" = None,
    ) -> None:
        super().__init__(
            scenario,
            seed,
            _initial_data(scenario, seed),
            recorder,
            deliver_all=deliver_all,
            told=told,
            fate_script=fate_script,
            air=air,
            programs=programs,
        )
        self.played = RunOutcome(engine=ENGINE)
        self.stage = "mission"
        self.network = ""
        self._breathe = breathe
        self._pace = pace
        self._disks: dict[int, Stored] = {}
        """What is on the disk of the agents that reboot with it."""
        self._switched_off: dict[int, Incarnation] = {}
        self._failures: dict[int, AgentFailedError | AgentLacksError] = {}
        self._reach = RadioRange(scenario)
        self._tracks = tracks_of(scenario)
        self._move_every_s = radio.update_s if (radio := scenario.network.radio) else TRACK_S
        self._all_rest_from_s = NEVER
        """The time after which all places stay the same, if only a channel needs places."""
        if self._channel and not (scenario.flight or scenario.gcs):
            self._all_rest_from_s = max(track.course.rests_from_s for track in self._tracks.values())
        self._moves_at = NEVER
        self.lost_vehicles: set[int] = set()
        """Those that fly no more."""
        self._injected: list[TimedInjection] = []
        """What the rogue node was told."""

    @property
    def tracks(self) -> Mapping[int, Track]:
        """How the vehicles fly, if anybody asks."""
        return self._tracks

    # The swarm, as harness.play.mission drives it

    def now(self) -> float:
        return self._now

    def enter(self, stage: str) -> None:
        self.stage = stage

    async def begin(self, first: Change) -> None:
        await self.apply(first)
        self._at_once = None
        self._move()
        if self._foreigners is not None:
            self._foreigners.start()
        for number in range(len(self.roster)):
            self._start(number)
        for event in self.scenario.events.script:
            logged = ANY_LIFE, event.event_id, event.event_data, event.timestamp_us
            self._air.expect(event.at_s, self._number[event.agent], logged)
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
        while (self._now < mission_s or self._in_an_instant) and self._found is None:
            breath_s = self._now + BREATH_S if self._breathe is not None else NEVER
            furthest = min(mission_s, breath_s, self._moves_at)
            if self._pace is None:
                self.run(furthest)
            else:
                await self._run_at(self._pace, furthest)
            if self._now == self._moves_at and not self._in_an_instant:
                self._move()
            if self._breathe is not None:
                await self._breathe(self)

    async def _run_at(self, pace: "Pace", furthest: float) -> None:
        """As `run`, but no further than the pace allows."""
        allowed_s = await pace.allows(self._now)
        if allowed_s is None:
            return
        if not pace.wants_run:
            self.run(min(furthest, allowed_s))
            return
        self._sought = ANY_RUN
        self.run(furthest)
        if self._found is not None:
            pace.ran(self._now)
        self._sought = self._found = None

    async def until_run(self, sought: Sought, mission_s: float) -> int | None:
        self._deliver_all = True  # also what does nothing is a handler run
        self._air.deliver_everything()
        at_once, self._at_once = self._at_once or [], None
        for index, (agent_id, run) in enumerate(at_once):
            if sought.is_met_by(agent_id, run):
                self._at_once = at_once[index + 1 :]
                return agent_id
        self._sought, self._found = sought, None
        await self.until(mission_s)
        found, self._sought, self._found = self._found, None, None
        return found

    async def hold(self, fate: Fate) -> int:
        return self._script.hold(fate)

    async def release(self, number: int, fate: Fate) -> None:
        assert fate.hold_until_s is not None, "by now it is known"
        self._script.release(number, fate)
        self._air.release(number, fate.hold_until_s)

    async def apply(self, change: Change) -> None:
        self._at_once = []
        if isinstance(change, NetworkChange):
            self._put_into_force(self._reach.ask(change), asked=change.conditions.to_json())
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
            await change.apply(self, agent_id)
        self._recorder.changed(record)

    def _put_into_force(self, change: NetworkChange, **more: Any) -> None:
        self._air.apply(change.conditions, self._now, clears_all=change.clears_all)
        self.network = change.detail
        record = change.to_json(round(self._now, 3))
        self.played.record(record)
        self._recorder.changed({**record, **more})

    def _move(self) -> None:
        """The vehicles are somewhere else by now."""
        if not self._tracks:
            return
        places = {vehicle: Place(*track.in_field(self._now)) for vehicle, track in self._tracks.items()}
        self._recorder.moved(self._now, places)
        self._air.move(places, self._now)
        if change := self._reach.move(self._now, places):
            self._put_into_force(change)
        self._moves_at = self._now + self._move_every_s if self._now < self._all_rest_from_s else NEVER

    async def stop_events(self) -> None:
        self._generating = False

    async def until_idle(self, limit_s: float) -> bool:
        limit, look_at = self._now + limit_s, self._now + LOOK_AFTER_S
        recurrence, self._recurrence, self.played.cycle = self._looks_for_recurrence(), None, None
        while self._now < limit:
            awake = (life for life in self.living() if life.waiting is None)
            last = max([self._air.quiet_at, *(life.deadline or 0.0 for life in awake)])
            if last <= self._now:
                return self._stands_still()
            if recurrence is None or self._now < look_at:
                await self.until(min(limit, last))
            elif await self._recurs_until(min(limit, last), recurrence):
                return False
        return False

    def _stands_still(self) -> bool:
        """Whether all agents are idle, now that nothing is on its way and no timer runs; those that are not hang."""
        hanging = [life.agent for life in self.living() if life.waiting is None and not life.idle]
        if hanging and not self._generating:
            agents = [agent.agent_id for agent in hanging]
            self.played.cycle = Cycle(since_s=round(self._now, 3), proven=True, agents=agents)
        return not hanging and all(life.waiting is None for life in self.living())

    def _looks_for_recurrence(self) -> Recurrence | None:
        """None while there is more to come than agents themselves do, or lots decide what becomes of them."""
        moving = bool(self._tracks) and self.scenario.network.radio and self.played.final_reconcile is None
        delays = self._medium.certain_delays()
        unknown = self._anybody_is_unknown or self._rogue is not None
        spread = self.scenario.settings.answer_spread_s > 0  # answers wait differently each time
        if self._generating or moving or unknown or delays is None or self._channel is not None or spread:
            return None
        return Recurrence(delays)

    async def _recurs_until(self, mission_s: float, recurrence: Recurrence) -> bool:
        """As `until`, but no further than until the swarm is seen to go round in circles; whether it was."""
        self._recurrence = recurrence
        while self._now < mission_s:
            if self._air.quiet_at > self._now:
                await self.until(min(mission_s, self._air.quiet_at))
                continue
            lives = {number: life for number, life in enumerate(self._alive) if life and life.waiting is None}
            for number, life in lives.items():
                self._hear(number, life)
            wakes_s = {number: life.deadline for number, life in lives.items() if life.deadline is not None}
            next_s = min(wakes_s.values())
            swarm = [
                Waiting(life.state, life.local_s(next_s), life.deadline)
                for life in lives.values()
                if life.state is not None
            ]
            fates = self._script.standing(self._now)
            order = [
                *self._air.order_of_timers(wakes_s),
                *(name for late in self._late.values() for name in late.running),
            ]
            all_on_time = all(late.all_have_ended for late in self._late.values())
            if all_on_time and fates is not None and recurrence.look(swarm, order, fates, self._script.last_s or 0.0):
                self.played.cycle = recurrence.cycle(swarm)
                return True
            await self.until(min(mission_s, next_s))
            recurrence.timers_have_ended(swarm)
        return False

    async def keep_chains(self) -> None:
        self._recorder.keep_chains(self._now, self.exporting())

    async def reconcile(self, agent_id: int) -> None:
        number = self._number[agent_id]
        life = self._alive[number]
        if life is not None and life.waiting is None:
            self._hear(number, life)
            try:
                life.agent.begin_reconcile(life.local_s(self._now))
            except Exception as error:
                if (crash := crash_of(life, error)) is None:
                    raise
                raise crash from error
            self._after(number, life)

    async def top_chain_hashes(self) -> dict[int, str]:
        return {life.agent.agent_id: life.top_chain_hash for life in self.living()}

    async def completed(self) -> dict[int, int]:
        return {life.agent.agent_id: len(life.agent.completed()) for life in self.living() if life.waiting is None}

    async def snapshot(self) -> RunOutcome:
        played = self._played_by_now()
        self._recorder.export(self._now, self.exporting())
        return played

    def fail(self, error: "AgentFailedError | AgentLacksError") -> None:
        """The mission is over: an agent crashed or hung, or cannot do it."""
        number = self._number[error.agent_id]
        if (life := self._alive[number]) is not None:
            life.ended_at = self._now
        self._alive[number] = None
        self._air.is_gone(number)
        self._failures[number] = error
        if self.played.outcome == "completed":
            self.played.end_early("failed", error)

    def close(self) -> None:
        """Nobody is asked anything any more."""
        if self._foreigners is not None:
            self._foreigners.close()

    def end(self) -> None:
        """Take down what there is at the end."""
        if self._rogue is not None:
            self._rogue.close()
        self.played = self._played_by_now()

    def _played_by_now(self) -> RunOutcome:
        for number, life in enumerate(self._alive):
            if life is not None:
                self._hear(number, life)
        last_s, network = self._script.last_s, self.played.network
        return dataclasses.replace(
            self.played,
            mission_s=round(self._now, 3),
            network=network if last_s is None else disconnected_until(last_s, network),
            channel=self._channel_to_json(),
            unmatched_fates=[*self._air.unmatched_fates(), *self._injected_nothing()],
            agents={str(agent_id): self._agent_to_json(number) for agent_id, number in self._number.items()},
        )

    def _channel_to_json(self) -> dict[str, Any] | None:
        asked = self.scenario.network.channel
        if self._channel is None or asked is None:
            return None
        return {"model": asked.to_json(), **self._channel.totals.to_json()}

    def _injected_nothing(self) -> list[str]:
        return silent_injections(self._injected, self._rogue.sent) if self._rogue is not None else []

    # What is there

    def living(self) -> Iterator[Incarnation]:
        return (life for life in self._alive if life is not None)

    def exporting(self) -> Iterator[Incarnation]:
        """Those who leave an export, in the roster's order: who lives, and who was switched off."""
        for number, life in enumerate(self._alive):
            if (leaves := self._switched_off.get(number, life)) is not None:
                yield leaves

    def records(self) -> list["LifeRecord"]:
        """What agents of another make were given and answered, by life."""
        return [] if self._foreigners is None else self._foreigners.records

    def _agent_to_json(self, number: int) -> dict[str, Any]:
        lives = self._lives[number]
        off, failure = self._switched_off.get(number), self._failures.get(number)
        life = off or self._alive[number]
        completed = dict.fromkeys(block.hex() for life in lives for block in life.agent.completed())
        for block in life.agent.completed() if life else ():
            del completed[block.hex()]
        reboots = sum(life.rebooted for life in lives)
        known = [life.agent.known_status() for life in lives]
        dropped = sum((Counter(status.dropped) for status in known if status), Counter[str]())
        gone = "rebooting" if number in self._disks else "killed" if lives else "not started"
        ended = failure.outcome if failure else gone
        detail = failure.detail if failure else f"switched off at {off.ended_at:g} s" if off else None
        return {
            "outcome": "exported" if life else ended,
            **({"detail": detail} if detail else {}),
            **self._whose(number, known),
            "restarts": max(0, len(lives) - 1 - reboots),
            "reboots": reboots,
            "completed_before": list(completed),
            "idle": life.idle if life else None,
            "bytes_sent": sum(life.bytes_sent for life in lives),
            **({"dropped": dict(dropped)} if self._rogue is not None or self._keys is not None else {}),
            "messages_sent": sum(life.agent.messages_sent for life in lives),
            "reconciles": sum(status.reconciles for status in known if status) if all(known) else None,
            "chain_changed_at_s": _rounded(life.chain_changed_at) if life else None,
            **(
                {"handler_runs": [self._handler_runs(*each) for each in zip(lives, known, strict=True)]}
                if self._tracing
                else {}
            ),
        }

    def _whose(self, number: int, known: Sequence[Status | None]) -> dict[str, Any]:
        """Whose make the agent is, if it is not ours."""
        agent_id = self.roster[number]
        if self._foreigners is None or agent_id not in self._foreigners:
            return {}
        version = next((status.version for status in reversed(known) if status), None)
        return {"command": self._foreigners.command_of(agent_id), "version": version}

    def _handler_runs(self, life: Incarnation, status: Status | None) -> dict[str, int | float] | None:
        """How many it has counted; if nobody sees into it, as it says itself."""
        if status is None:
            return None
        at_s = self._now if life.ended_at is None else life.ended_at
        counted = status.handled if life.state is None else life.handler_runs
        return {"counted": counted, "from_s": round(at_s, 3), "until_s": round(at_s, 3)}

    # What faults do to it: harness.scenario.faults.AgentOperations

    async def end_incarnation(self, agent_id: int, *, with_vehicle: bool = False, disk_kept: bool = False) -> None:
        number = self._number[agent_id]
        if with_vehicle:
            self.lost_vehicles.add(agent_id)
        if (life := self._alive[number]) is not None:
            self._hear(number, life)
            life.ended_at = self._now
            if disk_kept:
                self._disks[number] = life.agent.stored(life.local_s(self._now))
            life.agent.leave(life.local_s(self._now))
            if self._foreigners is not None:
                self._foreigners.ended(life.agent)
        self._alive[number] = None
        self._air.is_gone(number)

    async def begin_incarnation(self, agent_id: int, *, new_vehicle: bool = False) -> None:
        number = self._number[agent_id]
        self.lost_vehicles.discard(agent_id)
        self._start(number, self._disks.pop(number, None))

    async def fall(self, agent_id: int) -> None:
        """A track knows nothing of that."""
        self.lost_vehicles.add(agent_id)

    async def revoke(self, agent_id: int, heard_by: Sequence[int]) -> None:
        assert self._keys is not None, "was refused"
        revocation = self._keys.mission.revoke(agent_id)
        for number in map(self._number.__getitem__, heard_by):
            life = self._alive[number]
            if life is not None and life.waiting is None and life.secured is not None:
                self._hear(number, life)
                life.secured.revoke(revocation, life.local_s(self._now))
                self._after(number, life)

    async def set_circumstance(self, agent_id: int, what: str, circumstance: Circumstance, *, by_hand: bool) -> None:
        raise AssertionError("was refused")

    async def pause(self, agent_id: int) -> None:
        number = self._number[agent_id]
        if (life := self._alive[number]) is not None:
            self._hear(number, life)
            life.waiting = []
            self._air.paused_at[number] = self._now

    async def resume(self, agent_id: int) -> None:
        number = self._number[agent_id]
        life = self._alive[number]
        if life is not None and life.waiting is not None:
            self._resume(number, life, life.waiting)

    async def stop_logging(self, agent_id: int) -> None:
        if (life := self._alive[self._number[agent_id]]) is not None:
            life.logs = False

    async def switch_off(self, agent_id: int) -> None:
        number = self._number[agent_id]
        life = self._alive[number]
        await self.end_incarnation(agent_id, with_vehicle=True)
        if life is not None:
            self._switched_off[number] = life


def no_vehicles(keys: Sequence[str]) -> str:
    """Why these keys cannot be played here, and the way out."""
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
