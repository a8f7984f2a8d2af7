"""Find the agents that lack the trace of a whole incarnation. The evidence is in their own traces and in the traces of
other agents.

An incarnation is the time between two restarts. A vehicle that restarted may return without the trace of one
incarnation. The other parts of its trace then look complete, and the agent seems not to have sent messages and not to
have completed blocks in that time. Three facts prove that an incarnation is missing:

- The trace begins with a boot, or the agent boots from a disk with completed blocks that no earlier trace line
  contains.
- Another agent received a message of this agent, and no line of this agent contains the message with this content. The
  sequence number alone proves nothing, because every incarnation numbers its messages from 0.
- A block of the agent has a timestamp outside all recorded incarnations.

The third fact concerns a single block. The function `was_running` checks it for the timestamp of this block.
"""

from bisect import bisect_left
from collections import defaultdict
from collections.abc import Iterator, Mapping
from itertools import pairwise

from harness.archive.exports import ExportedBlock
from harness.archive.traces import Trace
from harness.checker.evidence import Evidence
from harness.checker.records.contradiction import ROUNDED_S, mission_s
from ucp.trace import RecordedBytes
from ucp.trigger import BootTrigger, MessageTrigger


def lacking_traces(traces: Mapping[int, Trace]) -> Iterator[tuple[int, str]]:
    """Yield each agent whose trace seems complete but lacks lines or an incarnation, with the reason."""
    for agent_id, trace in traces.items():
        if not trace.problem and (why := _boots_from_unknown(trace)):
            yield agent_id, why
    yield from _unsent(traces)


def _boots_from_unknown(trace: Trace) -> str | None:
    """Return a reason if the agent booted from a disk that an unrecorded incarnation wrote. Return None otherwise."""
    completed: set[str] = set()
    for start, end in pairwise([0, *trace.starts, len(trace.runs)]):
        runs = trace.runs[start:end]
        if runs and isinstance(runs[0].trigger, BootTrigger):
            stored = [block for operation, block in runs[0].changes if operation == "complete"]
            if not start or not completed.issuperset(stored):
                return f"an incarnation is missing, from whose disk the agent booted at t={runs[0].t:g} s"
        completed.update(block for run in runs for operation, block in run.changes if operation == "complete")
    return None


def _unsent(traces: Mapping[int, Trace]) -> Iterator[tuple[int, str]]:
    """Yield each agent whose trace lacks a message that another agent received from it, with the reason."""
    sent: dict[int, dict[tuple[str, int], list[RecordedBytes | None]]] = {}
    for agent_id, trace in traces.items():
        sent[agent_id] = defaultdict(list)
        for run in trace.runs:
            for message in run.sent:
                sent[agent_id][message.message, message.seq].append(message.datagram)
    lacking: set[int] = set()
    for receiver, trace in traces.items():
        for run in trace.runs:
            trigger = run.trigger
            if not isinstance(trigger, MessageTrigger) or trigger.sender not in traces or trigger.sender in lacking:
                continue
            datagrams = sent[trigger.sender].get((trigger.message, trigger.sequence), ())
            if None in datagrams or (datagrams and run.input is None) or run.input in datagrams:
                continue
            lacking.add(trigger.sender)
            named = f"{trigger.message[:60]} {trigger.sequence}"
            yield (
                trigger.sender,
                f"it does not have the {named} that agent {receiver} received at t={run.t:g} s, so lines or an "
                "incarnation are missing, or another sender used its name",
            )


def was_running(trace: Trace, timestamp_us: int) -> bool:
    """Return true if a recorded incarnation of the agent was running at this timestamp of the agent's clock."""
    at_s = mission_s(timestamp_us, trace.header)
    if at_s is None:
        return False
    for start, end in pairwise([0, *trace.starts, len(trace.runs)]):
        runs = trace.runs[start:end]
        if runs and runs[0].t - ROUNDED_S <= at_s <= runs[-1].t + ROUNDED_S:
            return True
    return False


def may_be_of_missing_incarnation(evidence: Evidence, block: ExportedBlock) -> bool:
    """Return true if the author of the block may have completed it in an unrecorded incarnation.

    Only run.json lists all incarnations. Without it, the trace of an agent shows the times of its incarnations, and an
    export lists only the blocks of the last incarnation.
    """
    if evidence.record is not None:
        return False
    trace, export = evidence.traces.get(block.agent_id), evidence.exports.get(block.agent_id)
    if trace is not None:
        return bool(trace.problem) or not was_running(trace, block.timestamp_us)
    if export is None:
        return True
    completed = {*export.completed}
    times = sorted(held.timestamp_us for held in export.blocks() if held.block_hash in completed)
    return bisect_left(times, block.timestamp_us) == 0
