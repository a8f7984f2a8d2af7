"""What came of playing a record, for programs."""

from collections import Counter
from typing import Any, Literal

from harness.checker.steps.deviation import Deviation
from harness.field.replay.names import Names
from harness.field.replay.player import Found
from harness.field.replay.record import Record
from harness.field.replay.source import source_of
from ucp.agent import HANDLERS

MAX_DIFFERENCES = 1000
"""More of one record are counted."""

Verdict = Literal["as specified", "deviates", "not judged"]


def verdict(found: Found) -> Verdict:
    """What it comes to; what could not be judged is never as specified."""
    if found.deviations:
        return "deviates"
    return "as specified" if found.steps else "not judged"


def document(record: Record, found: Found, names: Names) -> dict[str, Any]:
    """`steps` were compared, `unjudged` could not be; `differences` are in the order of the record."""
    deviations = sorted(found.deviations, key=lambda deviation: deviation.line)
    return {
        "record": str(record.path),
        "agent_id": record.agent_id,
        "verdict": verdict(found),
        "steps": found.steps,
        "unjudged": found.unjudged,
        "unjudged_because": found.lost,
        "problems": record.problems,
        "differences": [difference(deviation, names) for deviation in deviations[:MAX_DIFFERENCES]],
        "differences_in_all": len(deviations),
        "by_handler": dict(Counter(deviation.handler or "" for deviation in deviations).most_common()),
    }


def difference(deviation: Deviation, names: Names) -> dict[str, Any]:
    """`handler`, `algorithm` and `source` are None where no handler of the protocol is to blame."""
    handler = HANDLERS.get(deviation.handler or "")
    return {
        "line": deviation.line,
        "t": deviation.t,
        "algorithm": handler and handler.algorithm,
        "handler": handler and handler.name,
        "source": handler and source_of(handler.name),
        "difference": deviation.difference(names.of),
    }
