"""The number of a handler's Algorithm against its name: a trace says both, and one tells the other."""

from collections.abc import Iterator

from harness.checker.evidence import Evidence
from harness.checker.records.contradiction import Contradiction, of_agent
from ucp.agent import HANDLERS

ALGORITHM = {name: handler.algorithm for name, handler in HANDLERS.items()}


def compare(evidence: Evidence) -> Iterator[Contradiction]:
    """A handler that is known has its number. What it did is judged by its name."""
    for agent_id, trace in evidence.traces.items():
        said = dict.fromkeys((run.handler, run.algorithm) for run in trace.runs)
        for handler, number in said:
            if handler in ALGORITHM and number != ALGORITHM[handler]:
                detail = f"its trace has {handler} as Algorithm {number}, and that is Algorithm {ALGORITHM[handler]}"
                yield of_agent(agent_id, detail)
