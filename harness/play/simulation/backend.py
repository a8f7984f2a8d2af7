"""The simulation backend: a scenario played in virtual time, by the very agents that `ucp.node` runs.

Nothing here waits, and nothing depends on the machine: the same scenario and seed give the same run, to the last bit.
Each agent's events, the lots of each sender, and each agent's quirks have random streams of their own, so that adding
one fault leaves the others as they are. Vehicles are tracks, without telemetry, so events are those of Algorithm 21.
"""

import base64
import dataclasses
from collections import Counter, deque
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from random import Random
from typing import TYPE_CHECKING, Any, Protocol

from harness.gc_pause import gc_paused
from harness.play.mission import RunOutcome, Sought
from harness.play.radio_range import TRACK_S, RadioRange, tracks_of
from harness.play.rogue.line import OF_NO_INJECTION, line_of
from harness.play.seeds import agent_seed
from harness.play.simulation.air import NEVER, Happening, InFlight, Logged, RogueDatagram, VirtualAir
from harness.play.simulation.fate_script import FateScript, NameOf
from harness.play.simulation.late_timers import LateTimers
from harness.play.simulation.recurrence import LOOK_AFTER_S, Recurrence, Waiting
from harness.scenario import Scenario
from harness.scenario.changes import Change, Injected, NetworkChange, disconnected_until, injected_nothing
from harness.scenario.fates import Fate
from harness.scenario.scenario import Clock
from netem.medium import Medium
from netem.radio import Place
from ucp.agent import Agent
from ucp.clock import MICROSECONDS
from ucp.events import LoggableEvent, RandomEvents
from ucp.interest import ONLY_COUNTED
from ucp.messages import Message, datagram_bytes
from ucp.quirks import wrong_handlers
from ucp.store import StoredState
from ucp.trace import Entry, HandlerRun, Recorded

if TYPE_CHECKING:
    from harness.play.simulation.rogue import VirtualRogue

ENGINE = "virtual time"
ANY_LIFE = 0
REMEMBERED = 10_000
"""Messages that a rogue node knows of that comes later: as many as it keeps itself."""
BREATH_S = 20.0
"""Mission seconds between two looks at whoever watches."""


class Recorder(Protocol):
    """Takes down what cannot be asked for at the end."""

    tracing: bool
    """Whether handler runs are wanted; if not, `write` is not called."""

    def begin(self, life: "Incarnation") -> None:
        """An agent starts, or starts anew."""

    def logged(self, at_s: float, agent_id: int, data_bytes: int) -> None:
        """An agent is about to log an event with so much data."""

    def write(self, agent_id: int, entries: list[Entry]) -> None: ...

    def changed(self, record: dict[str, Any]) -> None:
        """A change of the network, or a fault of agents, was made."""

    def injected(self, record: dict[str, Any]) -> None:
        """The rogue node has sent something; see `harness.play.rogue.journal`."""

    def moved(self, at_s: float, places: Mapping[int, Place]) -> None:
        """Here are the vehicles now, if any fly."""

    def keep_chains(self, simulation: "Simulation") -> None:
        """A final reconcile is about to put the chains in order."""

    def export(self, simulation: "Simulation") -> None:
        """Somebody wants to see the chains as they are now. Raises OSError."""


@dataclass(slots=True)
class Incarnation:
    """An agent from its start, restart or reboot on."""

    agent: Agent
    source: RandomEvents
    clock: Clock | None
    """None shows mission time."""
    born_at: float
    recovered: StoredState | None = None
    """What was on its disk, if it came back from a brown-out with it."""
    deadline: float | None = None
    """When its next timer ends, in mission seconds."""
    waiting: list[Happening] | None = None
    """What has reached the agent while it is paused; None if it is not."""
    resumed_at: float = 0.0
    """Whatever came before is handled then."""
    bytes_sent: int = 0
    handler_runs: int = 0
    """Counted while tracing."""
    ended_at: float | None = None
    logs: bool = True
    """Whether it still logs events."""


