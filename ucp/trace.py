"""What an agent tells about itself: one record for every handler run, written as one line of JSON.

`changes` is complete: whoever replays it has the contents of chain, deque and reconcile stack after every step.
"""

import json
from dataclasses import dataclass
from typing import Any

SCHEMA = "ucp-trace/1"


@dataclass(slots=True)
class HandlerRun:
    """One run of one of the 20 handlers.

    t: mission seconds.
    trigger: {"event": id}, {"message": name, "from": agent, "seq": n}, {"timer": name}, {"local": handler} or
        {"operator": command}.
    changes: [operation, block hash] pairs; operations are `complete`, and `chain`, `deque`, `stack` with + or -.
    sent: {"message": name, "seq": n, "block": hash or null} for every message broadcast.
    state: what holds after the run: lengths, flags, and the top chain hash.
    """

    t: float
    handler: str
    algorithm: int
    trigger: dict[str, Any]
    branch: str
    changes: list[tuple[str, str]]
    sent: list[dict[str, Any]]
    state: dict[str, Any]

    def to_line(self) -> str:
        record = {
            "t": round(self.t, 6),
            "handler": self.handler,
            "algorithm": self.algorithm,
            "trigger": self.trigger,
            "branch": self.branch,
            "changes": self.changes,
            "sent": self.sent,
            "state": self.state,
        }
        return json.dumps(record, separators=(",", ":")) + "\n"


def header_line(agent_id: int, roster: list[int], settings: dict[str, Any], clock: dict[str, Any]) -> str:
    """The first line of a trace: which agent, in which mission, with which settings and clock."""
    header = {"schema": SCHEMA, "agent_id": agent_id, "roster": roster, "settings": settings, "clock": clock}
    return json.dumps(header, separators=(",", ":")) + "\n"
