"""Test an agent over UDP: give the agent and the reference the same input, and compare their answers.

The comparison covers the agent's broadcasts, and its answer to the command `status`. The number of handler runs in the
status shows when the agent has handled the input. An input without an expected message therefore needs no waiting time,
unless the agent counts handler runs differently.
"""

import asyncio
import base64
import binascii
import dataclasses
import math
import shutil
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

from harness.conformance._agent_under_test import AgentUnderTest, Start
from harness.conformance._alphabet import AgentInput
from harness.conformance._observation import (
    COMPARED,
    MAX_EARLY_TIMERS,
    KnownNames,
    RecordedDatagram,
    TestedStep,
    compare,
    datagram_text,
)
from harness.conformance._reference_model import (
    AGENT,
    EVENT_ID,
    Action,
    ControlCommand,
    ExpectedOutcome,
    LoggedEvent,
    ModelSnapshot,
    PeerDatagram,
    ReferenceModel,
    TimerExpiry,
)
from harness.conformance._state_space import SettingsVariant, next_timer_name, state_of
from harness.conformance._udp_lab import (
    AgentEndedError,
    AgentExitedError,
    AgentHangsError,
    PeerSocket,
    ProcessUnderTest,
    UdpLab,
)
from harness.play.agent_control import AgentRefusedError
from ucp.clock import MICROSECONDS
from ucp.events import MalformedEventsError, decode_events
from ucp.messages import MalformedDatagramError, Message, decode


@dataclass(frozen=True)
class UdpTiming:
    """The speed of mission time, and the time limits in seconds of wall time."""

    speedup: float
    """Mission seconds per second of wall time."""
    margin_s: float
    """Minimum time between an input and the next timer expiry."""
    early_s: float
    """Number of seconds by which a timer may expire early without a failure."""
    patience_s: float
    """Maximum time to wait for an expected message."""
    calm_s: float
    """Time for which the status must stay at the expected values before an input counts as handled. Used for an agent
    whose counts of handler runs differ from the expected ones.
    """
    linger_s: float
    """Additional time to wait for unexpected messages."""
    ask_again_s: float
    """Time to wait for an expected message before the harness requests the agent's status."""


TIMING_IN_PARALLEL = UdpTiming(
    24.0, margin_s=0.08, early_s=0.15, patience_s=0.5, calm_s=0.08, linger_s=0.0, ask_again_s=0.1
)
TIMING_ALONE = UdpTiming(8.0, margin_s=0.3, early_s=0.1, patience_s=2.5, calm_s=0.3, linger_s=0.1, ask_again_s=0.25)
MIN_ANSWERS = 2
"""Minimum number of answers to status requests that prove that the agent was running. After fewer answers, a missing
message may be the fault of a slow machine.
"""


