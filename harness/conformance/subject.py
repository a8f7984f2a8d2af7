"""The agent under test beside the reference: both are given an input, and then compared.

What is seen of it: what it broadcasts, and what it says of itself (`status`), once it says that it has handled the
input. So nobody waits where nothing must come, but for an agent that counts its handler runs otherwise.
"""

import base64
import binascii
import dataclasses
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from harness.conformance.air import AgentEndedError, Air, Ear, Process
from harness.conformance.alphabet import INPUTS, TIMER, Input
from harness.conformance.model import (
    AGENT,
    EVENT_ID,
    Action,
    Command,
    Datagram,
    Expire,
    Log,
    Model,
    Outcome,
    Run,
)
from harness.conformance.states import Pair, State, Variant, ends_next, pair_of, state_of
from harness.conformance.words import Names, told, told_datagram
from harness.play.control import AgentRefusedError
from ucp.clock import MICROSECONDS
from ucp.events import MalformedEventsError, decode_events
from ucp.messages import MalformedDatagramError, decode

COMPARED = ("idle", "reconcile_in_progress", "chain", "deque", "stack", "completed", "reconciles", "top_chain_hash")
"""Keys of the status; what is not there is not compared."""
SHOWN = 12


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


BESIDE_OTHERS = Pace(speedup=24.0, margin_s=0.08, early_s=0.15, patience_s=0.5)
ALONE = Pace(speedup=12.0, margin_s=0.25, early_s=0.1, patience_s=2.0)


@dataclass(frozen=True)
class Seen:
    """One step: what came of an input, beside what should have."""

    pair: Pair
    outcome: Outcome
    given: str
    expected: tuple[str, ...]
    came: tuple[str, ...]
    wrong: tuple[str, ...]
    """In sentences; none if all is as it should be."""
    before: State
    late: bool = False
    """The machine was so late that nothing can be said."""
    unexpected: tuple[str, ...] = ()
    """Names of messages that should not have come."""
    missing: tuple[str, ...] = ()
    hidden: Run | None = None
    """What should have changed nothing, just before."""


@dataclass(frozen=True)
class Exchange:
    """A datagram that crossed the air: mission second, whether the agent sent it, what, and what that says."""

    t: float
    sent: bool
    data: bytes
    text: str


class Subject(Protocol):
    """An agent under test, and what it should be."""

    model: Model

    async def step(self, given: Input) -> Seen | None:
        """None if there is no such input now."""

    @property
    def hurried(self) -> bool:
        """Whether the next timer ends so soon that no input should be given before."""


