"""What reached an agent, in order, and what it did then: a trace, taken apart into inputs."""

import base64
from collections.abc import Iterator
from dataclasses import dataclass, field

from harness.archive.traces import Trace
from harness.checker.steps.header import CheckedHeader
from harness.checker.steps.inputs import event_of
from ucp.events import LoggableEvent, MalformedEventsError
from ucp.trace import HandlerRun


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


def lives_of(trace: Trace, header: CheckedHeader) -> list[list[Input]]:
    """The inputs of each life of the agent. Raises UnusableInputError, naming the line."""
    return [list(_inputs(life, header)) for life in trace.lives()]


def _inputs(life: Iterator[tuple[int, HandlerRun]], header: CheckedHeader) -> Iterator[Input]:
    current: Input | None = None
    last_s = float("-inf")
    for line, run in life:
        if "local" in run.trigger:
            if current is None:
                raise UnusableInputError(f"line {line}: {run.handler} ran for a local event before anything had come")
            current.runs.append(run)
            continue
        if current is not None:
            yield current
        last_s = max(last_s, header.local(run.t))
        current = Input(last_s, line, _what(line, run), [run])
    if current is not None:
        yield current


def _what(line: int, run: HandlerRun) -> What:
    trigger = run.trigger
    try:
        if "message" in trigger:
            if run.input is None:
                raise UnusableInputError(f"line {line}: the datagram that {run.handler} was given is not on record")
            return Heard(base64.b64decode(run.input.text, validate=True))
        if "event" in trigger:
            return Logged(event_of(run.input))
    except (ValueError, MalformedEventsError):
        raise UnusableInputError(f"line {line}: the input of {run.handler} is damaged") from None
    if "timer" in trigger:
        return TimerEnded(str(trigger["timer"]))
    if "operator" in trigger:
        return Asked()
    if "boot" in trigger:
        return Booted()
    raise UnusableInputError(f"line {line}: {run.handler} ran without a trigger that there is")
