"""Find the places at which a trace contradicts itself because lines are lost or in the wrong order.

A file from the field may have lost lines, and nothing marks their place. A correct agent then seems to do something
impossible, so the judge must know these places. Four kinds of contradiction prove that lines are lost:

- The sequence numbers of sent messages jump. The lost line comes after the last message before the jump.
- The time decreases from one line to the next.
- The trigger of a handler run is another handler, but this handler did not run since the last input.
- The state before a handler run differs from the state at the end of the previous line. The state before the run
  follows from the recorded state after it and from its changes.

If one kind of contradiction occurs often, the agent probably interprets the trace format differently. This kind of
contradiction then proves nothing.
"""

from collections.abc import Iterator, Sequence
from itertools import pairwise

from harness.archive.traces import Trace
from ucp.trace import HandlerRun, StateSummary
from ucp.trigger import BootTrigger, LocalTrigger

MAX_PLACES, MAX_SHARE = 3, 0.1
"""Limits for each kind of contradiction: the number of places, and the share of the lines that could show the
contradiction. If both limits are exceeded, the agent probably interprets the trace format differently.
"""


def lost_lines(trace: Trace) -> dict[int, str]:
    """Return the handler runs whose errors a lost line may explain, each with a reason such as "lines are missing ...".
    The key is the number of earlier handler runs, as in `Trace.gaps`.
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
        """Number of places, and number of trace lines at which the contradiction could occur."""


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
