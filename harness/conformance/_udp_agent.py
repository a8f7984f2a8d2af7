"""An agent over UDP beside the reference: both are given an input, and then compared.

What is seen of it: what it broadcasts, and what it says of itself (`status`), once it says that it has handled the
input. So nobody waits where nothing must come, but for an agent that counts its handler runs otherwise.
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

from harness.conformance._alphabet import Input
from harness.conformance._observation import COMPARED, MOST_ENDED, Exchange, Names, Seen, compare, told_datagram
from harness.conformance._reference_model import (
    AGENT,
    EVENT_ID,
    Action,
    Command,
    Datagram,
    Expire,
    Log,
    Model,
    Moment,
    Outcome,
)
from harness.conformance._state_space import Variant, ends_next, state_of
from harness.conformance._subject import Start, Subject
from harness.conformance._udp_lab import AgentEndedError, AgentExitedError, AgentHangsError, Air, Ear, Process
from harness.play.agent_control import AgentRefusedError
from ucp.clock import MICROSECONDS
from ucp.events import MalformedEventsError, decode_events
from ucp.messages import MalformedDatagramError, Message, decode


@dataclass(frozen=True)
class Pace:
    """How time is scaled, and what is still in time, in wall seconds."""

    speedup: float
    margin_s: float
    """No input is given so near to the end of a timer."""
    early_s: float
    """A timer may end so much earlier than it should."""
    patience_s: float
    """So long after it should have come a message is late."""
    calm_s: float
    """So long nothing must have happened, if the agent does not say that it has handled its input."""
    linger_s: float
    """So long it is looked what else comes."""
    ask_again_s: float
    """After so long of waiting for a message the agent is asked whether it runs at all."""


BESIDE_OTHERS = Pace(24.0, margin_s=0.08, early_s=0.15, patience_s=0.5, calm_s=0.08, linger_s=0.0, ask_again_s=0.1)
ALONE = Pace(8.0, margin_s=0.3, early_s=0.1, patience_s=2.5, calm_s=0.3, linger_s=0.1, ask_again_s=0.25)
CHANCES = 2
"""So often an agent answers before it is said that it was not the machine that was late."""


class OverUdp(Subject):
    """An agent as a process, from its start on."""

    def __init__(self, variant: Variant, pace: Pace, process: Process, ear: Ear, closed: Callable[[], None]) -> None:
        super().__init__(variant)
        self.process = process
        self.ear = ear
        self._pace = pace
        self._closed = closed
        self._epoch = 0.0

    @classmethod
    async def start(cls, air: Air, variant: Variant, pace: Pace) -> "OverUdp":
        """Raises NoAgentError, UnsupportedError, AgentEndedError."""
        port = air.take_port()
        try:
            process = await Process.start(air, air.new_directory(), air.mission(variant, port, pace.speedup), AGENT)
        except BaseException:
            air.give_back(port)
            raise
        subject = cls(variant, pace, process, Ear(air, port), lambda: air.give_back(port))
        try:
            await process.ready()
            await subject._begin()
        except BaseException:
            await subject.close()
            raise
        return subject

    async def _begin(self) -> None:
        self._epoch = time.time()
        epoch_us = round(self._epoch * MICROSECONDS)
        await self.process.ask("start", epoch_us=epoch_us)

    async def close(self) -> None:
        self.ear.close()
        await self.process.kill()
        shutil.rmtree(self.process.directory, ignore_errors=True)
        self._closed()

    def exchanges(self) -> tuple[Exchange, ...]:
        """All that has crossed the air."""
        names = Names(self.model)
        return tuple(
            Exchange(round(self._mission(at_s), 3), by_agent, data, told_datagram(data, names))
            for at_s, by_agent, data in self.ear.record
        )

    def now(self) -> float:
        """In mission seconds."""
        return self._mission(time.time())

    def _mission(self, at_s: float) -> float:
        """The mission second at which it is so many seconds since the Unix epoch."""
        return (at_s - self._epoch) * self._pace.speedup

    def _wall(self, mission_s: float) -> float:
        """Seconds since the Unix epoch at a mission second."""
        return self._epoch + mission_s / self._pace.speedup

    @property
    def hurried(self) -> bool:
        deadline = self.model.agent.next_timer()
        return deadline is not None and self._wall(deadline) - time.time() < self._pace.margin_s

    async def _step(self, given: Input) -> Seen | None:
        model = self.model
        before, deadline, expired = state_of(model), model.agent.next_timer(), ends_next(model)
        action = given.make(model)
        if action is None:
            return None
        moment = Moment(model)
        self.ear.drain()
        if self.ear.heard and not isinstance(action, Expire):  # what comes of the input could not be told from that
            heard = self.ear.take()
            seen = compare(model, given, before, Outcome(()), _data(heard), {}, ["it sent a message without an input"])
            late = self._ended(deadline)
            if late:
                self.in_step = self._explained(moment, [], heard, await self._status())
            return dataclasses.replace(seen, mistimed=expired, late=late)
        wrong: list[str] = []
        began, ends = self.now(), self._wall(deadline or 0.0) if isinstance(action, Expire) else 0.0
        waiting: list[Any] = []
        status: dict[str, Any] = {}
        mistimed = ended = None
        try:
            if isinstance(action, Expire):
                too_early = await self._wait_for_timer(ends, str(expired))
                if too_early is not None:
                    wrong, mistimed = [*wrong, too_early], expired
                began = max(deadline or 0.0, self._first_heard())
            else:
                waiting = await self._give(action)
        except (AgentEndedError, AgentRefusedError) as error:
            wrong.append(str(error))
            ended = _end(error)
        if isinstance(action, Log):
            outcome, made = log_as(model, action, began, waiting)
            wrong += made
        else:
            outcome = model.feed(action, began)
        ends_then = model.agent.next_timer()
        chances, gave_up = 0, False
        try:
            if ended is None:
                status, chances, gave_up = await self._settle(len(outcome.sent), max(time.time(), ends), ends_then)
        except (AgentEndedError, AgentRefusedError) as error:
            wrong.append(str(error))
            ended = _end(error)
        heard = self.ear.take()
        timestamp_us = model.state.newest_block_timestamp_us
        seen = compare(model, given, before, outcome, _data(heard), status, wrong)
        late = ended is None and chances < CHANCES and self._ended(ends_then)
        if seen.wrong and late:
            given_now = [(action, began, timestamp_us)]
            self.in_step = bool(status) and self._explained(moment, given_now, heard, status)
            late = self.in_step or not gave_up
        return dataclasses.replace(seen, late=late, mistimed=mistimed or seen.mistimed, ended=ended)

    def _explained(
        self,
        moment: Moment,
        given: Sequence[tuple[Action, float, int]],
        heard: Sequence[tuple[float, bytes]],
        status: Mapping[str, Any],
    ) -> bool:
        """Whether all is as it should be if timers ended before or after the input; the reference is there then."""
        first, last = (self._mission(heard[0][0]), self._mission(heard[-1][0])) if heard else (self.now(), self.now())
        for before, after in sorted(product(range(MOST_ENDED), repeat=2), key=sum):
            model, sent = moment.put_back(), list[bytes]()
            for _ in range(before):
                sent += _expire(model, first)
            for action, now, timestamp_us in given:
                model.feed(action, max(now, model.state.now), timestamp_us)
                sent += model.datagrams
            for _ in range(after):
                sent += _expire(model, last)
            should = model.status()
            if _messages(sent) == _messages(_data(heard)) and all(
                status.get(key, should[key]) == should[key] for key in COMPARED
            ):
                return True
        return False

    async def _status(self) -> dict[str, Any]:
        """What the agent says of itself now; nothing if it does not."""
        try:
            return await self.process.ask("status")
        except (AgentEndedError, AgentRefusedError):
            return {}

    def _ended(self, deadline: float | None) -> bool:
        """Whether the timer may have ended by now."""
        return deadline is not None and self._wall(deadline) - time.time() < self._pace.early_s

    async def _wait_for_timer(self, until: float, name: str) -> str | None:
        """Until the timer's end, or until anything is heard: what is wrong about that."""
        while time.time() < until and not self.ear.heard:
            await self.ear.arrival(until)
        early_s = until - self.ear.heard[0][0] if self.ear.heard else 0.0
        if early_s > self._pace.early_s:
            early = f"{early_s * self._pace.speedup:.1f} mission seconds"
            return f"it sent a message {early} before its timer {name} expires"
        return None

    def _first_heard(self) -> float:
        """In mission seconds."""
        return self._mission(self.ear.heard[0][0]) if self.ear.heard else 0.0

    async def _give(self, action: Action) -> list[Any]:
        """Of an event, the blocks of the agent's export that it now holds."""
        match action:
            case Datagram():
                self.ear.say(action.data)
            case Command():
                await self.process.ask(action.name)
            case Log():
                data = base64.b64encode(action.data).decode("ascii")
                await self.process.ask("log", event_id=EVENT_ID, data=data)
                export = await self.process.export()
                waiting = export.get("blocks_to_be_committed")
                return waiting if isinstance(waiting, list) else []
        return []

    async def _settle(self, messages: int, since: float, deadline: float | None) -> tuple[dict[str, Any], int, bool]:
        """The status once the agent has handled the input and sent as much as it should, or when that is too late.

        And how often it has answered since it was given the input, before its next timer may have ended: whoever
        answers runs, and could have handled what came before. And whether it was too late. Of an agent that counts its
        handler runs otherwise all else must be as it should for a while.
        """
        pace = self._pace
        give_up, calm_since = since + pace.patience_s, math.inf
        should = self.model.status()
        chances = too_late = 0
        while True:
            self.ear.drain()
            over = time.time() >= give_up
            if len(self.ear.heard) < messages and not over:
                await self.ear.arrival(min(give_up, time.time() + pace.ask_again_s))
                if self.ear.heard and len(self.ear.heard) >= messages:
                    continue
            status = await self.process.ask("status")
            if time.time() > since and not self._ended(deadline):
                chances += 1
            self.ear.drain()
            too_late += over
            if too_late >= CHANCES:
                return status, chances, True
            if len(self.ear.heard) < messages:
                continue
            handled = status.get("handled")
            if isinstance(handled, int) and handled >= should["handled"]:
                if not pace.linger_s:
                    return status, chances, False
                await asyncio.sleep(pace.linger_s)
                return await self.process.ask("status"), chances, False
            calm = all(status.get(key, should[key]) == should[key] for key in COMPARED)
            calm_since = min(calm_since, time.time()) if calm else math.inf
            if time.time() - calm_since > pace.calm_s:
                return status, chances, False
            await self.ear.arrival(time.time() + 0.004)


