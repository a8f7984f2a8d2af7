"""Draw a chart over time with a row for each vehicle. A row shows the events, and below them the blocks, which are
shaded by the number of their holders. Marks show changes in the flight log.
"""

from bisect import bisect_left
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from markupsafe import Markup

from harness.field.depot.consolidation import MergedRecord, RecordedBlock, events_in
from harness.present import svg, text
from harness.present.colours import AgentColours
from harness.present.svg import n

WIDTH, LEFT, RIGHT, TOP, BOTTOM = 900, 76, 24, 8, 34
LANE, BARS, BOXES = 44, 20, 12
BINS = 260
MAX_GAP_PX = 0.6
"""Width in pixels below which a gap between two blocks is invisible. Blocks with a narrower gap are drawn as one box.
"""
OUTLIER_SHARE = 0.01
"""Share of the events, at the beginning and again at the end, that the time span ignores, because the clocks of these
events may be wrong.
"""
SHADES = 4
MAX_NAMED = 8
"""Maximum number of changes that the text of a mark lists."""


@dataclass(frozen=True)
class TimeSpan:
    """An interval of time in microseconds."""

    first_us: int
    last_us: int
    outside: int
    """Number of events outside of the interval. The times of these events come from wrong clocks."""


def time_span_of(record: MergedRecord) -> TimeSpan | None:
    """Return the interval that contains nearly all events. Return None if there are no events."""
    times = sorted(timestamp_us for block in record.blocks for timestamp_us, *_ in events_in(block.event_data))
    if not times:
        return None
    low, high = times[int(OUTLIER_SHARE * len(times))], times[len(times) - 1 - int(OUTLIER_SHARE * len(times))]
    slack = max(high - low, 1_000_000) // 4
    first = times[bisect_left(times, low - slack)]
    last = times[bisect_left(times, high + slack + 1) - 1]
    outside = bisect_left(times, first) + len(times) - bisect_left(times, last + 1)
    return TimeSpan(first, last, outside)


def extended(time_span: TimeSpan, marks: Iterable["Mark"]) -> TimeSpan:
    """Return a longer interval that also contains the marks before and after the given interval. A mark is ignored if
    its distance from the given interval exceeds the length of this interval, because the clock of the mark must then be
    wrong.
    """
    length = time_span.last_us - time_span.first_us
    near = [at for at, _ in marks if time_span.first_us - length <= at <= time_span.last_us + length]
    return replace(time_span, first_us=min([time_span.first_us, *near]), last_us=max([time_span.last_us, *near]))


Mark = tuple[int, str]
"""A mark in the chart: the time on the agent's clock in microseconds, and a change of the agent's vehicle, such as
"mode LAND".
"""


def draw(
    record: MergedRecord,
    time_span: TimeSpan,
    ink: Mapping[int, AgentColours],
    marks: Mapping[int, Sequence[Mark]],
) -> Markup:
    """Draw the rows of all vehicles. `marks` are the changes of each vehicle."""
    length_s = max(1.0, (time_span.last_us - time_span.first_us) / 1e6)
    axis = svg.linear_axis(0.0, length_s, (LEFT, WIDTH - RIGHT))
    of_agent: dict[int, list[RecordedBlock]] = defaultdict(list)
    for block in record.blocks:
        of_agent[block.line.agent_id].append(block)
    roster = record.header.roster
    height = TOP + LANE * len(roster) + BOTTOM
    lanes = [
        Markup("").join(
            [
                _lane(agent_id, of_agent[agent_id], record, time_span, axis, TOP + LANE * number, ink[agent_id]),
                *_marks(marks.get(agent_id, ()), time_span, axis, TOP + LANE * number + 2),
            ]
        )
        for number, agent_id in enumerate(roster)
    ]
    return Markup(
        '<svg xmlns="http://www.w3.org/2000/svg" class="along" role="img" width="{w}" height="{h}"'
        ' viewBox="0 0 {w} {h}" aria-label="{desc}" font-family="{font}" font-size="12">{axis}{lanes}</svg>'
    ).format(
        w=WIDTH,
        h=height,
        desc=f"Events and blocks of {len(roster)} vehicles along time",
        font=svg.FONT,
        axis=_axis(axis, TOP, height - BOTTOM),
        lanes=Markup("\n").join(lanes),
    )


