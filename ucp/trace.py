"""What an agent tells about itself: one record for every handler run, written as one line of JSON.

`changes` is complete: whoever replays it has the contents of chain, deque and reconcile stack after every step.
"""

import json
from dataclasses import dataclass
from typing import Any

SCHEMA = "ucp-trace/1"

_encode = json.JSONEncoder(separators=(",", ":"), check_circular=False).encode


@dataclass(slots=True)
class Sent:
    """A message broadcast; `block` is the hash of the block that it is about, if it is about one."""

    message: str
    seq: int
    block: str | None = None


@dataclass(slots=True)
class State:
    """What an agent holds: lengths of chain, deque and reconcile stack, flags, and the top chain hash."""

    chain: int
    deque: int
    stack: int
    reconciling: bool
    idle: bool
    top: str


@dataclass(slots=True)
class HandlerRun:
    """One run of one of the 20 handlers.

    t: mission seconds.
    trigger: {"event": id}, {"message": name, "from": agent, "seq": n}, {"timer": name}, {"local": handler},
        {"operator": command}, or {"boot": blocks in the chain that was found on disk}.
    changes: (operation, block hash); operations are `complete`, and `chain`, `deque`, `stack` with + or -.
    state: what holds after the run.
    """

    t: float
    handler: str
    algorithm: int
    trigger: dict[str, int | str]
    branch: str
    changes: list[tuple[str, str]]
    sent: list[Sent]
    state: State

    def to_line(self) -> str:
        state = self.state
        record = {
            "t": round(self.t, 6),
            "handler": self.handler,
            "algorithm": self.algorithm,
            "trigger": self.trigger,
            "branch": self.branch,
            "changes": self.changes,
            "sent": [{"message": sent.message, "seq": sent.seq, "block": sent.block} for sent in self.sent],
            "state": {
                "chain": state.chain,
                "deque": state.deque,
                "stack": state.stack,
                "reconciling": state.reconciling,
                "idle": state.idle,
                "top": state.top,
            },
        }
        return _encode(record) + "\n"


def header_line(agent_id: int, roster: list[int], settings: dict[str, Any], clock: dict[str, Any]) -> str:
    """The first line of a trace: which agent, in which mission, with which settings and clock."""
    header = {"schema": SCHEMA, "agent_id": agent_id, "roster": roster, "settings": settings, "clock": clock}
    return _encode(header) + "\n"
