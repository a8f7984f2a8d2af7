"""What run.json says of the network and of faults against network.jsonl, where each was taken down as it was made.

Of what flight changes run.json has only what changed who is connected to whom.
"""

from collections.abc import Iterator

from harness.archive.record import Fault, NetworkState
from harness.checker.evidence import Condition, Evidence
from harness.checker.records.contradiction import Contradiction, of_agent
from harness.scenario.changes import NO_MORE_FATES, RANGE

Change = tuple[float, str, str | None, bool | None]


def compare(evidence: Evidence) -> Iterator[Contradiction]:
    record, log = evidence.record, evidence.conditions
    if record is None or log is None or record.mission_s is None:
        return
    # While fates are scripted nobody counts as connected, whatever the conditions.
    fated_until = max((state.at_s for state in record.network if state.what == NO_MORE_FATES), default=0.0)

    def key(change: NetworkState | Fault | Condition) -> Change:
        connected = None if change.at_s < fated_until else change.fully_connected
        return change.at_s, change.what, change.detail, connected

    said = {key(state): min(record.roster) for state in record.network if state.what != NO_MORE_FATES}
    said |= {key(fault): min(fault.agents) for fault in record.faults if fault.agents}
    taken_down = {key(change) for change in log}
    for change, agent_id in said.items():
        if change not in taken_down:
            yield of_agent(agent_id, f"run.json says, and network.jsonl does not: {_in_words(change)}")
    for condition in log:
        if condition.detail is not None and condition.what != RANGE and key(condition) not in said:
            detail = f"network.jsonl says, and run.json does not: {_in_words(key(condition))}"
            yield of_agent(min(record.roster), detail)


def _in_words(change: Change) -> str:
    at_s, what, detail, connected = change
    known = "" if connected is None else f", all connected: {'yes' if connected else 'no'}"
    return f"{what} at {at_s:g} s, {detail}{known}"
