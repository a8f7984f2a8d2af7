"""Describe a step that differs from the reference, with the actual and the expected behaviour."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from harness.checker.recorded_inputs import decoded
from harness.checker.reference.algorithms import HANDLERS
from ucp.messages import MalformedDatagramError
from ucp.trace import HandlerRun, SentMessage, Tally

NameOf = Callable[[str], str]
"""A function that returns the name of the block with a given hash."""

CHOOSES = 15
"""The number of the Algorithm whose trace line contains the chosen block. The trace lines of other Algorithms contain
the counted votes or answers.
"""
SHOWN = 3
"""Maximum number of changes or messages that the description of a step lists. For further changes or messages, the
description gives only their number.
"""


@dataclass(frozen=True, slots=True)
class StepDeviation:
    """A difference between a step of an agent and the same step of the reference implementation."""

    agent_id: int
    line: int
    t: float
    handler: str | None
    what: str = ""
    """Description of the difference. Empty if `run` and `expected` describe it."""
    run: HandlerRun | None = None
    """The recorded handler run."""
    expected: HandlerRun | None = None
    """The handler run of the reference implementation."""

    def sentence(self, name: NameOf) -> str:
        """Return a sentence with the trace line, the time, the handler, and the actual and expected behaviour."""
        known = HANDLERS.get(self.handler or "")
        handler = f"Algorithm {known.algorithm}, {known.name}: " if known else ""
        return f"trace line {self.line}, t={self.t:g} s: {handler}{self.difference(name)}"

    def difference(self, name: NameOf) -> str:
        """Return a phrase with the actual and the expected behaviour."""
        if self.run is None or self.expected is None:
            return self.what
        did, should = zip(*differences(self.run, self.expected, name), strict=True)
        return f"it {_join(did)}; it should have {_join(should)}"


def differences(run: HandlerRun, expected: HandlerRun, name: NameOf) -> Iterator[tuple[str, str]]:
    """Compare two handler runs. Yield the actual and the expected behaviour for each part in which they differ."""
    if run.branch != expected.branch:
        yield f"took the branch '{run.branch[:60]}'", f"taken '{expected.branch}'"
    as_changed = run.changes == expected.changes
    if not as_changed:
        yield _changes(run.changes, name), _changes(expected.changes, name)
    if run.sent != expected.sent:
        yield _sent(run.sent, expected.sent, name), _sent(expected.sent, run.sent, name)
    if (run.started or {}) != (expected.started or {}):
        yield _started(run.started or {}), _started(expected.started or {})
    if run.tally != expected.tally:
        verb = "chosen" if run.algorithm == CHOOSES else "counted"
        did = "chose" if run.algorithm == CHOOSES else "counted"
        yield f"{did} {_tally(run.tally or {}, name)}", f"{verb} {_tally(expected.tally or {}, name)}"
    ours, theirs = expected.state, run.state
    for what in ("chain", "deque", "stack"):
        if as_changed and getattr(ours, what) != getattr(theirs, what):
            yield f"had {getattr(theirs, what)} blocks in its {what}", f"had {getattr(ours, what)}"
    if ours.reconciling != theirs.reconciling:
        yield _was(theirs.reconciling, "reconciling"), _been(ours.reconciling, "reconciling")
    if ours.idle != theirs.idle:
        yield _was(theirs.idle, "idle"), _been(ours.idle, "idle")
    if as_changed and ours.top != theirs.top:
        yield f"had the top chain hash {theirs.top[:12]}", f"had {ours.top[:12]}"


def _changes(changes: Sequence[tuple[str, str]], name: NameOf) -> str:
    if not changes:
        return "changed nothing"
    words = [f"{operation} {name(block)}" for operation, block in changes[:SHOWN]]
    return f"changed {', '.join(words)}{_and_more(changes)}"


def _sent(sent: Sequence[SentMessage], others: Sequence[SentMessage], name: NameOf) -> str:
    if not sent:
        return "sent nothing"
    return f"sent {', '.join(_message(message, others, name) for message in sent[:SHOWN])}{_and_more(sent)}"


def _message(message: SentMessage, others: Sequence[SentMessage], name: NameOf) -> str:
    about = f" about block {name(message.block)}" if message.block else ""
    words = f"{message.message[:60]}{about}"
    alike = [other for other in others if (other.message, other.block) == (message.message, message.block)]
    if any(other.seq != message.seq for other in alike):
        words += f" with sequence number {message.seq}"
    elif alike and all(other.datagram != message.datagram for other in alike):
        words += f" saying {_content(message, alike[0])}"
    return words


def _content(message: SentMessage, other: SentMessage) -> str:
    """Return the parts of the content of `message` that differ from `other`, a message of the same type about the same
    block.
    """
    try:
        content = decoded(message.datagram).message
    except MalformedDatagramError as malformed:
        return f"an invalid message ({malformed.reason})"
    try:
        expected: object = decoded(other.datagram).message
    except MalformedDatagramError:
        expected = None
    values = []
    for field in type(content).WIRE:
        value = getattr(content, field)
        if value != getattr(expected, field, None):
            words = value.hex()[:12] if isinstance(value, bytes) else str(value)[:60]
            values.append(f"{field.replace('_', ' ')} {words}")
    return ", ".join(values) or "the same from another sender"


def _started(started: dict[str, float]) -> str:
    if not started:
        return "started no timer"
    return "started " + ", ".join(f"the {timer[:60]} timer for {duration:g} s" for timer, duration in started.items())


def _tally(tally: Tally, name: NameOf) -> str:
    if not tally:
        return "nothing"
    words = []
    for key, count in list(tally.items())[:SHOWN]:
        if key in ("yes", "no"):
            words.append(f"{key} {count}")
        else:
            words.append(f"{name(key) if key else 'Is Top Of Chain'}: {count}")
    return ", ".join(words) + _and_more(list(tally))


def _was(is_so: bool, what: str) -> str:
    return f"was {what}" if is_so else f"was not {what}"


def _been(is_so: bool, what: str) -> str:
    return f"been {what}" if is_so else f"been not {what}"


def _and_more(things: Sequence[object]) -> str:
    return f" and {len(things) - SHOWN} more" if len(things) > SHOWN else ""


def _join(phrases: Sequence[str]) -> str:
    return phrases[0] if len(phrases) == 1 else f"{', '.join(phrases[:-1])} and {phrases[-1]}"