def _axis(axis: svg.Axis, top: float, bottom: float) -> Markup:
    rules = "".join(f"M{n(axis(tick))} {n(top)}V{n(bottom)}" for tick in axis.ticks)
    texts = [
        Markup('<text class="quiet" x="{}" y="{}" text-anchor="middle">{}</text>').format(
            n(axis(tick)), n(bottom + 18), text.duration(tick)
        )
        for tick in axis.ticks
    ]
    return Markup('<path class="rule" d="{}"/>{}').format(rules, Markup("").join(texts))


def _lane(
    agent_id: int,
    blocks: Sequence[RecordedBlock],
    record: MergedRecord,
    time_span: TimeSpan,
    axis: svg.Axis,
    top: float,
    ink: AgentColours,
) -> Markup:
    name = Markup('<text x="{}" y="{}" text-anchor="end">{}</text>').format(n(LEFT - 10), n(top + 25), agent_id)
    ground = Markup('<rect class="lane" x="{}" y="{}" width="{}" height="{}"/>').format(
        LEFT, n(top + 2), WIDTH - LEFT - RIGHT, LANE - 4
    )
    return Markup("").join(
        [
            name,
            ground,
            _bars(blocks, time_span, axis, top + 4, ink),
            _boxes(blocks, record, time_span, axis, top + 4 + BARS + 2),
            *_losses(agent_id, blocks, record, time_span, axis, top + 4),
        ]
    )


def _marks(marks: Iterable[Mark], time_span: TimeSpan, axis: svg.Axis, top: float) -> Iterable[Markup]:
    """Draw the changes of a vehicle. Changes at the same pixel share one mark."""
    at_px: dict[int, list[str]] = defaultdict(list)
    for at_us, words in marks:
        if time_span.first_us <= at_us <= time_span.last_us:
            at_px[round(axis((at_us - time_span.first_us) / 1e6))].append(words)
    for x, changes in sorted(at_px.items()):
        named = ", ".join([*changes[:MAX_NAMED], *(["..."] if len(changes) > MAX_NAMED else [])])
        yield Markup('<path class="mark" d="M{} {}h6l-3 6zm3 6v{}"><title>{}</title></path>').format(
            n(x - 3), n(top), n(LANE - 10), named
        )


