"""Find the places at which a trace contradicts itself because lines are lost or in the wrong order. Find the agents
that lack the trace of a whole incarnation.

A file from the field may have lost lines, and nothing marks their place. A correct agent then seems to do something
impossible, so the judge must know these places. Four kinds of contradiction prove that lines are lost:

- The sequence numbers of sent messages jump. The lost line comes after the last message before the jump.
- The time decreases from one line to the next.
- The trigger of a handler run is another handler, but this handler did not run since the last input.
- The state before a handler run differs from the state at the end of the previous line. The state before the run
  follows from the recorded state after it and from its changes.

If one kind of contradiction occurs often, the agent probably interprets the trace format differently. This kind of
contradiction then proves nothing.

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
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise

from harness.archive.exports import ExportedBlock
from harness.archive.traces import Trace
from harness.checker.evidence import Evidence
from harness.checker.records.contradiction import ROUNDED_S, mission_s
from ucp.trace import HandlerRun, RecordedBytes, StateSummary
from ucp.trigger import BootTrigger, LocalTrigger, MessageTrigger

MAX_PLACES, MAX_SHARE = 3, 0.1
"""Limits for each kind of contradiction: an absolute number of places, and a share of the lines that could show it. If
a kind exceeds both limits, the agent probably interprets the trace format differently, so this kind proves nothing.
"""


def lost_lines(trace: Trace) -> dict[int, str]:
    """Return the places at which lines of the trace seem to be lost, each with a reason such as "lines are missing
    ...". The key is the number of handler runs before the place, as in `Trace.gaps`. A lost line may explain why the
    handler run after the place seems to be wrong.
    """
    found: dict[int, str] = {}
    kinds = _ContradictionPlaces(), _ContradictionPlaces(), _ContradictionPlaces(), _ContradictionPlaces()
    known = {gap.position for gap in trace.gaps} | {*trace.jumps}
    bounds = [0, *trace.starts, len(trace.runs)]
    for start, end in pairwise(bounds):
        for kind, find in zip(kinds, (_jumps, _back_in_time, _without_trigger, _other_states), strict=True):
            find(trace.runs, start, end, known, kind)
    for kind in reversed(kinds):
        if kind.places <= max(MAX_PLACES, kind.possible * MAX_SHARE):
            found.update(kind.found)
    return found


class _ContradictionPlaces:
    """The places in a trace at which one kind of contradiction occurs."""

    def __init__(self) -> None:
        self.found: dict[int, str] = {}
        self.places = self.possible = 0
        """Number of places found so far, and number of trace lines at which the contradiction could have occurred."""


def _jumps(runs: Sequence[HandlerRun], start: int, end: int, known: set[int], kind: _ContradictionPlaces) -> None:
    expected: int | None = 0
    sent_at = start
    for position in range(start, end):
        run = runs[position]
        if position in known:
            expected = None
        if not run.sent:
            continue
        first = run.sent[0].seq
        kind.possible += 1
        if expected is not None and expected != first:
            kind.places += 1
            why = f"lines are missing (no line has its message{_numbers(expected, first - 1)})"
            if first < expected:
                why = f"lines are in the wrong order (its message {first} comes after message {expected - 1})"
            kind.found.update(dict.fromkeys(range(sent_at, position + 1), why))
        expected, sent_at = run.sent[-1].seq + 1, position + 1


def _back_in_time(
    runs: Sequence[HandlerRun], start: int, end: int, known: set[int], kind: _ContradictionPlaces
) -> None:
    for position in range(start + 1, end):
        kind.possible += 1
        if runs[position].t < runs[position - 1].t and position not in known:
            kind.places += 1
            kind.found[position] = f"lines are in the wrong order (the time goes back to {runs[position].t:g} s)"


def _without_trigger(
    runs: Sequence[HandlerRun], start: int, end: int, known: set[int], kind: _ContradictionPlaces
) -> None:
    ran: set[str] = set()
    for position in range(start, end):
        run = runs[position]
        if not isinstance(run.trigger, LocalTrigger):
            ran = {run.handler}
            continue
        kind.possible += 1
        if run.trigger.handler not in ran and position not in known:
            kind.places += 1
            kind.found[position] = f"lines are missing (no line has the {run.trigger.handler[:60]} that triggered it)"
        ran.add(run.handler)
        ran.add(run.trigger.handler)


def _other_states(
    runs: Sequence[HandlerRun], start: int, end: int, known: set[int], kind: _ContradictionPlaces
) -> None:
    before = StateSummary(0, 0, 0, reconciling=False, idle=True, top="")
    for position in range(start, end):
        run = runs[position]
        kind.possible += 1
        is_compared = position not in known and not isinstance(run.trigger, BootTrigger)
        if is_compared and (words := " and ".join(_differing(before, run))):
            kind.places += 1
            kind.found[position] = f"lines are missing (no line changed {words})"
        before = run.state


def _differing(before: StateSummary, run: HandlerRun) -> Iterator[str]:
    """Yield a phrase for each part of the state that changed between the end of one trace line and the start of the
    next handler run.
    """
    added = dict.fromkeys(("chain", "deque", "stack"), 0)
    for operation, _ in run.changes:
        if operation[:-1] in added:
            added[operation[:-1]] += 1 if operation.endswith("+") else -1
    state = run.state
    for place, ours, theirs in (
        ("chain", before.chain, state.chain),
        ("deque", before.deque, state.deque),
        ("stack", before.stack, state.stack),
    ):
        if ours + added[place] != theirs:
            yield f"the {place} from {ours} to {theirs - added[place]} blocks"
    if (
        before.top
        and before.top != state.top
        and not any(operation.startswith("chain") for operation, _ in run.changes)
    ):
        yield f"the top chain hash to {state.top[:12]}"


def _numbers(first: int, last: int) -> str:
    return f" {first}" if first == last else f"s {first} to {last}"


def lacking_traces(traces: Mapping[int, Trace]) -> Iterator[tuple[int, str]]:
    """Yield each agent whose trace seems complete but lacks lines or an incarnation, with the reason."""
    for agent_id, trace in traces.items():
        if not trace.problem and (why := _boots_from_unknown(trace)):
            yield agent_id, why
    yield from _unsent(traces)


def _boots_from_unknown(trace: Trace) -> str | None:
    """Return a reason if the agent restarted from a disk whose content no recorded incarnation wrote. Return None
    otherwise. An incarnation is the time between two restarts.
    """
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
    """Return true if the agent was running at this timestamp of its clock, according to its trace."""
    at_s = mission_s(timestamp_us, trace.header)
    if at_s is None:
        return False
    for start, end in pairwise([0, *trace.starts, len(trace.runs)]):
        runs = trace.runs[start:end]
        if runs and runs[0].t - ROUNDED_S <= at_s <= runs[-1].t + ROUNDED_S:
            return True
    return False


def may_be_of_missing_incarnation(evidence: Evidence, block: ExportedBlock) -> bool:
    """Return true if no record covers the time at which the author of the block may have completed the block.

    Only run.json lists all restarts of an agent. Without run.json, the trace of an agent shows the times at which the
    agent ran, and an export lists only the blocks that the agent completed since its last restart.
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
