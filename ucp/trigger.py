"""Define triggers, the reasons why a handler runs. There is a class for each kind of reason.

A trace writes a trigger as a JSON object (`to_json`). `parse` converts the JSON object back, and pydantic calls it for
fields of type `Trigger`. An object with no kind, several kinds, or missing or wrong values becomes an `UnknownTrigger`.
An agent that follows the contract never writes such an object.
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
        """The value of the key `kind`, such as the name of a message or timer, or an event ID."""
        raise NotImplementedError

    def to_json(self) -> dict[str, int | str]:
        """Return the trigger as a JSON object for a trace."""
        return {self.kind: self.subject}

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: Any) -> dict[str, Any]:
        read = {"type": "no-info", "function": parse}
        return {"type": "function-after", "function": read, "schema": handler(dict[str, int | str])}


@dataclass(unsafe_hash=True, slots=True)
class MessageTrigger(Trigger):
    """A trigger: a message arrived. It has the message's name, its sender's ID, and the sequence number."""

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
    """A trigger: the vehicle logged an event."""

    event_id: int

    kind: ClassVar[str] = "event"

    @property
    def subject(self) -> int:
        return self.event_id


@dataclass(unsafe_hash=True, slots=True)
class TimerTrigger(Trigger):
    """A trigger: a timer expired."""

    timer: str

    kind: ClassVar[str] = "timer"

    @property
    def subject(self) -> str:
        return self.timer


@dataclass(unsafe_hash=True, slots=True)
class LocalTrigger(Trigger):
    """A trigger: a handler triggered a local event. It has the name of this handler."""

    handler: str

    kind: ClassVar[str] = "local"

    @property
    def subject(self) -> str:
        return self.handler


@dataclass(unsafe_hash=True, slots=True)
class OperatorTrigger(Trigger):
    """A trigger: the operator gave the command `reconcile`."""

    command: str

    kind: ClassVar[str] = "operator"

    @property
    def subject(self) -> str:
        return self.command


@dataclass(unsafe_hash=True, slots=True)
class BootTrigger(Trigger):
    """A trigger: the agent started, and found a chain of `blocks` blocks on its disk."""

    blocks: int

    kind: ClassVar[str] = "boot"

    @property
    def subject(self) -> int:
        return self.blocks


@dataclass(slots=True)
class UnknownTrigger(Trigger):
    """A trigger that the agent contract does not define. `fields` is the whole JSON object."""

    fields: Mapping[str, int | str]

    @property
    def subject(self) -> int | str:
        return next(iter(self.fields.values()), "")

    def to_json(self) -> dict[str, int | str]:
        return dict(self.fields)

    def __hash__(self) -> int:
        return hash(frozenset(self.fields.items()))


_OF_ONE_VALUE: dict[str, tuple[type, Callable[[Any], Trigger]]] = {
    "event": (int, EventTrigger),
    "timer": (str, TimerTrigger),
    "local": (str, LocalTrigger),
    "operator": (str, OperatorTrigger),
    "boot": (int, BootTrigger),
}
KINDS = frozenset(("message", *_OF_ONE_VALUE))
"""The keys that name the kind of a trigger. A trigger has exactly one of them."""


def parse(fields: Mapping[str, int | str]) -> Trigger:
    """Return the trigger that a JSON object of a trace describes. Return an `UnknownTrigger` if the object is not
    valid.
    """
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
