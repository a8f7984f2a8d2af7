"""The clockwork of virtual time: what happens to which agent, in the order in which it happens.

An agent is given messages, events and the ends of its timers, and what it says goes on the air. Nothing here knows of a
mission; `simulation.py` does.
"""

import base64
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from random import Random
from typing import TYPE_CHECKING, cast

from harness.gc_pause import gc_paused
from harness.play.backend import agent_seed
from harness.play.core_version import edited_files
from harness.play.mission import Sought
from harness.play.simulation._crash import crash_of
from harness.play.simulation._recurrence import Recurrence
from harness.play.simulation._shared_channel import ChannelTraffic
from harness.play.simulation._simulated_agent import OwnAgent, Stored, VirtualAgent
from harness.play.simulation.air import Happening, InFlight, Logged, StrayDatagram, VirtualAir
from harness.play.simulation.fate_script import FateScript, LateTimers, NameOf
from harness.play.simulation.incarnations import BlockNames, Incarnation, Secured
from harness.play.simulation.run_files import Recorder
from harness.play.simulation.seals import seals_of
from harness.play.variant import variant_in_use
from harness.scenario import Scenario
from harness.scenario.fates import Fate
from netem.medium import AT_ONCE, LATENCY, Medium
from ucp.events import LoggableEvent, RandomEvents
from ucp.interest import ONLY_COUNTED
from ucp.messages import Message, datagram_bytes
from ucp.quirks import wrong_handlers
from ucp.store import StoredState
from ucp.trace import HandlerRun

if TYPE_CHECKING:
    from harness.play.simulation._secured_agents import Keys
    from harness.play.simulation._simulated_rogue import VirtualRogue
    from harness.play.simulation.foreign._foreigners import Foreigners
    from harness.play.simulation.foreign._virtual_program import Programs
    from ucp.secure.bundle import PublicKeys
    from ucp.secure.crypto_suite import SignatureClaim

ANY_LIFE = 0
REMEMBERED = 10_000
"""Messages that a rogue node knows of that comes later: as many as it keeps itself."""