def _bars(
    blocks: Sequence[RecordedBlock], time_span: TimeSpan, axis: svg.Axis, top: float, ink: AgentColours
) -> Markup:
    """Draw a histogram of the events over time."""
    width = (axis.end - axis.start) / BINS
    length = max(1, time_span.last_us - time_span.first_us)
    counts = [0] * BINS
    for block in blocks:
        for timestamp_us, *_ in events_in(block.event_data):
            if time_span.first_us <= timestamp_us <= time_span.last_us:
                counts[min(BINS - 1, (timestamp_us - time_span.first_us) * BINS // length)] += 1
    most = max(counts, default=0)
    floor = n(top + BARS)
    path = "".join(
        f"M{n(axis.start + number * width)} {floor}v-{n(max(2.0, BARS * count / most))}h{n(width)}V{floor}z"
        for number, count in enumerate(counts)
        if count
    )
    return Markup('<path class="bars" d="{}" fill="{}" stroke="{}"><title>{}</title></path>').format(
        path, ink.fill, ink.stroke, f"{sum(counts)} events"
    )


def shade(holders: int, vehicles: int) -> int:
    """Return the shade of grey for a block, as a number. The shade shows how many vehicles hold the block: shade 0
    stands for one vehicle, and the last shade for all vehicles.
    """
    if holders <= 1:
        return 0
    return SHADES - 1 if holders >= vehicles else 1 if 2 * holders <= vehicles else 2


def _boxes(
    blocks: Sequence[RecordedBlock], record: MergedRecord, time_span: TimeSpan, axis: svg.Axis, top: float
) -> Markup:
    """Draw the blocks. Neighbouring blocks with the same shade are drawn as one box."""
    vehicles = len(record.collected.latest)
    merged: list[tuple[float, float, str, list[str]]] = []
    for block in sorted(blocks, key=lambda block: block.line.timestamp_us):
        begin, end = _extent(block, time_span, axis)
        holders = block.line.holders
        css_class = "building" if block.line.block_hash is None else f"copies{shade(len(holders), vehicles)}"
        if merged and merged[-1][2] == css_class and begin - merged[-1][1] < MAX_GAP_PX and css_class != "building":
            last = merged.pop()
            merged.append((last[0], max(last[1], end), css_class, [*last[3], block.line.name]))
        else:
            merged.append((begin, max(end, begin + 1.5), css_class, [block.line.name]))
    meanings = {
        "building": "current block",
        "copies0": "with one vehicle only",
        f"copies{SHADES - 1}": "with all vehicles",
    }
    return Markup("").join(
        Markup('<rect class="{}" x="{}" y="{}" width="{}" height="{}"><title>{}</title></rect>').format(
            css_class,
            n(begin),
            n(top),
            n(end - begin),
            BOXES,
            f"{_names_text(names)}: {meanings.get(css_class, 'with some vehicles')}",
        )
        for begin, end, css_class, names in merged
    )


def _extent(block: RecordedBlock, time_span: TimeSpan, axis: svg.Axis) -> tuple[float, float]:
    times = [timestamp_us for timestamp_us, *_ in events_in(block.event_data)] or [block.line.timestamp_us]
    return axis((min(times) - time_span.first_us) / 1e6), axis((max(times) - time_span.first_us) / 1e6)


def _losses(
    agent_id: int,
    blocks: Sequence[RecordedBlock],
    record: MergedRecord,
    time_span: TimeSpan,
    axis: svg.Axis,
    top: float,
) -> Iterable[Markup]:
    """Draw hatched areas for lost blocks, and for the missing end of a vehicle's record."""
    extents = {block.line.name: _extent(block, time_span, axis) for block in blocks}
    ordinals = sorted(int(name.partition(".")[2]) for name in extents if name.partition(".")[2].isdecimal())
    gaps: dict[tuple[float, float], list[str]] = {}
    for lost in record.lost_blocks:
        if lost.agent_id == agent_id and lost.block is not None:
            ordinal = int(lost.block.partition(".")[2])
            before = [other for other in ordinals if other < ordinal]
            after = [other for other in ordinals if other > ordinal]
            begin = extents[f"{agent_id}.{before[-1]}"][1] if before else axis.start
            end = extents[f"{agent_id}.{after[0]}"][0] if after else axis.end
            gaps.setdefault((begin, max(end, begin + 3)), []).append(lost.block)
    for (begin, end), names in gaps.items():
        yield _hatched(begin, end, top, f"{_names_text(names)}: lost")
    if any(missing.agent_id == agent_id for missing in record.missing):
        begin = max((end for _, end in extents.values()), default=axis.start)
        yield _hatched(begin, max(axis.end, begin + 3), top, "later records are missing")


def _hatched(begin: float, end: float, top: float, tip: str) -> Markup:
    return Markup('<rect class="gone" x="{}" y="{}" width="{}" height="{}"><title>{}</title></rect>').format(
        n(begin), n(top), n(end - begin), BARS + 2 + BOXES, tip
    )


def _names_text(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} to {names[-1]}, {len(names)} blocks"
