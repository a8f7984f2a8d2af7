"""Divide a trace into the inputs of the agent, and guess the inputs whose trace lines are lost.

Each input is stored together with the handler runs that it caused. `bridge` guesses lost inputs. The lost inputs
themselves are unknown, but the state of the agent after them is known: its chain, and the events in its current block.
The module therefore simulates peers that already hold this chain. The peers answer each query of the agent, approve its
blocks in the order of the chain, and send it the blocks that it lacks. The events come from the agent's own later
blocks. The agent itself is a real agent core, so a scenario can play the same inputs.
"""

import base64
import math
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Protocol

from harness.archive.traces import Trace
from harness.archive.vocabulary import IGNORED_KINDS, first_unknown, timer_that_ended, unknown_names
from harness.checker.recorded_inputs import event_of
from harness.checker.steps.trace_header import CheckedHeader
from ucp.agent import Agent
from ucp.block import Block, next_chain_hash
from ucp.events import LoggableEvent, MalformedEventsError, decode_events
from ucp.messages import (
    BlockAddRequest,
    BlockAddResponse,
    BlockResponse,
    ChainContainQuery,
    ChainContainResponse,
    ChainHashSuccessorQuery,
    CommitBlock,
    Message,
    NextInSequenceResponse,
    RequestForBlock,
    decode,
    encode,
)
from ucp.trace import HandlerRun
from ucp.trigger import BootTrigger, EventTrigger, LocalTrigger, MessageTrigger, OperatorTrigger, TimerTrigger


class UnusableInputError(Exception):
    """An error: an input is not recorded, or it is impossible. The message is one sentence."""


@dataclass(frozen=True, slots=True)
class EventLogged:
    """An input: the vehicle logged an event."""

    event: LoggableEvent


@dataclass(frozen=True, slots=True)
class DatagramReceived:
    """An input: the agent received a datagram."""

    datagram: bytes


@dataclass(frozen=True, slots=True)
class TimerExpired:
    """An input: the timer `name` expired."""

    name: str


@dataclass(frozen=True, slots=True)
class ReconcileRequested:
    """An input: the operator requested a reconcile."""


@dataclass(frozen=True, slots=True)
class BootedFromDisk:
    """An input: the agent restarted with the data on its disk."""


Cause = EventLogged | DatagramReceived | TimerExpired | ReconcileRequested | BootedFromDisk


@dataclass(slots=True)
class RecordedInput:
    """One input of an agent."""

    at_s: float
    """The time of the input on the agent's clock."""
    line: int
    """The line number in the agent's trace, counted from 1."""
    cause: Cause
    runs: list[HandlerRun] = field(default_factory=list)
    """The handler runs that the input caused, including the runs for local events."""
    is_partial: bool = False
    """True if some of the handler runs may be lost."""


class MissingInputs(Protocol):
    """Records other than the agent's own trace. They may contain the inputs that a trace of version 1 omits."""

    def datagrams(self, sender: int, sequence: int) -> list[bytes]: ...

    def events(self, agent_id: int) -> list[LoggableEvent]: ...


def inputs_by_incarnation(
    trace: Trace, header: CheckedHeader, missing: MissingInputs
) -> tuple[list[list[RecordedInput]], str | None]:
    """Return the usable inputs of each incarnation. Also return the reason why later inputs are unusable, with the line
    of the trace, or None if all inputs are usable.
    """
    reader = _InputReader(header, missing)
    incarnations: list[list[RecordedInput]] = []
    for handler_runs in trace.incarnations():
        inputs: list[RecordedInput] = []
        incarnations.append(inputs)
        try:
            for new_input in reader.inputs(handler_runs):
                inputs.append(new_input)
        except UnusableInputError as error:
            return incarnations, str(error)
    return incarnations, None


class _InputReader:
    def __init__(self, header: CheckedHeader, missing: MissingInputs) -> None:
        self._header = header
        self._missing = missing
        self._events: Iterator[LoggableEvent] | None = None

    def inputs(self, handler_runs: Iterator[tuple[int, HandlerRun]]) -> Iterator[RecordedInput]:
        current: RecordedInput | None = None
        last_s = float("-inf")
        for line, run in handler_runs:
            unknown = unknown_names([run])
            if unknown.keys() - IGNORED_KINDS:
                raise UnusableInputError(f"line {line}: {first_unknown(unknown)}")
            if isinstance(run.trigger, LocalTrigger):
                if current is None:
                    raise UnusableInputError(f"line {line}: {run.handler} ran for a local event before any input")
                current.runs.append(run)
                continue
            if current is not None:
                yield current
            if not math.isfinite(run.t):
                raise UnusableInputError(f"line {line}: {run.handler} ran at no time")
            last_s = max(last_s, self._header.local(run.t))
            current = RecordedInput(last_s, line, self._cause(line, run), [run])
        if current is not None:
            yield current

    def _cause(self, line: int, run: HandlerRun) -> Cause:
        trigger = run.trigger
        try:
            if isinstance(trigger, MessageTrigger):
                return DatagramReceived(self._datagram(line, run, trigger))
            if isinstance(trigger, EventTrigger):
                return EventLogged(
                    event_of(run.input) if run.input is not None else self._event(line, trigger.event_id)
                )
        except (ValueError, MalformedEventsError):
            raise UnusableInputError(f"line {line}: the input of {run.handler} is damaged") from None
        if isinstance(trigger, TimerTrigger):
            return TimerExpired(timer_that_ended(run, trigger))
        if isinstance(trigger, OperatorTrigger):
            return ReconcileRequested()
        if isinstance(trigger, BootTrigger):
            return BootedFromDisk()
        raise UnusableInputError(f"line {line}: {run.handler} ran without a known trigger")

    def _datagram(self, line: int, run: HandlerRun, trigger: MessageTrigger) -> bytes:
        if run.input is not None:
            return base64.b64decode(run.input.text, validate=True)
        sender, sequence = trigger.sender, trigger.sequence
        for datagram in self._missing.datagrams(sender, sequence):
            if trigger.message == decode(datagram).message.NAME:
                return datagram
        raise UnusableInputError(
            f"line {line}: datagram {sequence} of agent {sender} is not recorded: add the trace of agent {sender}, or "
            "a capture"
        )

    def _event(self, line: int, event_id: int) -> LoggableEvent:
        if self._events is None:
            self._events = iter(self._missing.events(self._header.agent_id))
        event = next(self._events, None)
        if event is None or event.event_id != event_id:
            raise UnusableInputError(f"line {line}: the logged event is in no exported block")
        return event


