"""Convert a sequence of inputs to the lines that `COMMAND --virtual` reads, and to the answers that it should write.

ucp/contract/CONTRACT.md describes the lines. A line with an input contains its time. A line with an answer contains
datagrams in base64, and the time at which the next timer expires. Each line also has a description in words.
"""

import base64
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from harness.conformance._agent_under_test import mission
from harness.conformance._alphabet import INPUTS, TIMER, AgentInput
from harness.conformance._observation import KnownNames, datagram_text, message_text
from harness.conformance._reference_model import (
    EVENT_ID,
    Action,
    ControlCommand,
    ExpectedOutcome,
    LoggedEvent,
    PeerDatagram,
    ReferenceModel,
    TimerExpiry,
)
from harness.conformance._state_space import STEP_S, SettingsVariant
from ucp.clock import MICROSECONDS


@dataclass(frozen=True)
class VirtualLine:
    """An input for an agent in virtual time, and the expected answer."""

    name: str
    given: dict[str, Any]
    answer: dict[str, Any]
    input_text: str
    """Description of the input."""
    sent_texts: tuple[str, ...]
    """Descriptions of the expected messages."""
    outcome: ExpectedOutcome


class NotPlayableError(Exception):
    """An error: an input is impossible in virtual time, because a timer expired late in the test over UDP."""


class LineWriter:
    """A writer that runs the reference in virtual time, and converts each input and answer to a line."""

    def __init__(self, variant: SettingsVariant) -> None:
        self.model = ReferenceModel(variant.settings)
        self.now = 0.0
        self._variant = variant

    def first_line(self) -> dict[str, Any]:
        """Return the line that starts the agent."""
        return {"t": 0.0, "mission": virtual_mission(self._variant), "trace": False}

    def lines(self, path: Sequence[str]) -> Iterator[VirtualLine]:
        """Yield the lines for these inputs. Raises NotPlayableError."""
        for name in path:
            given = INPUTS[name]
            if given.preceding is not None:
                yield self.line(INPUTS[given.preceding])
                yield self.line(INPUTS[TIMER])
            else:
                yield self.line(given)

    def line(self, given: AgentInput) -> VirtualLine:
        action = given.make(self.model)
        if action is None:
            raise NotPlayableError(given.name)
        deadline = self.model.agent.next_timer()
        self.now = deadline if isinstance(action, TimerExpiry) and deadline is not None else self.now + STEP_S
        timestamp_us = round(self.now * MICROSECONDS)
        outcome = self.model.feed(action, self.now, timestamp_us)
        names = KnownNames(self.model)
        answer = {
            "sent": [base64.b64encode(data).decode("ascii") for data in self.model.datagrams],
            "timer": self.model.agent.next_timer(),
        }
        sent_texts = tuple(message_text(message, names) for message in outcome.sent)
        return VirtualLine(
            given.name,
            given_line(action, self.now, timestamp_us),
            answer,
            _input_text(action, names),
            sent_texts,
            outcome,
        )


def virtual_mission(variant: SettingsVariant) -> dict[str, Any]:
    return mission(variant, address="10.0.0.1", broadcast="10.0.0.255", port=14600, speedup=1.0, keys={"epoch_us": 0})


def given_line(action: Action, now: float, timestamp_us: int) -> dict[str, Any]:
    """Return an input in the format that `COMMAND --virtual` reads."""
    match action:
        case PeerDatagram():
            return {"t": now, "datagram": base64.b64encode(action.data).decode("ascii")}
        case LoggedEvent():
            data = base64.b64encode(action.data).decode("ascii")
            return {"t": now, "event_id": EVENT_ID, "data": data, "timestamp_us": timestamp_us}
        case ControlCommand():
            return {"t": now, "command": action.name}
    return {"t": now, "timer": True}


def _input_text(action: Action, names: KnownNames) -> str:
    match action:
        case PeerDatagram():
            return f"{datagram_text(action.data, names)} of agent {action.sender}"
        case LoggedEvent():
            return "an event that fills a block"
        case ControlCommand():
            return f"the command {action.name}"
    return "the next timer ends"
