"""Run all agents in virtual time: give each agent its inputs in order of time, and deliver the messages of the agents.

Inputs are messages, events to log, and the ends of timers. `simulation.py` carries out a mission with this loop.
"""

import base64
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from random import Random
from typing import TYPE_CHECKING, cast

from harness.errors import AgentFailedError
from harness.gc_pause import gc_paused
from harness.play._shared_channel import ChannelTraffic
from harness.play.backend import agent_seed
from harness.play.core_version import edited_files
from harness.play.mission import SoughtRun
from harness.play.simulation._crash import agent_failure
from harness.play.simulation._recurrence import RecurrenceSearch
from harness.play.simulation._simulated_agent import DiskContents, OwnAgent, VirtualAgent
from harness.play.simulation.air import DueEvent, MessageInFlight, ScheduledInput, StrayDatagram, VirtualAir
from harness.play.simulation.fate_script import FateScript, LateTimers, NameOf
from harness.play.simulation.incarnations import BlockNames, KeyedAgent, SimulatedIncarnation
from harness.play.simulation.recorded_seals import recorded_seals
from harness.play.simulation.run_files import Recorder
from harness.play.variant import variant_in_use
from harness.scenario import Scenario
from harness.scenario.fates import Fate
from netem.medium import AT_ONCE, LATENCY, Medium
from ucp.events import LoggableEvent, RandomEvents
from ucp.interest import ONLY_COUNTED
from ucp.messages import Message, datagram_bytes, encode
from ucp.quirks import wrong_handlers
from ucp.store import StoredState
from ucp.trace import HandlerRun

if TYPE_CHECKING:
    from harness.play.simulation._secured_agents import SimulatedKeys
    from harness.play.simulation._simulated_rogue import VirtualRogue
    from harness.play.simulation.foreign._foreign_swarm import ForeignSwarm
    from harness.play.simulation.foreign._program_pool import ProgramPool
    from ucp.secure.bundle import PublicKeys
    from ucp.secure.crypto_suite import UnverifiedSignature

ANY_INCARNATION = 0
KEPT_MESSAGES = 10_000
"""Number of past messages that a rogue node knows if it starts during a run. A rogue node that runs from the start also
knows at most this number of messages.
"""