class BlockNames:
    """What people call the blocks of `roster`, whose agents have had these `lives` up to now."""

    def __init__(self, roster: Sequence[int], lives: Sequence[Sequence[Incarnation]]) -> None:
        self._roster = roster
        self._lives = lives
        self._names: dict[bytes, str] = {}

    def of(self, block_hash: bytes) -> str | None:
        """`<agent>.<ordinal>` of a block that an agent has completed."""
        if block_hash not in self._names:
            for agent_id, lives in zip(self._roster, self._lives, strict=True):
                completed = dict.fromkeys(block for life in lives for block in life.agent.state.completed)
                self._names.update((block, f"{agent_id}.{count}") for count, block in enumerate(completed, 1))
        return self._names.get(block_hash)


class Simulation:
    """A swarm in virtual time; see `harness.play.mission.Swarm`. Agents are numbered in the roster's order.

    `deliver_all`: deliver also what cannot matter, which takes longer and changes nothing but the traces. Where anybody
    has quirks all hear everything: what cannot matter to the right agent may matter to a wrong one. `told`: the
    timeline is told while it is played, and may yet inject. `breathe` is awaited every few mission seconds.
    `fate_script` makes what plays the scenario's fates, and `air` what carries messages.
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
        fate_script: Callable[[Sequence[Fate], Sequence[int], NameOf], FateScript] = FateScript,
        air: Callable[..., VirtualAir] = VirtualAir,
    ) -> None:
        self.scenario = scenario
        self.roster = scenario.roster
        self.seed = seed
        self.played = RunOutcome(engine=ENGINE)
        self.stage = "mission"
        self.network = ""
        self._initial_data = _initial_data(scenario, seed)
        self._recorder = recorder
        self._tracing = recorder.tracing
        self._deliver_all = deliver_all = deliver_all or scenario.has_wrong_agents
        self._breathe = breathe
        self._now = 0.0
        self._generating = True
        self._number = {agent_id: number for number, agent_id in enumerate(self.roster)}
        self._lives: list[list[Incarnation]] = [[] for _ in self.roster]
        self._alive: list[Incarnation | None] = [None] * (len(self.roster) + 1)
        """By number; the last is the rogue node's, which is no agent and has no life."""
        self._disks: dict[int, StoredState] = {}
        """What is on the disk of the agents that reboot with it."""
        self._switched_off: dict[int, Incarnation] = {}
        self._late = {self._number[agent_id]: LateTimers(text) for agent_id, text in scenario.lateness.items()}
        """By number, of the agents that have any."""
        self._reach = RadioRange(scenario)
        self._tracks = tracks_of(scenario)
        self._move_every_s = radio.update_s if (radio := scenario.network.radio) else TRACK_S
        self._moves_at = NEVER
        self._medium = Medium(self.roster, seed)
        self._script = fate_script(scenario.fates, self.roster, BlockNames(self.roster, self._lives).of)
        self._air = air(self.roster, scenario.settings, self._medium, self._script, deliver_all=deliver_all)
        self._rogue = self._rogue_node() if scenario.rogue else None
        self._injected: list[Injected] = []
        """What the rogue node was told."""
        self._on_the_air: deque[tuple[int, int, Message, float]] | None = deque(maxlen=REMEMBERED) if told else None
        """What a rogue node would have heard, if there is none and may be one."""
        self._sought: Sought | None = None
        self._found: int | None = None
        """The agent that has run what was sought."""
        self._at_once: list[tuple[int, HandlerRun]] | None = None
        """What agents have run at the last change; None once time has passed."""
        self._recurrence: Recurrence | None = None
        """Is told of timers that end, once the swarm has had its time to finish."""

    def _rogue_node(self) -> "VirtualRogue":
        from harness.play.simulation.rogue import VirtualRogue  # scapy takes long to import

        return VirtualRogue(self.roster, self.seed, self._air, len(self.roster), self._recorder.injected)

    def _late_rogue(self) -> "VirtualRogue":
        """One that has been on the air all along, and begins to send now."""
        assert self._on_the_air is not None, "a scenario that injects has a rogue node from the beginning"
        rogue = self._rogue_node()
        for sender, sequence, message, sent_at in self._on_the_air:
            rogue.hears(sender, sequence, message, sent_at)
        return rogue

    # The swarm, as harness.play.mission drives it

    def now(self) -> float:
        return self._now

    def enter(self, stage: str) -> None:
        self.stage = stage

    async def begin(self, first: Change) -> None:
        await self.apply(first)
        self._at_once = None
        self._move()
        for number in range(len(self.roster)):
            self._start(number)
        for event in self.scenario.events.script:
            logged = ANY_LIFE, event.event_id, event.event_data, event.timestamp_us
            self._air.expect(event.at_s, self._number[event.agent], logged)
        for scripted in self.scenario.datagrams:
            stray = RogueDatagram(scripted.source, base64.b64decode(scripted.datagram))
            for agent_id, at_s in scripted.reaches.items():
                self._air.inject(at_s, stray, [self._number[agent_id]])
            at_s = min(scripted.reaches.values())
            self._recorder.injected(line_of(at_s, OF_NO_INJECTION, "datagram", stray.source, stray.datagram))

    async def until(self, mission_s: float) -> None:
        if self._breathe is None and not self._tracks:
            self._run(mission_s)
            return
        while self._now < mission_s and self._found is None:
            self._run(min(mission_s, self._now + BREATH_S, self._moves_at))
            if self._now == self._moves_at:
                self._move()
            if self._breathe is not None:
                await self._breathe(self)

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
        record = change.to_json(round(self._now, 3))
        self.played.record(record)
        if isinstance(change, Injected):
            self._injected.append(change)
            if self._rogue is None:
                self._rogue = self._late_rogue()
            self._rogue.begin(change, self._now)
            return
        for agent_id in change.agents:
            await change.strike(self, agent_id)
        self._recorder.changed(record)

    def _put_into_force(self, change: NetworkChange, **more: Any) -> None:
        self._medium.apply(change.conditions)
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
        if change := self._reach.move(self._now, places):
            self._put_into_force(change)
        self._moves_at = self._now + self._move_every_s

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
        hanging = [life.agent for life in self.living() if life.waiting is None and not life.agent.state.idle]
        if hanging and not self._generating:
            agents = [agent.agent_id for agent in hanging]
            self.played.cycle = {"since_s": round(self._now, 3), "proven": True, "agents": agents}
        return not hanging and all(life.waiting is None for life in self.living())

    def _looks_for_recurrence(self) -> Recurrence | None:
        """None while there is more to come than agents themselves do, or lots decide what becomes of them."""
        moving = bool(self._tracks) and self.scenario.network.radio and self.played.final_reconcile is None
        delays = self._medium.certain_delays()
        wrong = self.scenario.has_wrong_agents
        if self._generating or moving or self._rogue is not None or wrong or delays is None or self._late:
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
            swarm = [Waiting(life.agent.state, self._local(life, next_s), life.deadline) for life in lives.values()]
            fates = self._script.standing(self._now)
            order = self._air.order_of_timers(wakes_s)
            if fates is not None and recurrence.look(swarm, order, fates, self._script.last_s or 0.0):
                self.played.cycle = recurrence.cycle(swarm)
                return True
            await self.until(min(mission_s, next_s))
            recurrence.timers_have_ended(swarm)
        return False

    async def keep_chains(self) -> None:
        self._recorder.keep_chains(self)

    async def reconcile(self, agent_id: int) -> None:
        number = self._number[agent_id]
        life = self._alive[number]
        if life is not None and life.waiting is None:
            self._hear(number, life)
            life.agent.begin_reconcile(self._local(life))
            self._after(number, life)

    async def top_chain_hashes(self) -> dict[int, str]:
        return {life.agent.agent_id: life.agent.state.chain.top_chain_hash.hex() for life in self.living()}

    async def completed(self) -> dict[int, int]:
        return {life.agent.agent_id: len(life.agent.state.completed) for life in self.living() if life.waiting is None}

    async def snapshot(self) -> RunOutcome:
        played = self._played_by_now()
        self._recorder.export(self)
        return played

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
            unmatched_fates=[*self._air.unmatched_fates(), *self._injected_nothing()],
            agents={str(agent_id): self._agent_to_json(number) for agent_id, number in self._number.items()},
        )

    def _injected_nothing(self) -> list[str]:
        return injected_nothing(self._injected, self._rogue.sent) if self._rogue is not None else []

    # What is there

    def living(self) -> Iterator[Incarnation]:
        return (life for life in self._alive if life is not None)

    def exporting(self) -> Iterator[Incarnation]:
        """Those who leave an export, in the roster's order: who lives, and who was switched off."""
        for number, life in enumerate(self._alive):
            if (leaves := self._switched_off.get(number, life)) is not None:
                yield leaves

    def timestamp_us(self, life: Incarnation) -> int:
        """What the agent's clock shows, or showed at its end, in microseconds; never less than 0."""
        return max(0, round(self._local(life, life.ended_at) * MICROSECONDS))

    def _agent_to_json(self, number: int) -> dict[str, Any]:
        lives = self._lives[number]
        off = self._switched_off.get(number)
        life = off or self._alive[number]
        completed = dict.fromkeys(block.hex() for life in lives for block in life.agent.state.completed)
        for block in life.agent.state.completed if life else ():
            del completed[block.hex()]
        reboots = sum(life.recovered is not None for life in lives)
        dropped = sum((life.agent.dropped for life in lives), Counter())
        return {
            "outcome": "exported" if life else "rebooting" if number in self._disks else "killed",
            **({"detail": f"switched off at {off.ended_at:g} s"} if off else {}),
            "restarts": len(lives) - 1 - reboots,
            "reboots": reboots,
            "completed_before": list(completed),
            "idle": life.agent.state.idle if life else None,
            "bytes_sent": sum(life.bytes_sent for life in lives),
            **({"dropped": dict(dropped)} if self._rogue is not None else {}),
            "messages_sent": sum(life.agent.state.sent.total() for life in lives),
            "reconciles": sum(life.agent.state.reconciles for life in lives),
            "chain_changed_at_s": round(_chain_changed_at(life), 3) if life else None,
            **({"handler_runs": [self._handler_runs(life) for life in lives]} if self._tracing else {}),
        }

    def _handler_runs(self, life: Incarnation) -> dict[str, int | float]:
        at_s = self._now if life.ended_at is None else life.ended_at
        return {"counted": life.handler_runs, "from_s": round(at_s, 3), "until_s": round(at_s, 3)}

    # What happens

    def _run(self, until: float) -> None:
        """All that happens up to `until`."""
        self._at_once = None
        with gc_paused():
            self._play(until)
        if self._found is None:
            self._now = until

    def _play(self, until: float) -> None:
        alive = self._alive
        for happening in self._air.until(until):
            self._now, _, number, what = happening
            life = alive[number]
            if life is None:
                if self._rogue is not None and number == len(self.roster):
                    self._rogue.wake(self._now)
            elif life.waiting is None:
                self._happen(number, life, what)
            elif what is not None:
                life.waiting.append(happening)
            if self._found is not None:
                return

    def _happen(self, number: int, life: Incarnation, what: InFlight | Logged | RogueDatagram | None) -> None:
        agent = life.agent
        if isinstance(what, InFlight):
            message = what.message
            if self._tracing or type(message) in ONLY_COUNTED:
                self._hear(number, life)
            if what.sent_at < life.born_at:
                return
            if self._deliver_all or what.matters(agent.state, what.sender, message):
                now = self._now if life.clock is None else self._local(life)
                agent.receive_message(what.sender, what.sequence, message, now, what.datagram)
                self._say(number, life)
                if self._deliver_all or agent.state.reconcile_in_progress:
                    self._wait(number, life)  # of the right handlers of messages only a reconcile's touch timers
        elif what is None:
            self._timer_ends(number, life)
        elif isinstance(what, RogueDatagram):
            self._hear(number, life)
            agent.receive_datagram(what.datagram, self._local(life))
            self._after(number, life)
        elif self._generating and life.logs and what[0] in (ANY_LIFE, len(self._lives[number])):
            if self._tracing:
                self._hear(number, life)
            _, event_id, data, timestamp_us = what
            if timestamp_us is None:
                timestamp_us = self.timestamp_us(life)
            self._recorder.logged(self._now, agent.agent_id, len(data))
            agent.add_event(LoggableEvent(timestamp_us, event_id, data), self._local(life))
            self._expect_event(number, life)
            self._after(number, life)

    def _timer_ends(self, number: int, life: Incarnation) -> None:
        if life.deadline is None or life.deadline > self._now or (soonest := life.agent.next_timer()) is None:
            return  # it was stopped, or started anew, since it was expected to end now
        self._hear(number, life)
        if self._recurrence is not None:
            self._recurrence.timers_end(self._now, max(soonest, self._local(life)), life.agent.state)
        if number in self._late:
            self._late_timer_ends(number, life)
        else:
            life.agent.handle_timer(max(soonest, self._local(life)))
        self._air.no_longer_asked(number, life.agent.state)
        self._after(number, life)

    def _hear(self, number: int, life: Incarnation) -> None:
        """Tell the agent of the answers that have come and that it only tallies.

        Before anybody looks at the tally; and in a trace everything stands in its order.
        """
        if life.waiting is not None or not self._air.asked_by[number]:
            return
        agent, state = life.agent, life.agent.state
        for at, _, answer in self._air.hear(number):
            if answer.matters(state, answer.sender, answer.message):
                at = max(at, life.resumed_at)
                local = max(state.now, self._local(life, at))
                agent.receive_message(answer.sender, answer.sequence, answer.message, local, answer.datagram)
                if self._tracing:
                    self._take_down(life, at)

    def _after(self, number: int, life: Incarnation) -> None:
        """Do what the agent says after an input: send, trace, and wait for its next timer."""
        self._say(number, life)
        self._wait(number, life)

    def _say(self, number: int, life: Incarnation) -> None:
        """Send what the agent has to say, and take down what it has done."""
        in_trace = iter(self._take_down(life, self._now)) if self._tracing else None
        for sequence, message in life.agent.messages_to_send():
            data_bytes = datagram_bytes(message)
            life.bytes_sent += data_bytes
            datagram = next(in_trace) if in_trace else None
            self._air.broadcast(self._now, number, sequence, message, data_bytes, datagram)
            if self._rogue is not None:
                self._rogue.hears(life.agent.agent_id, sequence, message, self._now)
            elif self._on_the_air is not None:
                self._on_the_air.append((life.agent.agent_id, sequence, message, self._now))

    def _wait(self, number: int, life: Incarnation) -> None:
        """Wait for the agent's next timer."""
        agent = life.agent
        soonest = agent.next_timer()
        deadline = None if soonest is None else max(self._now, self._ends_at(number, life, soonest))
        if deadline != life.deadline:
            life.deadline = deadline
            if deadline is not None:
                self._air.expect(deadline, number, None)
        busy_until = agent.answers_nobody_until()
        self._air.busy_until[number] = 0.0 if busy_until is None else _mission_time(life, busy_until)

    def _ends_at(self, number: int, life: Incarnation, soonest: float) -> float:
        """When a timer ends next, of which the first should by the agent's clock at `soonest`."""
        if number not in self._late:
            return _mission_time(life, soonest)
        late = self._late[number]
        late.look(life.agent.state)
        ends = late.next(partial(_mission_time, life))
        assert ends is not None, "a timer runs"
        return ends[0]

    def _late_timer_ends(self, number: int, life: Incarnation) -> None:
        ends = self._late[number].next(partial(_mission_time, life))
        assert ends is not None, "it was expected to end now"
        name, _, deadline = ends[1]
        timer = next(timer for timer in life.agent.state.timers if timer.name == name)
        life.agent.end_timer(timer, max(deadline, self._local(life)))

    def _take_down(self, life: Incarnation, mission_s: float) -> list[Recorded | None]:
        """Write what the agent has done into its trace; the datagrams that it sent, as the trace has them."""
        entries = life.agent.trace()
        datagrams = []
        for entry in entries:
            entry.t = mission_s
            if isinstance(entry, HandlerRun):
                life.handler_runs += 1
                self._look(life.agent.agent_id, entry)
                for sent in entry.sent:
                    datagrams.append(sent.datagram)
        self._recorder.write(life.agent.agent_id, entries)
        return datagrams

    def _look(self, agent_id: int, run: HandlerRun) -> None:
        """Whether it is what somebody waits for, or will wait for in a moment."""
        if self._at_once is not None:
            self._at_once.append((agent_id, run))
        elif self._sought is not None and self._found is None and self._sought.is_met_by(agent_id, run):
            self._found = agent_id

    # An agent's life

    def _start(self, number: int, stored: StoredState | None = None) -> None:
        agent_id = self.roster[number]
        scenario = self.scenario
        seed = agent_seed(self.seed, agent_id, len(self._lives[number]) + 1)
        agent = Agent(
            agent_id,
            self.roster,
            self._initial_data,
            scenario.settings,
            handlers=wrong_handlers(scenario.quirks_of(agent_id), Random(seed)),
            tracing=self._tracing,
        )
        source = RandomEvents(Random(seed), scenario.events.mean_s)
        life = Incarnation(agent, source, scenario.clocks.get(agent_id), self._now, stored)
        self._lives[number].append(life)
        self._alive[number] = life
        self._air.born_at[number] = self._now
        self._recorder.begin(life)
        if stored is not None:
            agent.boot(stored, self._local(life))
            self._after(number, life)
        self._expect_event(number, life)

    def _expect_event(self, number: int, life: Incarnation) -> None:
        if self.scenario.events.source != "scripted":
            due, event_id, data = life.source.next()
            this_life = len(self._lives[number])
            self._air.expect(max(self._now, life.born_at + due), number, (this_life, event_id, data, None))

    # What faults do to it: harness.scenario.faults.Lives

    async def end_life(self, agent_id: int, *, with_vehicle: bool = False, disk_kept: bool = False) -> None:
        number = self._number[agent_id]
        if (life := self._alive[number]) is not None:
            self._hear(number, life)
            life.ended_at = self._now
            if disk_kept:
                self._disks[number] = StoredState.of(life.agent.state)
        self._alive[number] = None
        self._air.is_gone(number)

    async def begin_life(self, agent_id: int, *, new_vehicle: bool = False) -> None:
        number = self._number[agent_id]
        self._start(number, self._disks.pop(number, None))

    async def fall(self, agent_id: int) -> None:
        """A track knows nothing of that."""

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

    def _resume(self, number: int, life: Incarnation, waiting: list[Happening]) -> None:
        """What has waited is handled as a process does it: what the socket holds, then timers, then events.

        What an agent asks while there is more in the socket may be answered by what came since.
        """
        life.waiting, life.resumed_at = None, self._now
        place = self._air.place
        for happening in waiting:
            if isinstance(happening[3], InFlight | RogueDatagram):
                self._air.place = happening
                self._happen(number, life, happening[3])
        self._air.place = place
        del self._air.paused_at[number]
        self._hear(number, life)
        self._timer_ends(number, life)
        for happening in waiting:
            if not isinstance(happening[3], InFlight | RogueDatagram):
                self._happen(number, life, happening[3])

    async def stop_logging(self, agent_id: int) -> None:
        if (life := self._alive[self._number[agent_id]]) is not None:
            life.logs = False

    async def switch_off(self, agent_id: int) -> None:
        number = self._number[agent_id]
        life = self._alive[number]
        await self.end_life(agent_id)
        if life is not None:
            self._switched_off[number] = life

    # An agent's clock

    def _local(self, life: Incarnation, mission_s: float | None = None) -> float:
        """What the agent takes for mission time: now, or at `mission_s`."""
        clock = life.clock
        now = self._now if mission_s is None else mission_s
        return now if clock is None else clock.offset_s + (1 + clock.drift) * now


def _initial_data(scenario: Scenario, seed: int) -> bytes:
    if scenario.initial_data is not None:
        return base64.b64decode(scenario.initial_data)
    return f"{scenario.name}, seed {seed}".encode()


def _chain_changed_at(life: Incarnation) -> float:
    """In mission seconds; 0 if it never did, whatever the agent's clock then showed."""
    local = life.agent.state.chain_changed_at
    return _mission_time(life, local) if local else 0.0


def _mission_time(life: Incarnation, local: float) -> float:
    """When the agent's clock shows `local`."""
    clock = life.clock
    return local if clock is None else (local - clock.offset_s) / (1 + clock.drift)
