"""The trace of an agent. It has a line of JSON for each handler run, and for each input that runs no handler.

A trace contains all inputs completely, so the run of the agent can be repeated from its trace. The only exceptions are
dropped datagrams above a quota, which are only counted (`ucp._drop_quota`). `changes` lists all changes of a step. A
reader that applies the changes knows the contents of chain, deque and reconcile stack after each step.

In a line, datagrams, events and stores are encoded in base64. In memory they are encoded only when their text is
needed.
"""

import base64
import json
from typing import Any, Protocol

from ucp._dataclass import dataclass
from ucp.messages import Datagram, Message, block_named
from ucp.trigger import Trigger

SCHEMA = "ucp-trace/2"

_encode = json.JSONEncoder(separators=(",", ":"), check_circular=False).encode

Tally = dict[str, int | list[int]]


class Encodable(Protocol):
    """A protocol: an object that can be converted to bytes, such as a datagram, an event or a store."""

    def encode(self) -> bytes: ...


class RecordedBytes:
    """Recorded bytes. `text` is their base64 form. `content` is the decoded object, or None if the bytes were read from
    a file.

    Sender and receivers of a datagram share one object.
    """

    __slots__ = ("_text", "content")

    def __init__(self, text: str | None = None, content: Encodable | None = None) -> None:
        """Create the object from base64 text or from a decoded object. One of the two arguments may be None."""
        self._text = text
        self.content = content

    @property
    def text(self) -> str:
        if self._text is None:
            assert self.content is not None, "a record has a text or a content"
            self._text = in_base64(self.content.encode())
        return self._text

    def keep_only_text(self) -> None:
        """Forget the decoded object, so that later changes of this object do not change the record."""
        self._text = self.text
        self.content = None

    def __eq__(self, other: object) -> bool:
        if self is other:
            return True
        if not isinstance(other, RecordedBytes):
            return False
        if type(self.content) is type(other.content) is not type(None) and self.content == other.content:
            return True
        return self.text == other.text

    def __hash__(self) -> int:
        return hash(self.text)

    def __repr__(self) -> str:
        return f"Recorded({self.text!r})"

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: Any) -> dict[str, Any]:
        """Let pydantic parse this object from a string in a trace line."""
        made = {"type": "no-info", "function": cls}
        return {"type": "function-after", "function": made, "schema": handler(str)}


@dataclass(slots=True)
class SentMessage:
    """A sent message in a trace line. `block` is the hash of the block that the message concerns, or None.

    `datagram` is None in a trace of version 1, which does not contain datagrams.
    """

    message: str
    seq: int
    block: str | None = None
    datagram: RecordedBytes | None = None

    @classmethod
    def of(cls, sender: int, sequence: int, message: Message) -> "SentMessage":
        block_hash = block_named(message)
        datagram = RecordedBytes(None, Datagram(sender, sequence, message))
        return cls(message.NAME, sequence, block_hash.hex() if block_hash else None, datagram)


@dataclass(slots=True)
class StateSummary:
    """The summary of an agent's state in a trace line: numbers of blocks, flags, and the top chain hash."""

    chain: int
    deque: int
    stack: int
    reconciling: bool
    idle: bool
    top: str


@dataclass(slots=True)
class HandlerRun:
    """A run of one of the 20 handlers (Algorithms 1 to 20), as a trace records it.

    - `t`: mission seconds.
    - `trigger`: why the handler ran.
    - `changes`: (operation, block hash); operations are `complete`, and `chain`, `deque`, `stack` with + or -.
    - `state`: a summary of the state after the run.
    - `input`: the input of the handler. For a message: the received datagram. For an event: its encoding in a block.
      For a boot: the blocks from the disk in the order of `changes`, each after its length (u16).
    - `tally`: the counters of the handler after the run. Algorithms 12 and 14 have {block hash: [count, timestamp in
      microseconds]}, with "" for "Is Top Of Chain". Algorithm 15 has {block hash: count} of the chosen block. The other
      handlers have {"yes": n, "no": n}.
    - `started`: timer -> duration in mission seconds, of the timers that the run started.
    - `sealed`: sealed event data of a block that the run completed.
    """

    t: float
    handler: str
    algorithm: int
    trigger: Trigger
    branch: str
    changes: list[tuple[str, str]]
    sent: list[SentMessage]
    state: StateSummary
    input: RecordedBytes | None = None
    tally: Tally | None = None
    started: dict[str, float] | None = None
    sealed: RecordedBytes | None = None

    def to_line(self) -> str:
        state = self.state
        record = {
            "t": round(self.t, 6),
            "handler": self.handler,
            "algorithm": self.algorithm,
            "trigger": self.trigger.to_json(),
            "input": self.input and self.input.text,
            "branch": self.branch,
            "changes": self.changes,
            "sent": [
                {
                    "message": sent.message,
                    "seq": sent.seq,
                    "block": sent.block,
                    "datagram": sent.datagram and sent.datagram.text,
                }
                for sent in self.sent
            ],
            "tally": self.tally,
            "started": self.started,
            "sealed": self.sealed and self.sealed.text,
            "state": {
                "chain": state.chain,
                "deque": state.deque,
                "stack": state.stack,
                "reconciling": state.reconciling,
                "idle": state.idle,
                "top": state.top,
            },
        }
        for key in ("input", "tally", "started", "sealed"):
            if record[key] is None:
                del record[key]
        return _encode(record) + "\n"


@dataclass(slots=True)
class DroppedDatagram:
    """A trace line about a datagram that the agent dropped, with the reason.

    A line with a `count` stands for this number of datagrams. Its `datagram` is empty.
    """

    t: float
    dropped: str
    datagram: RecordedBytes
    count: int = 1

    def __post_init__(self) -> None:
        if self.count < 1:
            raise ValueError("count is at least 1")

    def to_line(self) -> str:
        record: dict[str, Any] = {"t": round(self.t, 6), "dropped": self.dropped, "datagram": self.datagram.text}
        return _encode(record if self.count == 1 else {**record, "count": self.count}) + "\n"


@dataclass(slots=True)
class CommandEntry:
    """A trace line about a command that triggers no handler, with its arguments."""

    t: float
    command: str
    request: dict[str, Any]

    def to_line(self) -> str:
        return _encode({"t": round(self.t, 6), "command": self.command, "request": self.request}) + "\n"


Entry = HandlerRun | DroppedDatagram | CommandEntry
"""The content of a line of a trace, except the header."""


def header_line(
    agent_id: int,
    roster: list[int],
    initial_data: bytes,
    settings: dict[str, Any],
    clock: dict[str, Any],
    secured: bool = False,
) -> str:
    """Return the first line of a trace. It contains the agent, the mission, the settings and the clock."""
    header = {
        "schema": SCHEMA,
        "agent_id": agent_id,
        "roster": roster,
        "initial_data": in_base64(initial_data),
        "settings": settings,
        "clock": clock,
        **({"secured": True} if secured else {}),
    }
    return _encode(header) + "\n"


def in_base64(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")