class UdpAgent(AgentUnderTest):
    """An agent under test that runs as a process and exchanges datagrams over UDP."""

    def __init__(
        self,
        variant: SettingsVariant,
        timing: UdpTiming,
        process: ProcessUnderTest,
        peer_socket: PeerSocket,
        closed: Callable[[], None],
    ) -> None:
        super().__init__(variant)
        self.process = process
        self.peer_socket = peer_socket
        self._timing = timing
        self._closed = closed
        self._epoch = 0.0

    @classmethod
    async def start(cls, lab: UdpLab, variant: SettingsVariant, timing: UdpTiming) -> "UdpAgent":
        """Start an agent and its mission, and return it. Raises NoAgentError, UnsupportedError, AgentEndedError."""
        port = lab.take_port()
        try:
            process = await ProcessUnderTest.start(
                lab, lab.new_directory(), lab.mission(variant, port, timing.speedup), AGENT, port, timing.speedup
            )
        except BaseException:
            lab.return_port(port)
            raise
        agent = cls(variant, timing, process, PeerSocket(lab, port), lambda: lab.return_port(port))
        try:
            await process.ready()
            await agent._begin()
        except BaseException:
            await agent.close()
            raise
        return agent

    async def _begin(self) -> None:
        self._epoch = time.time()
        epoch_us = round(self._epoch * MICROSECONDS)
        await self.process.start_mission(epoch_us)

    async def close(self) -> None:
        self.peer_socket.close()
        await self.process.program.kill()
        shutil.rmtree(self.process.directory, ignore_errors=True)
        self._closed()

    def exchanges(self) -> tuple[RecordedDatagram, ...]:
        names = KnownNames(self.model)
        return tuple(
            RecordedDatagram(round(self._mission_s(at_s), 3), by_agent, data, datagram_text(data, names))
            for at_s, by_agent, data in self.peer_socket.record
        )

    def now(self) -> float:
        """Return the current mission second."""
        return self._mission_s(time.time())

    def _mission_s(self, at_s: float) -> float:
        """Return the mission second at a wall time, which is in seconds since the Unix epoch."""
        return (at_s - self._epoch) * self._timing.speedup

    def _wall_s(self, mission_s: float) -> float:
        """Return the wall time at a mission second, in seconds since the Unix epoch."""
        return self._epoch + mission_s / self._timing.speedup

    @property
    def timer_is_near(self) -> bool:
        deadline = self.model.agent.next_timer()
        return deadline is not None and self._wall_s(deadline) - time.time() < self._timing.margin_s

    async def _step(self, given: AgentInput) -> TestedStep | None:
        model = self.model
        before, deadline, expired = state_of(model), model.agent.next_timer(), next_timer_name(model)
        action = given.make(model)
        if action is None:
            return None
        snapshot = ModelSnapshot(model)
        self.peer_socket.drain()
        if self.peer_socket.received and not isinstance(
            action, TimerExpiry
        ):  # such a message could not be distinguished from the answer to the input
            received = self.peer_socket.take()
            observation = compare(
                model,
                given,
                before,
                ExpectedOutcome(()),
                _contents(received),
                {},
                ["it sent a message without an input"],
            )
            late = self._may_have_expired(deadline)
            if late:
                self.reference_follows = self._follow_timers(snapshot, [], received, await self._status())
            return dataclasses.replace(observation, wrong_timer=expired, late=late)
        wrong: list[str] = []
        began, ends_at = self.now(), self._wall_s(deadline or 0.0) if isinstance(action, TimerExpiry) else 0.0
        waiting: list[Any] = []
        status: dict[str, Any] = {}
        wrong_timer = ended = None
        try:
            if isinstance(action, TimerExpiry):
                too_early = await self._wait_for_timer(ends_at, str(expired))
                if too_early is not None:
                    wrong, wrong_timer = [*wrong, too_early], expired
                began = max(deadline or 0.0, self._first_arrival_s())
            else:
                waiting = await self._give(action)
        except (AgentEndedError, AgentRefusedError) as error:
            wrong.append(str(error))
            ended = _end(error)
        if isinstance(action, LoggedEvent):
            outcome, problems = log_same_block(model, action, began, waiting)
            wrong += problems
        else:
            outcome = model.feed(action, began)
        next_deadline = model.agent.next_timer()
        answers, gave_up = 0, False
        try:
            if ended is None:
                status, answers, gave_up = await self._settle(
                    len(outcome.sent), max(time.time(), ends_at), next_deadline
                )
        except (AgentEndedError, AgentRefusedError) as error:
            wrong.append(str(error))
            ended = _end(error)
        received = self.peer_socket.take()
        timestamp_us = model.state.newest_block_timestamp_us
        observation = compare(model, given, before, outcome, _contents(received), status, wrong)
        late = ended is None and answers < MIN_ANSWERS and self._may_have_expired(next_deadline)
        if observation.wrong and late:
            fed_inputs = [(action, began, timestamp_us)]
            self.reference_follows = bool(status) and self._follow_timers(snapshot, fed_inputs, received, status)
            late = self.reference_follows or not gave_up
        return dataclasses.replace(
            observation, late=late, wrong_timer=wrong_timer or observation.wrong_timer, ended=ended
        )

    def _follow_timers(
        self,
        snapshot: ModelSnapshot,
        given: Sequence[tuple[Action, float, int]],
        received: Sequence[tuple[float, bytes]],
        status: Mapping[str, Any],
    ) -> bool:
        """Let timers of the reference expire shortly before or after the input. Return true if this explains the
        agent's messages and status. The reference is then in the state of the agent.
        """
        first, last = (
            (self._mission_s(received[0][0]), self._mission_s(received[-1][0]))
            if received
            else (self.now(), self.now())
        )
        for before, after in sorted(product(range(MAX_EARLY_TIMERS), repeat=2), key=sum):
            model, sent = snapshot.restore(), list[bytes]()
            for _ in range(before):
                sent += _expire(model, first)
            for action, now, timestamp_us in given:
                model.feed(action, max(now, model.state.now), timestamp_us)
                sent += model.datagrams
            for _ in range(after):
                sent += _expire(model, last)
            expected_status = model.status()
            if _messages(sent) == _messages(_contents(received)) and all(
                status.get(key, expected_status[key]) == expected_status[key] for key in COMPARED
            ):
                return True
        return False

    async def _status(self) -> dict[str, Any]:
        """Return the status of the agent. Return an empty status if the agent does not answer."""
        try:
            return await self.process.ask("status")
        except (AgentEndedError, AgentRefusedError):
            return {}

    def _may_have_expired(self, deadline: float | None) -> bool:
        """Return true if the timer with this deadline may have expired by now."""
        return deadline is not None and self._wall_s(deadline) - time.time() < self._timing.early_s

    async def _wait_for_timer(self, until: float, name: str) -> str | None:
        """Wait until the timer expires or a message arrives. If a message arrives too early, return a sentence about
        it. Otherwise return None.
        """
        while time.time() < until and not self.peer_socket.received:
            await self.peer_socket.arrival(until)
        early_s = until - self.peer_socket.received[0][0] if self.peer_socket.received else 0.0
        if early_s > self._timing.early_s:
            early = f"{early_s * self._timing.speedup:.1f} mission seconds"
            return f"it sent a message {early} before its timer {name} expires"
        return None

    def _first_arrival_s(self) -> float:
        """Return the mission second of the first received message. Return 0 if no message has arrived."""
        return self._mission_s(self.peer_socket.received[0][0]) if self.peer_socket.received else 0.0

    async def _give(self, action: Action) -> list[Any]:
        """Give the input to the agent. If the input is an event, return the deque in the agent's export. Otherwise
        return an empty list.
        """
        match action:
            case PeerDatagram():
                self.peer_socket.send(action.data)
            case ControlCommand():
                await self.process.ask(action.name)
            case LoggedEvent():
                data = base64.b64encode(action.data).decode("ascii")
                await self.process.ask("log", event_id=EVENT_ID, data=data)
                export = await self.process.export()
                waiting = export.get("blocks_to_be_committed")
                return waiting if isinstance(waiting, list) else []
        return []

    async def _settle(self, messages: int, since: float, deadline: float | None) -> tuple[dict[str, Any], int, bool]:
        """Wait until the agent has handled the input and sent the expected number of messages, or until a time limit.

        `since` is the wall time of the input. `deadline` is the mission second of the next timer expiry. If the agent
        counts handler runs differently, its status must have the expected values for some time.

        Return the status, the number of the agent's answers, and true if the time limit was exceeded. Only answers
        before the deadline count, because they prove that the agent was running and could have handled the input.
        """
        timing = self._timing
        give_up, calm_since = since + timing.patience_s, math.inf
        expected_status = self.model.status()
        answers = too_late = 0
        while True:
            self.peer_socket.drain()
            is_over = time.time() >= give_up
            if len(self.peer_socket.received) < messages and not is_over:
                await self.peer_socket.arrival(min(give_up, time.time() + timing.ask_again_s))
                if self.peer_socket.received and len(self.peer_socket.received) >= messages:
                    continue
            status = await self.process.ask("status")
            if time.time() > since and not self._may_have_expired(deadline):
                answers += 1
            self.peer_socket.drain()
            too_late += is_over
            if too_late >= MIN_ANSWERS:
                return status, answers, True
            if len(self.peer_socket.received) < messages:
                continue
            handled = status.get("handled")
            if isinstance(handled, int) and handled >= expected_status["handled"]:
                if not timing.linger_s:
                    return status, answers, False
                await asyncio.sleep(timing.linger_s)
                return await self.process.ask("status"), answers, False
            calm = all(status.get(key, expected_status[key]) == expected_status[key] for key in COMPARED)
            calm_since = min(calm_since, time.time()) if calm else math.inf
            if time.time() - calm_since > timing.calm_s:
                return status, answers, False
            await self.peer_socket.arrival(time.time() + 0.004)


