"""Triggers: the reasons why a handler runs, one class for each kind.

A trace writes a trigger as a JSON object (`to_json`). `parse` reads one, and pydantic does so wherever a field has the
type `Trigger`. An object that names no kind, several kinds, or a kind with missing or wrong values is an
`UnknownTrigger`: no agent that follows the contract writes one.
"""

from collections.abc import Callable, Mapping
from typing import Any, ClassVar

from ucp._dataclass import dataclass


class Trigger:
    """The reason why a handler ran. `kind` is its key in a trace."""

    __slots__ = ()
    kind: ClassVar[str] = ""

    @property
    def subject(self) -> int | str:
        """The value of the key `kind`: a message's or timer's name, an event ID, and so on."""
        raise NotImplementedError

    def to_json(self) -> dict[str, int | str]:
        """Return the trigger as a trace has it."""
        return {self.kind: self.subject}

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: Any) -> dict[str, Any]:
        read = {"type": "no-info", "function": parse}
        return {"type": "function-after", "function": read, "schema": handler(dict[str, int | str])}


@dataclass(unsafe_hash=True, slots=True)
class MessageTrigger(Trigger):
    """A message arrived: its name, its sender's agent ID, and the sender's sequence number."""

    message: str
    sender: int
    sequence: int

    kind: ClassVar[str] = "message"

    @property
    def subject(self) -> str:
        return self.message

    def to_json(self) -> dict[str, int | str]:
        return {"message": self.message, "from": self.sender, "seq": self.sequence}


@dataclass(unsafe_hash=True, slots=True)
class EventTrigger(Trigger):
    """The vehicle logged an event."""

    event_id: int

    kind: ClassVar[str] = "event"

    @property
    def subject(self) -> int:
        return self.event_id


@dataclass(unsafe_hash=True, slots=True)
class TimerTrigger(Trigger):
    """A timer expired."""

    timer: str

    kind: ClassVar[str] = "timer"

    @property
    def subject(self) -> str:
        return self.timer


@dataclass(unsafe_hash=True, slots=True)
class LocalTrigger(Trigger):
    """Another handler, named here, triggered a local event."""

    handler: str

    kind: ClassVar[str] = "local"

    @property
    def subject(self) -> str:
        return self.handler


@dataclass(unsafe_hash=True, slots=True)
class OperatorTrigger(Trigger):
    """The operator gave a command: `reconcile`."""

    command: str

    kind: ClassVar[str] = "operator"

    @property
    def subject(self) -> str:
        return self.command


@dataclass(unsafe_hash=True, slots=True)
class BootTrigger(Trigger):
    """The agent booted, and found a chain of `blocks` blocks on its disk."""

    blocks: int

    kind: ClassVar[str] = "boot"

    @property
    def subject(self) -> int:
        return self.blocks


@dataclass(slots=True)
class UnknownTrigger(Trigger):
    """An object that is no trigger of the contract; `fields` is the object."""

    fields: Mapping[str, int | str]

    @property
    def subject(self) -> int | str:
        return next(iter(self.fields.values()), "")

    def to_json(self) -> dict[str, int | str]:
        return dict(self.fields)

    def __hash__(self) -> int:
        return hash(tuple(self.fields.items()))


_OF_ONE_VALUE: dict[str, tuple[type, Callable[[Any], Trigger]]] = {
    "event": (int, EventTrigger),
    "timer": (str, TimerTrigger),
    "local": (str, LocalTrigger),
    "operator": (str, OperatorTrigger),
    "boot": (int, BootTrigger),
}
KINDS = frozenset(("message", *_OF_ONE_VALUE))
"""The keys of which a trigger has exactly one."""


def parse(fields: Mapping[str, int | str]) -> Trigger:
    """Return the trigger of an object in a trace. It is an `UnknownTrigger` if it has no valid key."""
    kinds = KINDS.intersection(fields)
    if len(kinds) != 1:
        return UnknownTrigger(fields)
    (kind,) = kinds
    value = fields[kind]
    if kind == "message":
        sender, sequence = fields.get("from"), fields.get("seq")
        if isinstance(value, str) and isinstance(sender, int) and isinstance(sequence, int):
            return MessageTrigger(value, sender, sequence)
        return UnknownTrigger(fields)
    of_type, made = _OF_ONE_VALUE[kind]
    return made(value) if isinstance(value, of_type) else UnknownTrigger(fields)
