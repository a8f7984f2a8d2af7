"""What reached an agent, in order, and what it did then: a trace, taken apart into inputs."""

import base64
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Protocol

from harness.archive.traces import Trace
from harness.archive.vocabulary import IGNORED_KINDS, first_unknown, timer_that_ended, unknown_names
from harness.checker.recorded_inputs import event_of
from harness.checker.steps.trace_header import CheckedHeader
from ucp.events import LoggableEvent, MalformedEventsError
from ucp.messages import decode
from ucp.trace import HandlerRun
from ucp.trigger import BootTrigger, EventTrigger, LocalTrigger, MessageTrigger, OperatorTrigger, TimerTrigger


class UnusableInputError(Exception):
    """What came is not on record, or is nothing that can come: a sentence."""


@dataclass(frozen=True, slots=True)
class Logged:
    """The vehicle logged an event."""

    event: LoggableEvent


@dataclass(frozen=True, slots=True)
class Heard:
    """A datagram came."""

    datagram: bytes


@dataclass(frozen=True, slots=True)
class TimerEnded:
    """The timer of this name ended."""

    name: str


@dataclass(frozen=True, slots=True)
class Asked:
    """The operator asked for a reconcile."""


@dataclass(frozen=True, slots=True)
class Booted:
    """The agent went on from what was on its disk."""


What = Logged | Heard | TimerEnded | Asked | Booted


@dataclass(slots=True)
class Input:
    """`at_s` is by the agent's own clock; `line` is that of its trace, counting from 1.

    `runs` are the handler runs that came of it, those of local events too.
    """

    at_s: float
    line: int
    what: What
    runs: list[HandlerRun] = field(default_factory=list)


class Missing(Protocol):
    """Where to look for what a trace of version 1 does not have."""

    def datagrams(self, sender: int, sequence: int) -> list[bytes]: ...

    def events(self, agent_id: int) -> list[LoggableEvent]: ...


def lives_of(trace: Trace, header: CheckedHeader, missing: Missing) -> tuple[list[list[Input]], str | None]:
    """The inputs of each life of the agent; and, naming the line, why not all of them if the rest cannot be used."""
    reader = _Reader(header, missing)
    lives: list[list[Input]] = []
    for life in trace.incarnations():
        inputs: list[Input] = []
        lives.append(inputs)
        try:
            for given in reader.inputs(life):
                inputs.append(given)
        except UnusableInputError as error:
            return lives, str(error)
    return lives, None


class _Reader:
    def __init__(self, header: CheckedHeader, missing: Missing) -> None:
        self._header = header
        self._missing = missing
        self._events: Iterator[LoggableEvent] | None = None

    def inputs(self, life: Iterator[tuple[int, HandlerRun]]) -> Iterator[Input]:
        current: Input | None = None
        last_s = float("-inf")
        for line, run in life:
            words = unknown_names([run])
            if words.keys() - IGNORED_KINDS:
                raise UnusableInputError(f"line {line}: {first_unknown(words)}")
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
            current = Input(last_s, line, self._what(line, run), [run])
        if current is not None:
            yield current

    def _what(self, line: int, run: HandlerRun) -> What:
        trigger = run.trigger
        try:
            if isinstance(trigger, MessageTrigger):
                return Heard(self._datagram(line, run, trigger))
            if isinstance(trigger, EventTrigger):
                return Logged(event_of(run.input) if run.input is not None else self._event(line, trigger.event_id))
        except (ValueError, MalformedEventsError):
            raise UnusableInputError(f"line {line}: the input of {run.handler} is damaged") from None
        if isinstance(trigger, TimerTrigger):
            return TimerEnded(timer_that_ended(run, trigger))
        if isinstance(trigger, OperatorTrigger):
            return Asked()
        if isinstance(trigger, BootTrigger):
            return Booted()
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