class Clockwork:
    """The agents of a scenario, on a virtual air. Agents are numbered in the roster's order.

    `deliver_all`: deliver also the messages that a released agent would ignore. This takes longer and changes only the
    traces. Every message is delivered if an agent has quirks, is not the harness's own, or has an edited core
    (`harness.play.core_version`), because such an agent might not ignore it. The same is true of a secured mission in
    which messages can be dropped: a second copy is a replay even if the first one had no effect.

    `told`: a user may request injections during the run. `fate_script` makes the player of the scenario's fates, `air`
    the carrier of messages. `programs` play agents of other makes.
    """

    def __init__(
        self,
        scenario: Scenario,
        seed: int,
        initial_data: bytes,
        recorder: Recorder,
        *,
        deliver_all: bool,
        told: bool,
        fate_script: Callable[[Sequence[Fate], Sequence[int], NameOf], FateScript],
        air: Callable[..., VirtualAir],
        programs: "Programs | None",
    ) -> None:
        self.scenario = scenario
        self.roster = scenario.roster
        self.seed = seed
        self._initial_data = initial_data
        self._recorder = recorder
        self._tracing = recorder.tracing
        self._anybody_is_unknown = scenario.has_wrong_agents or bool(scenario.foreign)
        """Whether anybody may do what no right agent of ours does."""
        self._keys = self._keys_of_agents(told=told) if scenario.security else None
        if self._keys is not None:
            self._initial_data = self._keys.mission.sealed_to_depot(initial_data)
        anything_counts = self._anybody_is_unknown or (self._keys is not None and not self._keys.nothing_is_dropped)
        anything_counts = anything_counts or bool(edited_files()) or variant_in_use() is not None
        self._deliver_all = deliver_all = deliver_all or anything_counts
        self._answers_wait = scenario.settings.answer_spread_s > 0
        self._now = 0.0
        self._generating = True
        self._number = {agent_id: number for number, agent_id in enumerate(self.roster)}
        self._lives: list[list[Incarnation]] = [[] for _ in self.roster]
        self._alive: list[Incarnation | None] = [None] * (len(self.roster) + 1)
        """By number; the last is the rogue node's, which is no agent and has no life."""
        self._foreigners = self._foreign_agents(programs) if scenario.foreign else None
        self._late = {self._number[agent_id]: LateTimers(text) for agent_id, text in scenario.lateness.items()}
        """By number, of the agents that have any."""
        self._channel = self._shared_channel()
        self._medium = Medium(self.roster, seed, AT_ONCE if self._channel else LATENCY)
        self._script = fate_script(scenario.fates, self.roster, BlockNames(self.roster, self._lives).of)
        self._air = air(
            self.roster, scenario.settings, self._medium, self._script, self._channel, deliver_all=deliver_all
        )
        self._rogue = self._rogue_node() if scenario.rogue else None
        self._on_the_air: deque[tuple[int, int, Message, float]] | None = deque(maxlen=REMEMBERED) if told else None
        """What a rogue node would have heard, if there is none and may be one."""
        self._sought: Sought | None = None
        self._found: int | None = None
        """The agent that has run what was sought."""
        self._in_an_instant = False
        """Whether it was found before all of its instant had been played."""
        self._at_once: list[tuple[int, HandlerRun]] | None = None
        """What agents have run at the last change; None once time has passed."""
        self._recurrence: Recurrence | None = None
        """Is told of timers that end, once the swarm has had its time to finish."""

    def _shared_channel(self) -> ChannelTraffic[InFlight | StrayDatagram] | None:
        asked = self.scenario.network.channel
        if asked is None:
            return None
        journal = self._recorder.transmitted if self._tracing else None
        return ChannelTraffic(self.roster, asked.radio(), asked.processing_s, self.seed, journal)

    def _foreign_agents(self, programs: "Programs | None") -> "Foreigners":
        from harness.play.simulation.foreign._foreigners import Foreigners  # most scenarios have none

        return Foreigners(
            self.scenario, self.seed, self._initial_data, programs, tracing=self._tracing, keys=self._keys
        )

    @property
    def public_keys(self) -> "PublicKeys | None":
        """Those of the vehicles; None of a mission that is not secured."""
        return self._keys.mission.public if self._keys else None

    @property
    def verified(self) -> "Callable[[SignatureClaim], bool] | None":
        """Whether a signature that may have been made here is good; None of a mission that is not secured."""
        return self._keys.crypto.verify if self._keys else None

    def _keys_of_agents(self, *, told: bool) -> "Keys":
        from harness.play.simulation._secured_agents import Keys  # needs the extra `secure`

        return Keys(self.scenario, self.seed, told=told)

    def _rogue_node(self) -> "VirtualRogue":
        from harness.play.simulation._simulated_rogue import VirtualRogue  # scapy takes long to import

        captured = self._keys.captured if self._keys else None
        number, write = len(self.roster), self._recorder.injected
        return VirtualRogue(self.roster, self.seed, self._air, number, write, captured, self._initial_data)

    def _late_rogue(self) -> "VirtualRogue":
        """One that has been on the air all along, and begins to send now."""
        assert self._on_the_air is not None, "a scenario that injects has a rogue node from the beginning"
        rogue = self._rogue_node()
        for sender, sequence, message, sent_at in self._on_the_air:
            rogue.hears(sender, sequence, message, sent_at)
        return rogue

    # What happens

    def run(self, until: float) -> None:
        """All that happens up to `until`."""
        self._at_once = None
        with gc_paused():
            self._play(until)
        self._in_an_instant = self._found is not None
        if self._found is None:
            self._now = until

    def _play(self, until: float) -> None:
        alive = self._alive
        life: Incarnation | None = None
        try:
            for happening in self._air.until(until):
                self._now, _, number, what = happening
                life = alive[number]
                if life is None:
                    if self._rogue is not None and number == len(self.roster):
                        self._rogue.wake(self._now)
                elif life.waiting is not None:
                    if what is not None:
                        life.waiting.append(happening)
                elif isinstance(what, InFlight):
                    self._arrive(number, life, what)
                else:
                    self._happen(number, life, what)
                if self._found is not None:
                    return
        except Exception as error:
            if (crash := crash_of(life, error)) is None:
                raise
            raise crash from error

    def _arrive(self, number: int, life: Incarnation, flight: InFlight) -> None:
        """A message reaches the agent."""
        sender, message = flight.sender, flight.message
        if self._tracing or life.secured is not None or type(message) in ONLY_COUNTED:
            self._hear(number, life)
        if flight.sent_at < life.born_at:
            return
        state = life.state
        if self._deliver_all or state is None or flight.matters(state, sender, message):
            now = self._now if life.clock is None else life.local_s(self._now)
            self._give(life.agent, flight, now)
            self._say(number, life)
            if self._deliver_all or self._answers_wait or state is None or state.reconcile_in_progress:
                self._wait(number, life)  # of the right handlers of messages only a reconcile's touch timers

    def _give(self, agent: VirtualAgent, flight: InFlight, now: float) -> None:
        if flight.sealed is None:
            agent.receive_message(flight.sender, flight.sequence, flight.message, now, flight.datagram)
        else:
            agent.receive_datagram(flight.sealed, now)

    def _happen(self, number: int, life: Incarnation, what: Logged | StrayDatagram | None) -> None:
        """Anything else: the end of a timer, an event, or a datagram that is no message of an agent's."""
        agent = life.agent
        if what is None:
            self._timer_ends(number, life)
        elif isinstance(what, StrayDatagram):
            self._hear(number, life)
            agent.receive_datagram(what.datagram, life.local_s(self._now))
            self._after(number, life)
        elif self._generating and life.logs and what[0] in (ANY_LIFE, len(self._lives[number])):
            if self._tracing:
                self._hear(number, life)
            _, event_id, data, timestamp_us = what
            if timestamp_us is None:
                timestamp_us = life.timestamp_us(self._now)
            self._recorder.logged(self._now, agent.agent_id, len(data))
            agent.add_event(LoggableEvent(timestamp_us, event_id, data), life.local_s(self._now))
            self._expect_event(number, life)
            self._after(number, life)

    def _timer_ends(self, number: int, life: Incarnation) -> None:
        if life.deadline is None or life.deadline > self._now or (soonest := life.agent.next_timer()) is None:
            return  # it was stopped, or started anew, since it was expected to end now
        life.deadline = None
        self._hear(number, life)
        if self._recurrence is not None:
            self._recurrence.timers_end(self._now, max(soonest, life.local_s(self._now)), _own(life).state)
        if number in self._late:
            self._late_timer_ends(number, life)
        else:
            life.agent.handle_timer(max(soonest, life.local_s(self._now)))
        if life.state is not None:
            self._air.no_longer_asked(number, life.state)
        self._after(number, life)

    def _hear(self, number: int, life: Incarnation) -> None:
        """Tell the agent of the answers that have come and that it only tallies.

        Before anybody looks at the tally; and in a trace everything stands in its order.
        """
        agent, state = life.agent, life.state
        if state is None or life.waiting is not None or not self._air.asked_by[number]:
            return
        for at, _, answer in self._air.hear(number):
            if answer.matters(state, answer.sender, answer.message):
                at = max(at, life.resumed_at)
                local = max(state.now, life.local_s(at))
                self._give(agent, answer, local)
                if self._tracing:
                    self._take_down(life, at)

    def _after(self, number: int, life: Incarnation) -> None:
        """Do what the agent says after an input: send, trace, and wait for its next timer."""
        self._say(number, life)
        self._wait(number, life)

    def _say(self, number: int, life: Incarnation) -> None:
        """Send what the agent has to say, and take down what it has done."""
        if self._tracing:
            self._take_down(life, self._now)
        if life.secured is not None:
            self._say_sealed(number, life, life.secured)
            return
        for sequence, message, datagram in life.agent.outgoing():
            if message is None:
                assert datagram is not None, "it is there, if it is no message"
                self._send_stray(number, life, base64.b64decode(datagram.text))
                continue
            data_bytes = datagram_bytes(message)
            life.bytes_sent += data_bytes
            self._air.broadcast(self._now, number, sequence, message, data_bytes, datagram)
            if self._rogue is not None:
                self._rogue.hears(life.agent.agent_id, sequence, message, self._now)
            elif self._on_the_air is not None:
                self._on_the_air.append((life.agent.agent_id, sequence, message, self._now))

    def _say_sealed(self, number: int, life: Incarnation, agent: Secured) -> None:
        """Send what the agent has to say, sealed. Who comes upon the mission late has heard nothing of it."""
        for sealed, sequence, message, plain in agent.sealed_to_send():
            if message is None:
                self._send_stray(number, life, sealed)
                continue
            life.bytes_sent += len(sealed)
            self._air.broadcast(self._now, number, sequence, message, len(sealed), plain, sealed)
            if self._rogue is not None:
                self._rogue.hears_datagram(sealed, self._now)

    def _send_stray(self, number: int, life: Incarnation, datagram: bytes) -> None:
        """Send what is no message of the agent's own. A rogue node learns nothing from it."""
        life.bytes_sent += len(datagram)
        self._air.broadcast_stray(self._now, number, datagram)

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
        self._air.busy_until[number] = 0.0 if busy_until is None else life.mission_s(busy_until)

    def _ends_at(self, number: int, life: Incarnation, soonest: float) -> float:
        """When a timer ends next, of which the first should by the agent's clock at `soonest`."""
        if number not in self._late:
            return life.mission_s(soonest)
        late = self._late[number]
        late.look(_own(life).state)
        ends = late.next(life.mission_s)
        answer_s = _own(life).next_answer()
        times_s = [*([] if ends is None else [ends[0]]), *([] if answer_s is None else [life.mission_s(answer_s)])]
        return min(times_s)

    def _late_timer_ends(self, number: int, life: Incarnation) -> None:
        ends = self._late[number].next(life.mission_s)
        if ends is None or ends[0] > self._now:
            _own(life).release_answers(life.local_s(self._now))
            return
        name, _, deadline = ends[1]
        agent = _own(life)
        timer = next(timer for timer in agent.state.timers if timer.name == name)
        agent.end_timer(timer, max(deadline, life.local_s(self._now)))

    def _take_down(self, life: Incarnation, mission_s: float) -> None:
        """Write what the agent has done into its trace."""
        agent_id, entries = life.agent.agent_id, life.agent.trace()
        somebody_looks = self._at_once is not None or self._sought is not None
        for entry in entries:
            entry.t = mission_s
            if isinstance(entry, HandlerRun):
                life.handler_runs += 1
                if somebody_looks:
                    self._look(agent_id, entry)
        self._recorder.write(agent_id, entries)

    def _look(self, agent_id: int, run: HandlerRun) -> None:
        """Whether it is what somebody waits for, or will wait for in a moment."""
        if self._at_once is not None:
            self._at_once.append((agent_id, run))
        elif self._sought is not None and self._found is None and self._sought.is_met_by(agent_id, run):
            self._found = agent_id

    # An agent's life

    def _start(self, number: int, stored: Stored | None = None) -> None:
        """Begin a life, or go on from what is `stored` of an earlier one."""
        agent_id = self.roster[number]
        lives = self._lives[number]
        clock = self.scenario.clocks.get(agent_id)
        seed = agent_seed(self.seed, agent_id, len(lives) + 1)
        source = RandomEvents(Random(seed), self.scenario.events.mean_s)
        local_s = self._now if clock is None else clock.shows(self._now)
        agent: VirtualAgent
        if self._foreigners is not None and agent_id in self._foreigners:
            agent = self._foreigners.begin(agent_id, len(lives) + 1, local_s, stored, born_at=self._now)
        else:
            agent = self._own_agent(agent_id, seed, len(lives) + 1)
        state = agent.state if isinstance(agent, OwnAgent) else None
        secured = cast(Secured, agent) if self._keys is not None else None
        life = Incarnation(agent, source, clock, self._now, state, secured, stored is not None)
        lives.append(life)
        self._alive[number] = life
        self._air.born_at[number] = self._now
        self._recorder.begin(life)
        if isinstance(stored, StoredState) and isinstance(agent, OwnAgent):
            agent.boot(stored, local_s)
        self._after(number, life)
        self._expect_event(number, life)

    def _own_agent(self, agent_id: int, seed: int, life: int) -> OwnAgent:
        quirks = self.scenario.quirks_of(agent_id)
        make: Callable[..., OwnAgent] = OwnAgent
        if self._keys is not None:
            make = self._keys.agent(agent_id, life, self._now)
        elif (seal := seals_of(self.scenario.events.script, agent_id)) is not None:
            make = partial(OwnAgent, seal=seal)
        return make(
            agent_id,
            self.roster,
            self._initial_data,
            self.scenario.settings_of(agent_id),
            handlers=wrong_handlers(quirks, Random(seed)) if quirks else (),
            tracing=self._tracing,
        )

    def _expect_event(self, number: int, life: Incarnation) -> None:
        if self.scenario.events.source != "scripted":
            due, event_id, data = life.source.next()
            this_life = len(self._lives[number])
            self._air.expect(max(self._now, life.born_at + due), number, (this_life, event_id, data, None))

    def _resume(self, number: int, life: Incarnation, waiting: list[Happening]) -> None:
        """What has waited is handled as a process does it: what the socket holds, then timers, then events.

        What an agent asks while there is more in the socket may be answered by what came since.
        """
        life.waiting, life.resumed_at = None, self._now
        place = self._air.place
        for happening in waiting:
            what = happening[3]
            if isinstance(what, InFlight | StrayDatagram):
                self._air.place = happening
                if isinstance(what, InFlight):
                    self._arrive(number, life, what)
                else:
                    self._happen(number, life, what)
        self._air.place = place
        del self._air.paused_at[number]
        self._hear(number, life)
        self._timer_ends(number, life)
        for happening in waiting:
            what = happening[3]
            if not isinstance(what, InFlight | StrayDatagram):
                self._happen(number, life, what)


def _own(life: Incarnation) -> OwnAgent:
    assert isinstance(life.agent, OwnAgent), "of nobody else is so much known"
    return life.agent
