"""The headers of all traces against each other and the run's record: one mission has one roster and one clock."""

from collections.abc import Iterator

from harness.checker.evidence import Evidence
from harness.checker.records.contradiction import Contradiction, of_agent

CLOCK = {"epoch_us": "mission second 0", "speedup": "speedup"}


def compare(evidence: Evidence) -> Iterator[Contradiction]:
    first: dict[str, tuple[object, str]] = {}
    if evidence.record is not None:
        first["roster"] = sorted(evidence.record.roster), "run.json"
    for agent_id, trace in evidence.traces.items():
        header = trace.header
        told: dict[str, object] = {"roster": sorted(header.roster)}
        told |= {f"settings.{name}": value for name, value in header.settings.items()}
        told |= {name: header.clock.get(name) for name in CLOCK}
        for name, value in told.items():
            common, source = first.setdefault(name, (value, f"the trace of agent {agent_id}"))
            if value != common:
                what = CLOCK.get(name, name)
                yield of_agent(agent_id, f"its trace begins with {what} {value}, and {source} with {common}")
