"""Repair the order of lines in a damaged trace, in which lines were swapped or occur twice.

A line is moved or removed only if its place is impossible. This is so if the time decreases for one line, if a handler
run comes before the run that triggered it, or if a recorded effect happens twice.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from ucp.trace import HandlerRun
from ucp.trigger import LocalTrigger, MessageTrigger

MAX_REPEATED = 10_000
"""Maximum number of lines in a part of a trace that occurs twice."""


@dataclass(frozen=True, slots=True)
class ReorderedPart:
    """A part of a trace that was repaired."""

    first: int
    """The position of the first handler run of this part, in the order before the repair."""
    last: int
    """The position of the last handler run of this part, in the order before the repair."""
    why: str
    """The reason for the repair."""


def in_order(runs: Sequence[HandlerRun]) -> tuple[list[int], list[ReorderedPart]]:
    """Return the positions of the handler runs to keep, in the correct order, and the repaired parts of the trace."""
    places = [*_repeated(runs)]
    repeated = {position for place in places for position in range(place.first, place.last + 1)}
    order = [position for position in range(len(runs)) if position not in repeated]
    number = 0
    while number < len(order) - 1:
        if _are_swapped(runs, order, number):
            first, second = order[number : number + 2]
            order[number : number + 2] = second, first
            places.append(
                ReorderedPart(first, second, "these lines are in the wrong order; they are read in the right one")
            )
            number += 1
        number += 1
    return order, sorted(places, key=lambda place: place.first)


def _repeated(runs: Sequence[HandlerRun]) -> Iterator[ReorderedPart]:
    """Yield each part of the trace that repeats the part directly before it."""
    last_at: dict[tuple[object, ...], int] = {}
    position = 0
    while position < len(runs):
        run = runs[position]
        key = run.t, run.handler, repr(run.trigger), run.branch
        before = last_at.get(key)
        if before is not None and position - before <= MAX_REPEATED and runs[before] == run:
            length = position - before
            part = runs[position : position + length]
            if all(ours == theirs for ours, theirs in zip(part, runs[before:position], strict=False)) and (
                len(part) == length
                and (_happens_once(part) or runs[position - 1].t > run.t or _triggers_next(runs, position + length))
            ):
                yield ReorderedPart(position, position + length - 1, "these lines are there twice; they are read once")
                position += length
                continue
        last_at[key] = position
        position += 1


def _happens_once(part: Sequence[HandlerRun]) -> bool:
    """Return true if these handler runs had an effect that an agent cannot repeat."""
    return any(
        run.changes or run.sent or run.tally or run.started or not isinstance(run.trigger, MessageTrigger)
        for run in part
    )


def _triggers_next(runs: Sequence[HandlerRun], position: int) -> bool:
    """Return true if the handler run before this position triggered the handler run at this position."""
    if position >= len(runs):
        return False
    trigger = runs[position].trigger
    return isinstance(trigger, LocalTrigger) and trigger.handler == runs[position - 1].handler


def _are_swapped(runs: Sequence[HandlerRun], order: Sequence[int], number: int) -> bool:
    """Return true if the handler run at position `number` and the next handler run are in the wrong order."""
    first, second = runs[order[number]], runs[order[number + 1]]
    before_s = runs[order[number - 1]].t if number else 0.0
    if second.t < first.t:
        after_s = runs[order[number + 2]].t if number + 2 < len(order) else first.t
        return before_s <= second.t and first.t <= after_s
    if second.t > first.t:
        return False
    if first.sent and second.sent:
        return second.sent[-1].seq + 1 == first.sent[0].seq
    return isinstance(first.trigger, LocalTrigger) and _is_triggered_later(runs, order, number)


def _is_triggered_later(runs: Sequence[HandlerRun], order: Sequence[int], number: int) -> bool:
    """Return true if the handler that triggered this run appears only after it in the trace."""
    trigger = runs[order[number]].trigger
    assert isinstance(trigger, LocalTrigger)
    for position in reversed(order[:number]):
        if runs[position].handler == trigger.handler:
            return False
        if not isinstance(runs[position].trigger, LocalTrigger):
            break
    return runs[order[number + 1]].handler == trigger.handler
