"""Compare the network changes and faults in run.json with those in network.jsonl.

Moving vehicles also change the network. Of these changes, run.json contains only those that change which vehicles are
connected.
"""

from collections import Counter
from collections.abc import Iterator
from itertools import pairwise

from harness.archive.run_record import FaultRecord, NetworkState
from harness.checker.evidence import Evidence, NetworkLogEntry
from harness.checker.records.contradiction import Contradiction, of_agent
from harness.scenario.changes import NO_MORE_FATES, RANGE

Change = tuple[float, str, str | None, bool | None, tuple[int, ...], str | None, float | None]


def compare(evidence: Evidence) -> Iterator[Contradiction]:
    """Yield each network change or fault that only one of the two files contains. Also yield each time that is earlier
    than the time before it.
    """
    record, log = evidence.record, evidence.conditions
    if record is None or log is None or record.mission_s is None:
        return
    of_all = min(record.roster, default=0)
    # While fates are scripted, the network does not count as fully connected.
    fated_until = max((state.at_s for state in record.network if state.what == NO_MORE_FATES), default=0.0)
    network = [state for state in record.network if state.what != NO_MORE_FATES]
    faults = [fault for fault in record.faults if fault.agents]
    recorded = Counter(_change(state, fated_until) for state in network)
    recorded.update(_change(fault, fated_until) for fault in faults)
    taken_down = Counter(_change(condition, fated_until) for condition in log if condition.detail is not None)
    for change in recorded - taken_down:
        yield of_agent(min(change[4], default=of_all), f"only run.json has: {_in_words(change)}")
    for change in taken_down - recorded:
        if change[1] != RANGE:
            detail = f"only network.jsonl has: {_in_words(change)}"
            yield of_agent(min(change[4], default=of_all), detail)
    for fault in record.faults:
        if fault.fully_connected is not None and not taken_down[_change(fault, fated_until)]:
            detail = f"the faults of run.json imply, but network.jsonl lacks: {_in_words(_change(fault, fated_until))}"
            yield of_agent(of_all, detail)
    if any(condition.counters not in (None, record.counters) for condition in log):
        yield of_agent(of_all, "run.json and network.jsonl have different counters of the kernel")
    for name, times_s in (
        ("network.jsonl", [condition.at_s for condition in log]),
        ("the network of run.json", [state.at_s for state in record.network]),
    ):
        for earlier, later in pairwise(times_s):
            if later < earlier:
                yield of_agent(of_all, f"{name} goes from {earlier:g} s back to {later:g} s")


def _change(entry: NetworkState | FaultRecord | NetworkLogEntry, fated_until: float) -> Change:
    connected = None if entry.at_s < fated_until else entry.fully_connected
    if isinstance(entry, NetworkState):
        return entry.at_s, entry.what, entry.detail, connected, (), None, entry.planned_s
    return entry.at_s, entry.what, entry.detail, connected, tuple(entry.agents or ()), entry.disk, entry.planned_s


def _in_words(change: Change) -> str:
    at_s, what, detail, connected, *_ = change
    known = "" if connected is None else f", all connected: {'yes' if connected else 'no'}"
    return f"{what} at {at_s:g} s, {detail}{known}"