class OverUdp:
    """An agent as a process, from its start on."""

    def __init__(self, variant: Variant, pace: Pace, process: Process, ear: Ear) -> None:
        self.model = Model(variant.settings)
        self.process = process
        self.ear = ear
        self._pace = pace
        self._epoch = 0.0
        self.trusts_handled = True
        self._handled = 0

    @classmethod
    async def start(cls, air: Air, port: int, variant: Variant, pace: Pace) -> "OverUdp":
        """Raises NoAgentError, UnsupportedError, AgentEndedError."""
        process = await Process.start(air, air.new_directory(), air.mission(variant, port, pace.speedup), AGENT)
        try:
            await process.ready()
            ear = Ear(air, port)
            try:
                subject = cls(variant, pace, process, ear)
                await subject._begin()
            except BaseException:
                ear.close()
                raise
        except BaseException:
            await process.kill()
            raise
        return subject

    async def _begin(self) -> None:
        self._epoch = time.time()
        epoch_us = round(self._epoch * MICROSECONDS)
        await self.process.ask("start", epoch_us=epoch_us)

    async def close(self) -> None:
        self.ear.close()
        await self.process.kill()

    def exchanges(self) -> tuple[Exchange, ...]:
        """All that has crossed the air."""
        names = Names(self.model)
        return tuple(
            Exchange(round((at_s - self._epoch) * self._pace.speedup, 3), by_agent, data, told_datagram(data, names))
            for at_s, by_agent, data in self.ear.record
        )

    def now(self) -> float:
        """In mission seconds."""
        return (time.time() - self._epoch) * self._pace.speedup

    def _wall(self, mission_s: float) -> float:
        """Seconds since the Unix epoch at a mission second."""
        return self._epoch + mission_s / self._pace.speedup

    @property
    def hurried(self) -> bool:
        deadline = self.model.agent.next_timer()
        return deadline is not None and self._wall(deadline) - time.time() < self._pace.margin_s

    async def step(self, given: Input) -> Seen | None:
        if given.first is None:
            return await self._step(given)
        pair = pair_of(state_of(self.model), given)
        before = await self._step(INPUTS[given.first])
        if before is None or before.wrong:
            return before
        then = await self._step(INPUTS[TIMER])
        return then if then is None else dataclasses.replace(then, pair=pair, hidden=before.outcome.runs[0])

    async def _step(self, given: Input) -> Seen | None:
        model = self.model
        before, deadline, expired = state_of(model), model.agent.next_timer(), ends_next(model)
        action = given.make(model)
        if action is None:
            return None
        wrong = [f"it sent {told_datagram(data, Names(model))} unasked" for _, data in self.ear.take()]
        began, ends = self.now(), self._wall(deadline or 0.0) if isinstance(action, Expire) else 0.0
        waiting: list[Any] = []
        status: dict[str, Any] = {}
        try:
            if isinstance(action, Expire):
                wrong += await self._wait_for_timer(ends, str(expired))
                began = max(deadline or 0.0, self._first_heard())
            else:
                waiting = await self._give(action)
        except (AgentEndedError, AgentRefusedError) as error:
            wrong.append(str(error))
        if isinstance(action, Log):
            outcome, made = self._log(action, began, waiting)
            wrong += made
        else:
            outcome = model.feed(action, began)
        try:
            status = await self._settle(len(outcome.sent), max(time.time(), ends))
        except (AgentEndedError, AgentRefusedError) as error:
            wrong.append(str(error))
        return self._compare(given, before, outcome, status, wrong)

    async def _wait_for_timer(self, until: float, name: str) -> list[str]:
        """Until the timer's end, or until anything is heard."""
        while time.time() < until and not self.ear.heard:
            await self.ear.arrival(until)
        early_s = until - self.ear.heard[0][0] if self.ear.heard else 0.0
        if early_s > self._pace.early_s:
            return [
                f"it sent something {early_s * self._pace.speedup:.1f} mission seconds before its timer {name} ends"
            ]
        return []

    def _first_heard(self) -> float:
        """In mission seconds."""
        return (self.ear.heard[0][0] - self._epoch) * self._pace.speedup if self.ear.heard else 0.0

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

    def _log(self, action: Log, now: float, waiting: list[Any]) -> tuple[Outcome, list[str]]:
        """The reference makes the block that the agent has made, if it is one of this event."""
        made = waiting[-1] if len(waiting) == len(self.model.state.blocks_to_be_committed) + 1 else None
        newest_us = self.model.state.newest_block_timestamp_us
        try:
            events = decode_events(base64.b64decode(made["event_data"], validate=True)) if made else []
            timestamp_us = int(made["timestamp_us"]) if made else 0
        except (MalformedEventsError, binascii.Error, KeyError, TypeError, ValueError):
            return self.model.feed(action, now, newest_us + 1), ["the block in its export is not well-formed"]
        if made is None:
            held = f"{len(waiting)} blocks in the deque of its export"
            return self.model.feed(action, now, newest_us + 1), [f"the event did not fill a block: {held}"]
        if [event.data for event in events] != [action.data] or events[0].event_id != EVENT_ID:
            return self.model.feed(action, now, newest_us + 1), ["the block does not hold the event that was logged"]
        outcome = self.model.feed(action, now, events[0].timestamp_us)
        if self.model.state.newest_block_timestamp_us != timestamp_us:
            return outcome, ["the block's timestamp is not that of its newest event"]
        if self.model.state.blocks_to_be_committed[-1].block_hash.hex() != made.get("block_hash"):
            return outcome, ["the block's hash in the export is not that of the block"]
        return outcome, []

    async def _settle(self, messages: int, since: float) -> dict[str, Any]:
        """The status once the agent has handled the input and sent as much as it should, or when that is too late."""
        give_up = since + self._pace.patience_s
        expected = self.model.handled
        while True:
            self.ear.drain()
            over = time.time() >= give_up
            if len(self.ear.heard) < messages and not over:
                await self.ear.arrival(give_up)
                continue
            status = await self.process.ask("status")
            self.ear.drain()
            handled = status.get("handled")
            if over or (isinstance(handled, int) and handled >= expected):
                return status
            await self.ear.arrival(min(give_up, time.time() + 0.004))

    def _compare(
        self, given: Input, before: State, outcome: Outcome, status: Mapping[str, Any], wrong: list[str]
    ) -> Seen:
        model, names = self.model, Names(self.model)
        came, expected = [], outcome.sent
        for _, data in self.ear.take():
            try:
                sender, _, message = decode(data)
            except MalformedDatagramError:
                wrong.append(f"it sent {told_datagram(data, names)}")
                continue
            if sender != AGENT:
                wrong.append(f"it sent a message as agent {sender}")
            came.append(message)
        missing = [message for message in expected if message not in came]
        unexpected = [message for message in came if message not in expected]
        if came != expected:
            wrong += [f"it did not send {told(message, names)}" for message in missing]
            wrong += [f"it sent {told(message, names)}" for message in unexpected[:SHOWN]]
            if not missing and not unexpected:
                wrong.append("it sent its messages in another order, or one of them more than once")
        should = model.status()
        for key in COMPARED:
            if key in status and status[key] != should[key]:
                wrong.append(f"its status says {key} {status[key]!r}, not {should[key]!r}")
        deadline = model.agent.next_timer()
        late = deadline is not None and self._wall(deadline) - time.time() < self._pace.early_s
        return Seen(
            pair_of(before, given),
            outcome,
            given.name,
            tuple(told(message, names) for message in expected),
            tuple(told(message, names) for message in came[:SHOWN]),
            tuple(wrong),
            before,
            late,
            tuple(message.NAME for message in unexpected),
            tuple(message.NAME for message in missing),
        )
