"""Combine several copies of the same trace. One copy may contain lines that another copy has lost."""

from collections.abc import Iterator

from harness.field.ingest._file_owners import is_incarnation_copy
from harness.field.ingest._ingest import UnusedPart
from harness.field.ingest._trace_incarnations import TraceIncarnation, jumps_in
from ucp.trace import HandlerRun


def split_into_flights(
    incarnations: list[TraceIncarnation], left_out: list[UnusedPart]
) -> Iterator[list[TraceIncarnation]]:
    """Group traces of one agent that have the same header. Yield groups whose traces belong to the same flight.

    Successive incarnations belong to the same flight. Overlapping incarnations belong to different flights. Copies are
    combined into one trace.
    """
    flights: list[list[TraceIncarnation]] = []
    for incarnation in sorted(incarnations, key=_quality, reverse=True):
        other_copy = next((other for flight in flights for other in flight if _is_copy(incarnation, other)), None)
        if other_copy is not None:
            added_runs = _fill_gaps(other_copy, incarnation) if incarnation.runs else 0
            if added_runs or (
                (incarnation.runs or incarnation.path != other_copy.path) and not is_incarnation_copy(incarnation.path)
            ):
                left_out.append(
                    UnusedPart(
                        incarnation.path,
                        _describe_copy(incarnation, other_copy, added_runs),
                        incarnation.first_line,
                        incarnation.counts,
                    )
                )
            continue
        fitting_flight = next(
            (flight for flight in flights if not any(_overlap(incarnation, other) for other in flight)), None
        )
        if fitting_flight is None:
            flights.append([incarnation])
        else:
            fitting_flight.append(incarnation)
    order = {id(incarnation): number for number, incarnation in enumerate(incarnations)}
    for flight in flights:
        if len({incarnation.path for incarnation in flight}) > 1:
            flight.sort(
                key=lambda incarnation: (incarnation.runs[0].t if incarnation.runs else 0.0, order[id(incarnation)])
            )
        else:
            flight.sort(key=lambda incarnation: order[id(incarnation)])
        yield flight


def _quality(incarnation: TraceIncarnation) -> tuple[bool, int, int]:
    """Return a sort key that puts the best copy of a trace first. Copies without clock jumps come first, then longer
    copies, then copies with fewer gaps.
    """
    return not incarnation.jumps, len(incarnation.runs), -len(incarnation.gaps)


def _key(run: HandlerRun) -> tuple[object, ...]:
    """Return a key that identifies a handler run within a trace."""
    return round(run.t, 3), run.handler, run.trigger, run.branch, run.state.chain, run.state.top


def _is_copy(incarnation: TraceIncarnation, other: TraceIncarnation) -> bool:
    """Return true if most handler runs of one trace also occur in the other trace."""
    if not incarnation.runs:
        return not other.runs and incarnation.path != other.path
    if incarnation.runs == other.runs[: len(incarnation.runs)]:
        return True
    if not _overlap(incarnation, other, anywhere=True):
        return False
    known = set(map(_key, other.runs))
    return 2 * sum(_key(run) in known for run in incarnation.runs) > min(len(incarnation.runs), len(other.runs))


def _overlap(incarnation: TraceIncarnation, other: TraceIncarnation, *, anywhere: bool = False) -> bool:
    """Return true if the times of two traces overlap. Two overlapping traces of one agent cannot belong to the same
    flight. Two incarnations in the same file follow each other, so the function returns false for them, unless
    `anywhere` is true.
    """
    if (incarnation.path == other.path and not anywhere) or not incarnation.runs or not other.runs:
        return False
    return incarnation.runs[0].t < other.runs[-1].t and other.runs[0].t < incarnation.runs[-1].t


def _fill_gaps(incarnation: TraceIncarnation, copy: TraceIncarnation) -> int:
    """Insert handler runs that are missing in the trace `incarnation` and that its copy contains. Return the number of
    inserted handler runs.
    """
    where = {_key(run): position for position, run in enumerate(copy.runs)}
    broken = {gap.position for gap in copy.gaps}
    added_runs = 0
    for gap in reversed(incarnation.gaps):
        position = gap.position
        before = where.get(_key(incarnation.runs[position - 1])) if position else -1
        after = where.get(_key(incarnation.runs[position])) if position < len(incarnation.runs) else None
        if before is None or after is None or broken & {*range(before + 1, after + 1)} or before >= after:
            continue
        incarnation.gaps.remove(gap)
        added_runs += _insert(incarnation, position, copy, before + 1, after)
    last = where.get(_key(incarnation.runs[-1])) if incarnation.runs else None
    if last is not None and last + 1 < len(copy.runs):
        at = len(incarnation.runs)
        added_runs += _insert(incarnation, at, copy, last + 1, len(copy.runs))
        behind = [gap._replace(position=gap.position - last - 1 + at) for gap in copy.gaps if gap.position > last]
        incarnation.gaps = [gap for gap in incarnation.gaps if gap.position < at] + behind
        incarnation.cut_off = copy.cut_off
    if added_runs:
        incarnation.jumps = jumps_in(incarnation.runs)
    return added_runs


def _insert(incarnation: TraceIncarnation, position: int, copy: TraceIncarnation, start: int, end: int) -> int:
    count = end - start
    incarnation.runs[position:position] = copy.runs[start:end]
    incarnation.run_lines[position:position] = copy.run_lines[start:end]
    incarnation.gaps = [
        gap._replace(position=gap.position + count * (gap.position > position)) for gap in incarnation.gaps
    ]
    asides_here = [aside for at, aside in incarnation.asides if at == position]
    asides = [((at + count * (at > position), aside), line) for (at, aside), line in incarnation.numbered_asides()]
    asides += [
        ((at - start + position, aside), line)
        for (at, aside), line in copy.numbered_asides()
        if start <= at <= end and aside not in asides_here
    ]
    asides.sort(key=lambda numbered: numbered[0][0])
    incarnation.asides, incarnation.aside_lines = [aside for aside, _ in asides], [line for _, line in asides]
    return count


def _describe_copy(incarnation: TraceIncarnation, other_copy: TraceIncarnation, added_runs: int) -> str:
    where = "also in this file" if incarnation.path == other_copy.path else f"in {other_copy.path}"
    used = (
        f"{added_runs} handler runs that are lost there are read from here"
        if added_runs
        else "the lines there are used"
    )
    return f"the records from here on are {where}, from {other_copy.counts} {other_copy.first_line} on; {used}"