def _end(error: Exception) -> str | None:
    """Return a description of the end of an agent. Return None if a slow machine may have caused the error."""
    return str(error) if isinstance(error, AgentHangsError | AgentExitedError) else None


def _contents(received: Sequence[tuple[float, bytes]]) -> list[bytes]:
    return [data for _, data in received]


def _messages(datagrams: Iterable[bytes]) -> list[Message] | None:
    """Return the decoded messages. Return None if a datagram is malformed."""
    try:
        return [decode(data).message for data in datagrams]
    except MalformedDatagramError:
        return None


def _expire(model: ReferenceModel, now: float) -> list[bytes]:
    """Let the next timer of the reference expire at its deadline, or at the time `now` if the deadline has passed.
    Return the datagrams that the reference sends. Return an empty list if no timer runs.
    """
    deadline = model.agent.next_timer()
    if deadline is None:
        return []
    model.feed(TimerExpiry(), max(deadline, now))
    return model.datagrams


def log_same_block(
    model: ReferenceModel, action: LoggedEvent, now: float, waiting: list[Any]
) -> tuple[ExpectedOutcome, list[str]]:
    """Give the reference an event with the agent's timestamp, so that agent and reference complete the same block.

    `waiting` is the deque of the agent's export. Return the outcome, and sentences about a wrong block.
    """
    fallback_us = model.state.newest_block_timestamp_us + 1
    held = len(model.state.blocks_to_be_committed)
    if len(waiting) != held + 1:
        wrong = f"the event did not fill a block: {len(waiting)} blocks in the deque of its export, not {held + 1}"
        return model.feed(action, now, fallback_us), [wrong]
    problems = waiting[-1]
    try:
        events = decode_events(base64.b64decode(problems["event_data"], validate=True))
        timestamp_us, block_hash = problems["timestamp_us"], problems["block_hash"]
    except (MalformedEventsError, binascii.Error, KeyError, TypeError, ValueError):
        return model.feed(action, now, fallback_us), ["the block in its export is not well-formed"]
    if [event.data for event in events] != [action.data] or events[0].event_id != EVENT_ID:
        return model.feed(action, now, fallback_us), ["the block does not contain the logged event"]
    outcome = model.feed(action, now, events[0].timestamp_us)
    if model.state.newest_block_timestamp_us != timestamp_us:
        return outcome, ["the timestamp of the block differs from that of its newest event"]
    if model.state.blocks_to_be_committed[-1].block_hash.hex() != block_hash:
        return outcome, ["the hash of the block in the export does not match the block"]
    return outcome, []


def starter(lab: UdpLab) -> Start:
    """Return a function that starts agents in this virtual network."""

    async def start(variant: SettingsVariant, alone: bool) -> AgentUnderTest:
        return await UdpAgent.start(lab, variant, TIMING_ALONE if alone else TIMING_IN_PARALLEL)

    return start
