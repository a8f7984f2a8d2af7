"""A way as lines of virtual time: what an agent that is driven by standard input is given, and what it must answer.

The lines are those of `COMMAND --virtual` (ucp/contract/CONTRACT.md): each input with its time, each answer with the
datagrams in base64 and the instant at which the next timer ends. Beside them stands in words what they say.
"""

import base64
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from harness.conformance._alphabet import INPUTS, TIMER, Input
from harness.conformance._observation import Names, told, told_datagram
from harness.conformance._reference_model import EVENT_ID, Action, Command, Datagram, Expire, Log, Model, Outcome
from harness.conformance._state_space import STEP_S, Variant
from harness.conformance._subject import mission
from ucp.clock import MICROSECONDS


@dataclass(frozen=True)
class Line:
    """An input, and what must come of it."""

    name: str
    given: dict[str, Any]
    answer: dict[str, Any]
    says: str
    """The input in words."""
    sends: tuple[str, ...]
    """What must be sent, in words."""
    outcome: Outcome


class NotPlayableError(Exception):
    """An input is impossible in virtual time, because over UDP a timer expired late."""


class Writer:
    """The reference in virtual time, whose inputs and answers are written down."""

    def __init__(self, variant: Variant) -> None:
        self.model = Model(variant.settings)
        self.now = 0.0
        self._variant = variant

    def first(self) -> dict[str, Any]:
        """The line with which a life begins."""
        return {"t": 0.0, "mission": virtual_mission(self._variant), "trace": False}

    def lines(self, way: Sequence[str]) -> Iterator[Line]:
        """Yield the lines of these inputs. Raises NotPlayableError."""
        for name in way:
            given = INPUTS[name]
            if given.first is not None:
                yield self.line(INPUTS[given.first])
                yield self.line(INPUTS[TIMER])
            else:
                yield self.line(given)

    def line(self, given: Input) -> Line:
        action = given.make(self.model)
        if action is None:
            raise NotPlayableError(given.name)
        deadline = self.model.agent.next_timer()
        self.now = deadline if isinstance(action, Expire) and deadline is not None else self.now + STEP_S
        timestamp_us = round(self.now * MICROSECONDS)
        outcome = self.model.feed(action, self.now, timestamp_us)
        names = Names(self.model)
        answer = {
            "sent": [base64.b64encode(data).decode("ascii") for data in self.model.datagrams],
            "timer": self.model.agent.next_timer(),
        }
        sends = tuple(told(message, names) for message in outcome.sent)
        return Line(
            given.name, given_line(action, self.now, timestamp_us), answer, _says(action, names), sends, outcome
        )


def virtual_mission(variant: Variant) -> dict[str, Any]:
    return mission(variant, address="10.0.0.1", broadcast="10.0.0.255", port=14600, speedup=1.0, keys={"epoch_us": 0})


def given_line(action: Action, now: float, timestamp_us: int) -> dict[str, Any]:
    """An input as `COMMAND --virtual` reads it."""
    match action:
        case Datagram():
            return {"t": now, "datagram": base64.b64encode(action.data).decode("ascii")}
        case Log():
            data = base64.b64encode(action.data).decode("ascii")
            return {"t": now, "event_id": EVENT_ID, "data": data, "timestamp_us": timestamp_us}
        case Command():
            return {"t": now, "command": action.name}
    return {"t": now, "timer": True}


def _says(action: Action, names: Names) -> str:
    match action:
        case Datagram():
            return f"{told_datagram(action.data, names)} of agent {action.sender}"
        case Log():
            return "an event that fills a block"
        case Command():
            return f"the command {action.name}"
    return "the next timer ends"
