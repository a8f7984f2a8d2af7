"""The same life of an agent in several files: what is lost of one copy may be left of another."""

from collections.abc import Iterator

from harness.field.ingest._file_search import is_of_a_life
from harness.field.ingest._ingest import LeftOut
from harness.field.ingest._trace_incarnations import Life, jumps_in
from ucp.trace import HandlerRun


def told_apart(lives: list[Life], left_out: list[LeftOut]) -> Iterator[list[Life]]:
    """The lives of one agent under one header: those that follow each other are of one flight, each once."""
    flights: list[list[Life]] = []
    for life in sorted(lives, key=_worth, reverse=True):
        twin = next((other for flight in flights for other in flight if _is_copy(life, other)), None)
        if twin is not None:
            taken = _mend(twin, life) if life.runs else 0
            if taken or ((life.runs or life.path != twin.path) and not is_of_a_life(life.path)):
                left_out.append(LeftOut(life.path, _of_copy(life, twin, taken), life.first_line, life.counts))
            continue
        room = next((flight for flight in flights if not any(_overlap(life, other) for other in flight)), None)
        if room is None:
            flights.append([life])
        else:
            room.append(life)
    order = {id(life): number for number, life in enumerate(lives)}
    for flight in flights:
        if len({life.path for life in flight}) > 1:
            flight.sort(key=lambda life: (life.runs[0].t if life.runs else 0.0, order[id(life)]))
        else:
            flight.sort(key=lambda life: order[id(life)])
        yield flight


def _worth(life: Life) -> tuple[bool, int, int]:
    """Of two copies the one to go by is in order, then longer, then whole."""
    return not life.jumps, len(life.runs), -len(life.gaps)


def _key(run: HandlerRun) -> tuple[object, ...]:
    """What tells one handler run of a life from all others."""
    return round(run.t, 3), run.handler, run.trigger, run.branch, run.state.chain, run.state.top


def _is_copy(life: Life, other: Life) -> bool:
    """Whether most of `life` is in the other, too."""
    if not life.runs:
        return not other.runs and life.path != other.path
    if life.runs == other.runs[: len(life.runs)]:
        return True
    if not _overlap(life, other, anywhere=True):
        return False
    known = set(map(_key, other.runs))
    return 2 * sum(_key(run) in known for run in life.runs) > min(len(life.runs), len(other.runs))


def _overlap(life: Life, other: Life, *, anywhere: bool = False) -> bool:
    """Whether both cannot be lives of one agent on one flight: neither ended before the other began.

    In one file, unless `anywhere` counts, a life ends where the next begins, whatever its clock says.
    """
    if (life.path == other.path and not anywhere) or not life.runs or not other.runs:
        return False
    return life.runs[0].t < other.runs[-1].t and other.runs[0].t < life.runs[-1].t


def _mend(life: Life, copy: Life) -> int:
    """Put what `life` has lost, and `copy` has not, where it was; how many handler runs that are."""
    where = {_key(run): position for position, run in enumerate(copy.runs)}
    broken = {gap.position for gap in copy.gaps}
    taken = 0
    for gap in reversed(life.gaps):
        position = gap.position
        before = where.get(_key(life.runs[position - 1])) if position else -1
        after = where.get(_key(life.runs[position])) if position < len(life.runs) else None
        if before is None or after is None or broken & {*range(before + 1, after + 1)} or before >= after:
            continue
        life.gaps.remove(gap)
        taken += _insert(life, position, copy, before + 1, after)
    last = where.get(_key(life.runs[-1])) if life.runs else None
    if last is not None and last + 1 < len(copy.runs):
        at = len(life.runs)
        taken += _insert(life, at, copy, last + 1, len(copy.runs))
        behind = [gap._replace(position=gap.position - last - 1 + at) for gap in copy.gaps if gap.position > last]
        life.gaps = [gap for gap in life.gaps if gap.position < at] + behind
        life.cut_off = copy.cut_off
    if taken:
        life.jumps = jumps_in(life.runs)
    return taken


def _insert(life: Life, position: int, copy: Life, start: int, end: int) -> int:
    count = end - start
    life.runs[position:position] = copy.runs[start:end]
    life.run_lines[position:position] = copy.run_lines[start:end]
    life.gaps = [gap._replace(position=gap.position + count * (gap.position > position)) for gap in life.gaps]
    beside = [aside for at, aside in life.asides if at == position]
    asides = [((at + count * (at > position), aside), line) for (at, aside), line in life.numbered_asides()]
    asides += [
        ((at - start + position, aside), line)
        for (at, aside), line in copy.numbered_asides()
        if start <= at <= end and aside not in beside
    ]
    asides.sort(key=lambda numbered: numbered[0][0])
    life.asides, life.aside_lines = [aside for aside, _ in asides], [line for _, line in asides]
    return count


def _of_copy(life: Life, twin: Life, taken: int) -> str:
    where = "also in this file" if life.path == twin.path else f"in {twin.path}"
    used = f"{taken} handler runs that are lost there are read from here" if taken else "the lines there are used"
    return f"the records from here on are {where}, from {twin.counts} {twin.first_line} on; {used}"
