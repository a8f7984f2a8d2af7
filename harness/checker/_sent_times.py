"""Compute the mission second at which an agent sent a message that its trace contains.

A trace contains the time of the handler run. With the setting `answer_spread_s`, the agent sends an answer later, after
a wait that CONTRACT.md defines. This module computes the wait independently, because an error of the agent under test
must not affect the check.
"""

from base64 import b64decode
from binascii import Error
from hashlib import sha256

from harness.archive.traces import Trace
from ucp.trace import HandlerRun, SentMessage

ANSWERS = frozenset(
    ("Block Add Response", "Chain Contain Response", "Next in Sequence Response", "Block Response"),
)


def spread_of(trace: Trace) -> float:
    """Return the maximum delay of the agent's answers (setting `answer_spread_s`) in mission seconds. Return 0 if the
    trace header has no valid value.
    """
    spread_s = trace.header.settings.get("answer_spread_s", 0.0)
    return float(spread_s) if isinstance(spread_s, int | float) and spread_s > 0 else 0.0


def sent_at(run: HandlerRun, message: SentMessage, spread_s: float) -> float:
    """Return the mission second at which the agent sent this message, which it produced in this handler run."""
    if not spread_s or message.message not in ANSWERS or message.datagram is None:
        return run.t
    try:
        datagram = b64decode(message.datagram.text, validate=True)
    except (Error, ValueError):
        return run.t
    return run.t + spread_s * (int.from_bytes(sha256(datagram).digest()[:8], "big") / 2**64)