class EventLoop:
    """The agents of a scenario on a simulated network. The number of an agent is its index in the roster.

    `deliver_all`: also deliver the messages that a released agent would ignore. This takes longer and changes only the
    traces. Every message is also delivered if an agent has quirks, is a foreign agent (a separate program), or has an
    edited core (`harness.play.core_version`). Such an agent might react to the message. In a secured mission in which
    agents can drop messages, every message is delivered, too. For example, an agent drops the second copy of a message
    as a replay, even if the first copy had no effect.

    Receivers share one decoded message. An agent with quirks or an edited core might change this object. In this case,
    each receiver decodes the datagram itself, and traces contain the bytes as they were sent.

    `interactive`: a user may request injections during the run. `fate_script` creates the object that applies scripted
    fates. `air` creates the network. `programs` are the programs that run foreign agents.
    """

    def __init__(
        self,
        scenario: Scenario,
        seed: int,
        initial_data: bytes,
        recorder: Recorder,
        *,
        deliver_all: bool,
        interactive: bool,
        fate_script: Callable[[Sequence[Fate], Sequence[int], NameOf], FateScript],
        air: Callable[..., VirtualAir],
        programs: "ProgramPool | None",
    ) -> None:
        self.scenario = scenario
        self.roster = scenario.roster
        self.seed = seed
        self._initial_data = initial_data
        self._recorder = recorder
        self._tracing = recorder.tracing
        self._has_unknown_agents = scenario.has_wrong_agents or bool(scenario.foreign)
        """True if an agent may deviate from the protocol, because it has quirks or is a foreign agent."""
        self._keys = self._keys_of_agents(interactive=interactive) if scenario.security else None
        if self._keys is not None:
            self._initial_data = self._keys.mission.add_depot_key(initial_data)
        all_messages_count = self._has_unknown_agents or (self._keys is not None and not self._keys.nothing_is_dropped)
        has_other_core = bool(edited_files()) or variant_in_use() is not None
        self._receivers_decode = scenario.has_wrong_agents or has_other_core
        """True if each receiver of a message decodes its datagram."""
        all_messages_count = all_messages_count or has_other_core
        self._deliver_all = deliver_all = deliver_all or all_messages_count
        self._answers_wait = scenario.settings.answer_spread_s > 0
        """True if agents send answers some time after the query, and not immediately."""
        self._now = 0.0
        self._generating = True
        self._number = {agent_id: number for number, agent_id in enumerate(self.roster)}
        self._incarnations: list[list[SimulatedIncarnation]] = [[] for _ in self.roster]
        self._alive: list[SimulatedIncarnation | None] = [None] * (len(self.roster) + 1)
        """The living incarnation of each agent, or None. The last entry belongs to the rogue node and is always
        None.
        """
        self._foreign_swarm = self._foreign_agents(programs) if scenario.foreign else None
        self._late = {self._number[agent_id]: LateTimers(text) for agent_id, text in scenario.lateness.items()}
        """Agent number -> the timers that expire late. Only for agents that the scenario key `lateness` names."""
        with_disk = self.roster if interactive else scenario.with_disk()
        self._with_disk = {self._number[agent_id] for agent_id in with_disk}
        """Numbers of the agents that may reboot with the data on their disks."""
        self._channel = self._shared_channel()
        self._medium = Medium(self.roster, seed, AT_ONCE if self._channel else LATENCY)
        self._script = fate_script(scenario.fates, self.roster, BlockNames(self.roster, self._incarnations).of)
        self._air = air(
            self.roster, scenario.settings, self._medium, self._script, self._channel, deliver_all=deliver_all
        )
        self._rogue = self._rogue_node() if scenario.rogue else None
        self._recent_messages: deque[tuple[int, int, Message, float]] | None = (
            deque(maxlen=KEPT_MESSAGES) if interactive else None
        )
        """Messages for a rogue node that may start later in the run, or None if no rogue node can start."""
        self._sought: SoughtRun | None = None
        self._found: int | None = None
        """The caller may wait until an agent runs a certain handler. This is the ID of the agent that ran the handler,
        or None if no agent has run it yet.
        """
        self._stopped_within_instant = False
        """True if the last call of `run` stopped at the handler run for which the caller waited. Further inputs of the
        same time may remain.
        """
        self._recent_runs: list[tuple[int, HandlerRun]] | None = None
        """Handler runs since the last change of the timeline, which the next call of `until_run` checks first. None if
        time has advanced since that change.
        """
        self._recurrence: RecurrenceSearch | None = None
        """The search for an endless cycle, while the swarm becomes idle."""

    def _shared_channel(self) -> ChannelTraffic[MessageInFlight | StrayDatagram] | None:
        asked = self.scenario.network.channel
        if asked is None:
            return None
        journal = self._recorder.transmitted if self._tracing else None
        return ChannelTraffic(self.roster, asked.radio(), asked.processing_s, self.seed, journal)

    def _foreign_agents(self, programs: "ProgramPool | None") -> "ForeignSwarm":
        from harness.play.simulation.foreign._foreign_swarm import ForeignSwarm  # most scenarios need no import

        return ForeignSwarm(
            self.scenario, self.seed, self._initial_data, programs, tracing=self._tracing, keys=self._keys
        )

    @property
    def public_keys(self) -> "PublicKeys | None":
        """The public keys of the vehicles, or None if the mission is not secured."""
        return self._keys.mission.public if self._keys else None

    @property
    def verified(self) -> "Callable[[UnverifiedSignature], bool] | None":
        """A function that verifies signatures, with a cache of the signatures made in this run. The value is None if
        the mission is not secured.
        """
        return self._keys.crypto.verify if self._keys else None

    def _keys_of_agents(self, *, interactive: bool) -> "SimulatedKeys":
        from harness.play.simulation._secured_agents import SimulatedKeys  # needs the extra `secure`

        return SimulatedKeys(self.scenario, self.seed, interactive=interactive)

    def _rogue_node(self) -> "VirtualRogue":
        from harness.play.simulation._simulated_rogue import VirtualRogue  # scapy takes long to import

        captured = self._keys.captured if self._keys else None
        number, write = len(self.roster), self._recorder.injected
        return VirtualRogue(self.roster, self.seed, self._air, number, write, captured, self._initial_data)

    def _late_rogue(self) -> "VirtualRogue":
        """Return a rogue node that starts during the run. It knows the most recent messages of the run."""
        assert self._recent_messages is not None, "a scenario that injects has a rogue node from the beginning"
        rogue = self._rogue_node()
        for sender, sequence, message, sent_at in self._recent_messages:
            rogue.receive_message(sender, sequence, message, sent_at)
        return rogue

    # Inputs

    def run(self, until: float) -> None:
        """Simulate all inputs up to the time `until`. Stop earlier at a handler run for which a caller waits."""
        self._recent_runs = None
        with gc_paused():
            self._play(until)
        self._stopped_within_instant = self._found is not None
        if self._found is None:
            self._now = until

    def _play(self, until: float) -> None:
        inputs = self._air.inputs_until(until)
        while (failure := self._play_to_failure(inputs)) is not None:
            self.fail(failure)

    def _play_to_failure(self, inputs: Iterator[ScheduledInput]) -> AgentFailedError | None:
        """Simulate the inputs until an agent crashes or hangs, and return the failure of this agent. Return None if no
        agent fails.
        """
        alive = self._alive
        incarnation: SimulatedIncarnation | None = None
        try:
            for scheduled in inputs:
                self._now, _, number, what = scheduled
                incarnation = alive[number]
                if incarnation is None:
                    if self._rogue is not None and number == len(self.roster):
                        self._rogue.wake(self._now)
                elif incarnation.waiting is not None:
                    if what is not None:
                        incarnation.waiting.append(scheduled)
                elif isinstance(what, MessageInFlight):
                    self._handle_message(number, incarnation, what)
                else:
                    self._handle_other_input(number, incarnation, what)
                if self._found is not None:
                    return None
        except Exception as error:
            if (failure := agent_failure(incarnation, error, self._now)) is None:
                raise
            return failure
        return None

    @contextmanager
    def _containing_failure(self, number: int) -> Iterator[None]:
        """Let the other agents continue the mission if this agent crashes or hangs inside the context."""
        try:
            yield
        except Exception as error:
            if (failure := agent_failure(self._alive[number], error, self._now)) is None:
                raise
            self.fail(failure)

    def fail(self, error: AgentFailedError) -> None:
        """Record that an agent crashed or hung, and close the records of this agent. The other agents continue."""
        raise NotImplementedError

    def _handle_message(self, number: int, incarnation: SimulatedIncarnation, flight: MessageInFlight) -> None:
        """Give the message to the agent, unless it cannot affect the agent."""
        sender, message = flight.sender, flight.message
        if self._tracing or incarnation.secured is not None or type(message) in ONLY_COUNTED:
            self._tally_answers(number, incarnation)
        if flight.sent_at < incarnation.started_at:
            return
        state = incarnation.state
        if self._deliver_all or state is None or flight.matters(state, sender, message):
            now = self._now if incarnation.clock is None else incarnation.local_s(self._now)
            self._give_message(incarnation.agent, flight, now)
            self._send_and_trace(number, incarnation)
            if self._deliver_all or self._answers_wait or state is None or state.reconcile_in_progress:
                self._schedule_timer(number, incarnation)  # no other correct handler of a message changes a timer

    def _give_message(self, agent: VirtualAgent, flight: MessageInFlight, now: float) -> None:
        if flight.encoded is None:
            agent.receive_message(flight.sender, flight.sequence, flight.message, now, flight.datagram)
        else:
            agent.receive_datagram(flight.encoded, now)

    def _handle_other_input(
        self, number: int, incarnation: SimulatedIncarnation, what: DueEvent | StrayDatagram | None
    ) -> None:
        """Give the agent an input that is not a message: a timer expiry, an event, or a stray datagram."""
        agent = incarnation.agent
        if what is None:
            self._end_timer(number, incarnation)
        elif isinstance(what, StrayDatagram):
            self._tally_answers(number, incarnation)
            agent.receive_datagram(what.datagram, incarnation.local_s(self._now))
            self._finish_input(number, incarnation)
        elif self._generating and incarnation.logs and what[0] in (ANY_INCARNATION, len(self._incarnations[number])):
            if self._tracing:
                self._tally_answers(number, incarnation)
            _, event_id, data, timestamp_us = what
            if timestamp_us is None:
                timestamp_us = incarnation.timestamp_us(self._now)
            event = LoggableEvent(timestamp_us, event_id, data)
            if event.encoded_bytes <= agent.settings.max_event_bytes:
                self._recorder.logged(self._now, agent.agent_id, len(data))
                agent.add_event(event, incarnation.local_s(self._now))
            self._schedule_event(number, incarnation)
            self._finish_input(number, incarnation)

    def _end_timer(self, number: int, incarnation: SimulatedIncarnation) -> None:
        if (
            incarnation.deadline is None
            or incarnation.deadline > self._now
            or (soonest := incarnation.agent.next_timer()) is None
        ):
            return  # the timer was stopped or restarted after this input was scheduled
        incarnation.deadline = None
        self._tally_answers(number, incarnation)
        if self._recurrence is not None:
            self._recurrence.record_timer_ends(
                self._now, max(soonest, incarnation.local_s(self._now)), _own_agent(incarnation).state
            )
        if number in self._late:
            self._end_late_timer(number, incarnation)
        else:
            incarnation.agent.handle_timer(max(soonest, incarnation.local_s(self._now)))
        if incarnation.state is not None:
            self._air.close_ended_queries(number, incarnation.state)
        self._finish_input(number, incarnation)

    def _tally_answers(self, number: int, incarnation: SimulatedIncarnation) -> None:
        """Let the agent count the answers that have arrived and are not counted yet. The loop calls this method before
        a handler reads the number of answers. If a trace is written, the loop also calls it before other inputs, so
        that the lines of the trace are in order.
        """
        agent, state = incarnation.agent, incarnation.state
        if state is None or incarnation.waiting is not None or not self._air.open_queries[number]:
            return
        for at, _, answer in self._air.take_answers(number):
            if answer.matters(state, answer.sender, answer.message):
                at = max(at, incarnation.resumed_at)
                local = max(state.now, incarnation.local_s(at))
                self._give_message(agent, answer, local)
                if self._tracing:
                    self._write_trace(incarnation, at)

    def _finish_input(self, number: int, incarnation: SimulatedIncarnation) -> None:
        """Complete an input of an agent: send the agent's messages, write the agent's trace, and schedule its next
        timer expiry.
        """
        self._send_and_trace(number, incarnation)
        self._schedule_timer(number, incarnation)

    def _send_and_trace(self, number: int, incarnation: SimulatedIncarnation) -> None:
        """Write the agent's trace and its disk, and send its messages."""
        if self._tracing:
            self._write_trace(incarnation, self._now)
        if incarnation.state is not None:
            incarnation.completed = len(incarnation.state.completed)
            if number in self._with_disk:
                incarnation.disk = _own_agent(incarnation).stored(self._now)
        if incarnation.secured is not None:
            self._send_sealed(number, incarnation, incarnation.secured)
            return
        for sequence, message, datagram in incarnation.agent.outgoing():
            if message is None:
                assert datagram is not None, "an output is a message or a datagram"
                self._send_stray(number, incarnation, base64.b64decode(datagram.text))
                continue
            data_bytes = datagram_bytes(message)
            incarnation.bytes_sent += data_bytes
            encoded = encode(incarnation.agent.agent_id, sequence, message) if self._receivers_decode else None
            if encoded is not None and datagram is not None:
                datagram.keep_only_text()
            self._air.broadcast(self._now, number, sequence, message, data_bytes, datagram, encoded)
            if self._rogue is not None:
                self._rogue.receive_message(incarnation.agent.agent_id, sequence, message, self._now)
            elif self._recent_messages is not None:
                self._recent_messages.append((incarnation.agent.agent_id, sequence, message, self._now))

    def _send_sealed(self, number: int, incarnation: SimulatedIncarnation, agent: KeyedAgent) -> None:
        """Send the encrypted messages of the agent. A rogue node that starts later does not receive these messages."""
        for sealed, sequence, message, plain in agent.sealed_to_send():
            if message is None:
                self._send_stray(number, incarnation, sealed)
                continue
            incarnation.bytes_sent += len(sealed)
            self._air.broadcast(self._now, number, sequence, message, len(sealed), plain, sealed)
            if self._rogue is not None:
                self._rogue.receive_datagram(sealed, self._now)

    def _send_stray(self, number: int, incarnation: SimulatedIncarnation, datagram: bytes) -> None:
        """Send an invalid datagram of the agent. The rogue node does not receive this datagram."""
        incarnation.bytes_sent += len(datagram)
        self._air.broadcast_stray(self._now, number, datagram)

    def _schedule_timer(self, number: int, incarnation: SimulatedIncarnation) -> None:
        """Schedule the expiry of the agent's next timer."""
        agent = incarnation.agent
        soonest = agent.next_timer()
        deadline = None if soonest is None else max(self._now, self._timer_end(number, incarnation, soonest))
        if deadline != incarnation.deadline:
            incarnation.deadline = deadline
            if deadline is not None:
                self._air.schedule(deadline, number, None)
        busy_until = agent.silent_until()
        self._air.busy_until[number] = 0.0 if busy_until is None else incarnation.mission_s(busy_until)

    def _timer_end(self, number: int, incarnation: SimulatedIncarnation, soonest: float) -> float:
        """Return the next mission second at which a timer of the agent expires, or at which the agent must send a
        delayed answer.

        Without late timers, this is the time `soonest` on the agent's clock.
        """
        if number not in self._late:
            return incarnation.mission_s(soonest)
        late = self._late[number]
        late.update(_own_agent(incarnation).state)
        ends = late.next(incarnation.mission_s)
        answer_s = _own_agent(incarnation).next_answer()
        times_s = [
            *([] if ends is None else [ends[0]]),
            *([] if answer_s is None else [incarnation.mission_s(answer_s)]),
        ]
        return min(times_s)

    def _end_late_timer(self, number: int, incarnation: SimulatedIncarnation) -> None:
        ends = self._late[number].next(incarnation.mission_s)
        if ends is None or ends[0] > self._now:
            _own_agent(incarnation).release_answers(incarnation.local_s(self._now))
            return
        name, _, deadline = ends[1]
        agent = _own_agent(incarnation)
        timer = next(timer for timer in agent.state.timers if timer.name == name)
        agent.end_timer(timer, max(deadline, incarnation.local_s(self._now)))

    def _write_trace(self, incarnation: SimulatedIncarnation, mission_s: float) -> None:
        """Write the agent's new handler runs to its trace."""
        agent_id, entries = incarnation.agent.agent_id, incarnation.agent.trace()
        searching = self._recent_runs is not None or self._sought is not None
        for entry in entries:
            entry.t = mission_s
            if isinstance(entry, HandlerRun):
                incarnation.handler_runs += 1
                if searching:
                    self._check_sought(agent_id, entry)
        self._recorder.write(agent_id, entries)

    def _check_sought(self, agent_id: int, run: HandlerRun) -> None:
        """Check whether a caller waits for this handler run. Directly after a change of the timeline, only store the
        handler run, because the caller starts to wait later.
        """
        if self._recent_runs is not None:
            self._recent_runs.append((agent_id, run))
        elif self._sought is not None and self._found is None and self._sought.matches(agent_id, run):
            self._found = agent_id

    # Incarnations

    def _start(self, number: int, stored: DiskContents | None = None) -> None:
        """Start an agent. `stored` is the content of its disk, or None."""
        agent_id = self.roster[number]
        incarnations = self._incarnations[number]
        clock = self.scenario.clocks.get(agent_id)
        seed = agent_seed(self.seed, agent_id, len(incarnations) + 1)
        source = RandomEvents(Random(seed), self.scenario.events.mean_s)
        local_s = self._now if clock is None else clock.shows(self._now)
        agent: VirtualAgent
        if self._foreign_swarm is not None and agent_id in self._foreign_swarm:
            agent = self._foreign_swarm.begin(agent_id, len(incarnations) + 1, local_s, stored, started_at=self._now)
        else:
            agent = self._new_own_agent(agent_id, seed, len(incarnations) + 1)
        state = agent.state if isinstance(agent, OwnAgent) else None
        secured = cast(KeyedAgent, agent) if self._keys is not None else None
        incarnation = SimulatedIncarnation(agent, source, clock, self._now, state, secured, stored is not None)
        incarnations.append(incarnation)
        self._alive[number] = incarnation
        self._air.started_at[number] = self._now
        self._recorder.begin(incarnation)
        if isinstance(stored, StoredState) and isinstance(agent, OwnAgent):
            incarnation.disk = stored
            agent.boot(stored, local_s)
        self._finish_input(number, incarnation)
        self._schedule_event(number, incarnation)

    def _new_own_agent(self, agent_id: int, seed: int, incarnation: int) -> OwnAgent:
        quirks = self.scenario.quirks_of(agent_id)
        make: Callable[..., OwnAgent] = OwnAgent
        if self._keys is not None:
            make = self._keys.agent(agent_id, incarnation, self._now)
        elif (seal := recorded_seals(self.scenario.events.script, agent_id)) is not None:
            make = partial(OwnAgent, seal=seal)
        return make(
            agent_id,
            self.roster,
            self._initial_data,
            self.scenario.settings_of(agent_id),
            handlers=wrong_handlers(quirks, Random(seed)) if quirks else (),
            tracing=self._tracing,
        )

    def _schedule_event(self, number: int, incarnation: SimulatedIncarnation) -> None:
        if self.scenario.events.source != "scripted":
            due, event_id, data = incarnation.source.next()
            current = len(self._incarnations[number])
            self._air.schedule(max(self._now, incarnation.started_at + due), number, (current, event_id, data, None))

    def _resume(self, number: int, incarnation: SimulatedIncarnation, waiting: list[ScheduledInput]) -> None:
        """Let the agent handle the inputs that waited during a pause, in the same order as a real process: first
        datagrams, then timers, then events.

        The agent handles datagrams in the order of their arrival. While it handles them, it may send a query. A later
        datagram can then be an answer to this query.
        """
        incarnation.waiting, incarnation.resumed_at = None, self._now
        position = self._air.position
        for scheduled in waiting:
            what = scheduled[3]
            if isinstance(what, MessageInFlight | StrayDatagram):
                self._air.position = scheduled
                if isinstance(what, MessageInFlight):
                    self._handle_message(number, incarnation, what)
                else:
                    self._handle_other_input(number, incarnation, what)
        self._air.position = position
        del self._air.paused_at[number]
        self._tally_answers(number, incarnation)
        self._end_timer(number, incarnation)
        for scheduled in waiting:
            what = scheduled[3]
            if not isinstance(what, MessageInFlight | StrayDatagram):
                self._handle_other_input(number, incarnation, what)


def _own_agent(incarnation: SimulatedIncarnation) -> OwnAgent:
    assert isinstance(incarnation.agent, OwnAgent), "only agents of the harness show their state"
    return incarnation.agent