FIRST_SEQUENCE = 0xF000_0000
"""Sequence number of the first guessed message. The number is so large that real agents never reach it."""
STEPS_PER_BLOCK = 200
"""Maximum number of guessed inputs for each block of the chain."""


@dataclass(frozen=True)
class KnownState:
    """The known state of an idle agent after lost trace lines."""

    chain: tuple[Block, ...]
    current_block: bytes | None
    """The block under construction. The value is None if this block is empty, or if its content has no later effect."""
    why: str
    """The reason why the trace lines are missing."""


class InferredInputPath:
    """The guessed inputs that lead an agent to a known state. The inputs are computed one at a time. `reached` is true
    as soon as the agent has reached the state.
    """

    def __init__(self, agent: Agent, known: KnownState) -> None:
        self.reached = False
        self._agent = agent
        self._known = known
        self._peers = sorted(agent.roster - {agent.agent_id})
        self._answers: deque[tuple[int, Message]] = deque()
        self._sequence = FIRST_SEQUENCE
        self._events: deque[LoggableEvent] = deque()
        self._left = STEPS_PER_BLOCK * (len(known.chain) + 1)
        top = agent.state.chain.inception.chain_hash
        self._chain_hashes = [top]
        for block in known.chain:
            top = next_chain_hash(top, block.block_hash)
            self._chain_hashes.append(top)

    def next(self, sent: Iterable[Message]) -> Cause | None:
        """Return the next input, given the messages that the agent has just sent. Return None if there is no further
        input.
        """
        self._left -= 1
        if self._left < 0 or not self._peers:
            return None
        for message in sent:
            self._answer(message)
        if self._answers:
            sender, message = self._answers.popleft()
            return self._datagram(sender, message)
        state = self._agent.state
        running = [timer for timer in state.timers if timer.deadline is not None]
        if running:
            return TimerExpired(min(running, key=lambda timer: timer.deadline or 0.0).name)
        if self._events:
            return EventLogged(self._events.popleft())
        return self._for_an_idle_agent() if state.idle else None

    def _for_an_idle_agent(self) -> Cause | None:
        state, chain = self._agent.state, self._known.chain
        held = len(state.chain)
        if held > len(chain) or self._chain_hashes[held] != state.chain.top_chain_hash:
            return ReconcileRequested()
        if held == len(chain):
            wanted = self._known.current_block
            self.reached = wanted is None or bytes(state.current_block) == wanted
            return None if wanted is None or self.reached else self._log(wanted)
        block = chain[held]
        if block.agent_id == self._agent.agent_id and block.block_hash not in state.completed:
            logged = self._log(block.event_data)
            if logged is not None:
                return logged
        owner = block.agent_id if block.agent_id in self._peers else self._peers[0]
        return self._datagram(owner, CommitBlock(block, self._chain_hashes[held + 1]))

    def _log(self, event_data: bytes) -> Cause | None:
        """Return the next event that the block under construction lacks. Return None if the block lacks no event, or if
        its events differ from the known events of this block.
        """
        logged = bytes(self._agent.state.current_block)
        if not event_data.startswith(logged):
            return None
        try:
            self._events.extend(decode_events(event_data[len(logged) :]))
        except MalformedEventsError:
            return None
        return EventLogged(self._events.popleft()) if self._events else None

    def _datagram(self, sender: int, message: Message) -> Cause:
        self._sequence += 1
        return DatagramReceived(encode(sender, self._sequence, message))

    def _answer(self, message: Message) -> None:
        """Schedule the answer that a peer with the known chain gives to this message. If the message is no query or
        request, do nothing.
        """
        answer: Message
        known = {chain_hash: height for height, chain_hash in enumerate(self._chain_hashes)}
        chain = self._known.chain
        match message:
            case BlockAddRequest(block_hash, chain_hash):
                height = known.get(chain_hash, len(chain))
                approve = height < len(chain) and chain[height].block_hash == block_hash
                named = chain_hash if self._agent.state.settings.vote_names_chain else None
                answer = BlockAddResponse(block_hash, approve, named)
            case ChainContainQuery(chain_hash):
                answer = ChainContainResponse(chain_hash, chain_hash in known)
            case ChainHashSuccessorQuery(chain_hash) if chain_hash in known:
                height = known[chain_hash]
                following = chain[height] if height < len(chain) else None
                timestamp_us = (following or chain[-1]).timestamp_us if chain else 0
                answer = NextInSequenceResponse(chain_hash, following.block_hash if following else None, timestamp_us)
            case RequestForBlock(block_hash):
                block = next((block for block in chain if block.block_hash == block_hash), None)
                if block is not None:
                    self._answers.append((self._peers[0], BlockResponse(block)))
                return
            case _:
                return
        self._answers.extend((peer, answer) for peer in self._peers)