def _end(error: Exception) -> str | None:
    """The end of the agent that the error reports. None if the machine may be late instead."""
    return str(error) if isinstance(error, AgentHangsError | AgentExitedError) else None


def _data(heard: Sequence[tuple[float, bytes]]) -> list[bytes]:
    return [data for _, data in heard]


def _messages(datagrams: Iterable[bytes]) -> list[Message] | None:
    """None if any of them is not one."""
    try:
        return [decode(data).message for data in datagrams]
    except MalformedDatagramError:
        return None


def _expire(model: Model, now: float) -> list[bytes]:
    """What the reference sends when its next timer ends, then or when it is due."""
    deadline = model.agent.next_timer()
    if deadline is None:
        return []
    model.feed(Expire(), max(deadline, now))
    return model.datagrams


def log_as(model: Model, action: Log, now: float, waiting: list[Any]) -> tuple[Outcome, list[str]]:
    """Have the reference make the block that the agent has made; and what is wrong about that.

    `waiting` is the deque of the agent's export.
    """
    otherwise_us = model.state.newest_block_timestamp_us + 1
    held = len(model.state.blocks_to_be_committed)
    if len(waiting) != held + 1:
        wrong = f"the event did not fill a block: {len(waiting)} blocks in the deque of its export, not {held + 1}"
        return model.feed(action, now, otherwise_us), [wrong]
    made = waiting[-1]
    try:
        events = decode_events(base64.b64decode(made["event_data"], validate=True))
        timestamp_us, block_hash = made["timestamp_us"], made["block_hash"]
    except (MalformedEventsError, binascii.Error, KeyError, TypeError, ValueError):
        return model.feed(action, now, otherwise_us), ["the block in its export is not well-formed"]
    if [event.data for event in events] != [action.data] or events[0].event_id != EVENT_ID:
        return model.feed(action, now, otherwise_us), ["the block does not contain the logged event"]
    outcome = model.feed(action, now, events[0].timestamp_us)
    if model.state.newest_block_timestamp_us != timestamp_us:
        return outcome, ["the timestamp of the block differs from that of its newest event"]
    if model.state.blocks_to_be_committed[-1].block_hash.hex() != block_hash:
        return outcome, ["the hash of the block in the export does not match the block"]
    return outcome, []


def starting(air: Air) -> Start:
    """Agents on this air."""

    async def start(variant: Variant, alone: bool) -> Subject:
        return await OverUdp.start(air, variant, ALONE if alone else BESIDE_OTHERS)

    return start
