"""Parse an answer line of a foreign agent (a separate program), and define the errors that the agent can cause."""

import base64
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from pydantic import ValidationError
from pydantic_core import from_json

from harness.archive.traces import ASIDE, HANDLER_RUN
from harness.errors import UnsupportedError
from ucp.messages import Datagram, MalformedDatagramError, decode
from ucp.trace import Entry, HandlerRun, RecordedBytes

MAX_SENT = 1000
"""Maximum number of datagrams in one answer."""
MAX_UDP_BYTES = 65507
LATEST_S = 1e12
SHOWN = 60


class AnswerError(Exception):
    """An error: a line is not a valid answer. The message completes a sentence that starts with "agent 3 answered"."""


class LacksError(Exception):
    """An error: the agent does not support the input. The message is the sentence that the agent wrote."""


class RefusedError(Exception):
    """An error: the agent refuses the input. The message is the sentence that the agent wrote."""


@dataclass(slots=True)
class ForeignAnswer:
    """A valid answer of a foreign agent."""

    sent: list[tuple[bytes, RecordedBytes]]
    """The datagrams that the agent sent. Each datagram comes with the form in which traces record it. This form
    contains the message if the datagram contains a valid message.
    """
    timer: float | None
    """Time on the agent's clock at which its next timer expires."""
    trace: list[Entry] = field(default_factory=list)
    command_answer: Any = None
    """The answer to a command. The parser does not check the content of this answer."""


def read_answer(line: bytes, *, tracing: bool) -> ForeignAnswer:
    """Parse a line. Raises AnswerError, LacksError or RefusedError."""
    try:
        document = from_json(line, allow_inf_nan=False)
    except ValueError as error:
        raise AnswerError(f"with a line that is not JSON ({error}): {shown(line)}") from None
    if not isinstance(document, dict):
        raise AnswerError(f"with a line that is not a JSON object: {shown(line)}")
    if "error" in document:
        kind = LacksError if document.get("unsupported") is True else RefusedError
        raise kind(str(document["error"])[:500])
    sent = document.get("sent")
    if not isinstance(sent, list):
        raise AnswerError(f"without a list `sent`: {shown(line)}")
    if len(sent) > MAX_SENT:
        raise AnswerError(f"with {len(sent)} datagrams at once: at most {MAX_SENT} are allowed for an input")
    timer = document.get("timer", math.nan)
    if timer is not None and (type(timer) not in (int, float) or not -LATEST_S <= timer <= LATEST_S):
        what = f"with the timer {shown(timer)}, not" if "timer" in document else "without"
        raise AnswerError(f"{what} a number of mission seconds, or null, as `timer`")
    answer = ForeignAnswer([_datagram(text) for text in sent], timer, command_answer=document.get("answer"))
    if tracing:
        trace = document.get("trace")
        if not isinstance(trace, list):
            raise AnswerError("without the list `trace`, which its mission requires")
        answer.trace = list(_entries(trace))
    return answer


def _datagram(text: Any) -> tuple[bytes, RecordedBytes]:
    try:
        data = base64.b64decode(text, validate=True)
    except (TypeError, ValueError):
        raise AnswerError(f"with a datagram that is not base64: {shown(text)}") from None
    if len(data) > MAX_UDP_BYTES:
        raise AnswerError(f"with a datagram of {len(data)} bytes, more than UDP carries")
    content: Datagram | None
    try:
        content = decode(data)
    except MalformedDatagramError:
        content = None
    return data, RecordedBytes(text, content)


def _entries(trace: list[Any]) -> Iterable[Entry]:
    """Yield the lines of a trace, except the header. The harness writes the header itself."""
    for number, line in enumerate(trace):
        if isinstance(line, dict) and "schema" in line:
            continue
        kind = HANDLER_RUN if isinstance(line, dict) and "handler" in line else ASIDE
        try:
            entry: Entry = kind.validate_python(line)
        except ValidationError as error:
            problem = error.errors()[0]
            where = ".".join(str(part) for part in problem["loc"])
            wrong = f": {where}: {problem['msg'].lower()}" if kind is HANDLER_RUN else ""
            raise AnswerError(f"with `trace.{number}`, which is not a line of a trace{wrong}: {shown(line)}") from None
        if isinstance(entry, HandlerRun) and entry.started and not all(map(math.isfinite, entry.started.values())):
            raise AnswerError(f"with `trace.{number}`, in which a timer never expires: {shown(line)}")
        yield entry


def shown(value: Any) -> str:
    """Return the beginning of a value that an agent wrote, for an error message."""
    text = value.decode(errors="replace").strip() if isinstance(value, bytes) else str(value)
    return repr(text[:SHOWN] + ("..." if len(text) > SHOWN else ""))


Outcome = Literal["crashed", "hung", "not supported"]


class AgentLacksError(UnsupportedError):
    """An error: an agent does not support the mission, or does not support virtual time."""

    outcome: Outcome = "not supported"

    def __init__(self, agent_id: int, command: Sequence[str], words: str) -> None:
        super().__init__(str(UnsupportedError.of(agent_id, command, words)))
        self.agent_id = agent_id
        self.detail = str(self)
