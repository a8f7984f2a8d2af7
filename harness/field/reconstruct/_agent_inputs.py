"""Divide a trace into the inputs of the agent. Each input has the handler runs that it caused."""

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
    """Records other than the agent's own trace. These records may contain inputs that a trace of version 1 does not
    contain.
    """

    def datagrams(self, sender: int, sequence: int) -> list[bytes]: ...

    def events(self, agent_id: int) -> list[LoggableEvent]: ...


def inputs_by_incarnation(
    trace: Trace, header: CheckedHeader, missing: MissingInputs
) -> tuple[list[list[RecordedInput]], str | None]:
    """Return the usable inputs of each incarnation, and the reason why later inputs are unusable. The reason names the
    line of the trace. It is None if all inputs are usable.
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
