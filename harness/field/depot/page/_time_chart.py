"""When it was logged: a lane for each vehicle, above its events, below its blocks, by how many vehicles hold them."""

from bisect import bisect_left
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from markupsafe import Markup

from harness.field.depot.consolidation import BlockOnRecord, Consolidation, events_in
from harness.present import svg, text
from harness.present.colours import Ink
from harness.present.svg import n

WIDTH, LEFT, RIGHT, TOP, BOTTOM = 900, 76, 24, 8, 34
LANE, BARS, BOXES = 44, 20, 12
BINS = 260
TOUCHING = 0.6
"""Pixels between two blocks that nobody sees."""
OUTLIERS = 0.01
"""The share of events at either end whose clocks may be far off."""
SHADES = 4


@dataclass(frozen=True)
class Span:
    """From when to when, in microseconds; `outside` are events of clocks that show quite another time."""

    first_us: int
    last_us: int
    outside: int


def span(record: Consolidation) -> Span | None:
    """When nearly all events were logged; None if there is none."""
    times = sorted(timestamp_us for block in record.blocks for timestamp_us, *_ in events_in(block.event_data))
    if not times:
        return None
    low, high = times[int(OUTLIERS * len(times))], times[len(times) - 1 - int(OUTLIERS * len(times))]
    slack = max(high - low, 1_000_000) // 4
    first = times[bisect_left(times, low - slack)]
    last = times[bisect_left(times, high + slack + 1) - 1]
    outside = bisect_left(times, first) + len(times) - bisect_left(times, last + 1)
    return Span(first, last, outside)


def draw(record: Consolidation, when: Span, ink: Mapping[int, Ink]) -> Markup:
    """Lanes of all that flew."""
    length_s = max(1.0, (when.last_us - when.first_us) / 1e6)
    across = svg.linear_axis(0.0, length_s, (LEFT, WIDTH - RIGHT))
    of_agent: dict[int, list[BlockOnRecord]] = defaultdict(list)
    for block in record.blocks:
        of_agent[block.line.agent_id].append(block)
    roster = record.header.roster
    height = TOP + LANE * len(roster) + BOTTOM
    lanes = [
        _lane(agent_id, of_agent[agent_id], record, when, across, TOP + LANE * number, ink[agent_id])
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
        axis=_axis(across, TOP, height - BOTTOM),
        lanes=Markup("\n").join(lanes),
    )


def _axis(across: svg.Axis, top: float, bottom: float) -> Markup:
    rules = "".join(f"M{n(across(tick))} {n(top)}V{n(bottom)}" for tick in across.ticks)
    texts = [
        Markup('<text class="quiet" x="{}" y="{}" text-anchor="middle">{}</text>').format(
            n(across(tick)), n(bottom + 18), text.duration(tick)
        )
        for tick in across.ticks
    ]
    return Markup('<path class="rule" d="{}"/>{}').format(rules, Markup("").join(texts))


def _lane(
    agent_id: int,
    blocks: Sequence[BlockOnRecord],
    record: Consolidation,
    when: Span,
    across: svg.Axis,
    top: float,
    ink: Ink,
) -> Markup:
    name = Markup('<text x="{}" y="{}" text-anchor="end">{}</text>').format(n(LEFT - 10), n(top + 25), agent_id)
    ground = Markup('<rect class="lane" x="{}" y="{}" width="{}" height="{}"/>').format(
        LEFT, n(top + 2), WIDTH - LEFT - RIGHT, LANE - 4
    )
    return Markup("").join(
        [
            name,
            ground,
            _bars(blocks, when, across, top + 4, ink),
            _boxes(blocks, record, when, across, top + 4 + BARS + 2),
            *_losses(agent_id, blocks, record, when, across, top + 4),
        ]
    )


def _bars(blocks: Sequence[BlockOnRecord], when: Span, across: svg.Axis, top: float, ink: Ink) -> Markup:
    """How many events there are in each stretch of time, the tallest for most."""
    width = (across.end - across.start) / BINS
    length = max(1, when.last_us - when.first_us)
    counts = [0] * BINS
    for block in blocks:
        for timestamp_us, *_ in events_in(block.event_data):
            if when.first_us <= timestamp_us <= when.last_us:
                counts[min(BINS - 1, (timestamp_us - when.first_us) * BINS // length)] += 1
    most = max(counts, default=0)
    floor = n(top + BARS)
    path = "".join(
        f"M{n(across.start + number * width)} {floor}v-{n(max(2.0, BARS * count / most))}h{n(width)}V{floor}z"
        for number, count in enumerate(counts)
        if count
    )
    return Markup('<path class="bars" d="{}" fill="{}" stroke="{}"><title>{}</title></path>').format(
        path, ink.fill, ink.stroke, f"{sum(counts)} events"
    )


def shade(holders: int, vehicles: int) -> int:
    """0 if one vehicle alone holds it, the last if all do."""
    if holders <= 1:
        return 0
    return SHADES - 1 if holders >= vehicles else 1 if 2 * holders <= vehicles else 2


def _boxes(blocks: Sequence[BlockOnRecord], record: Consolidation, when: Span, across: svg.Axis, top: float) -> Markup:
    """Blocks that touch each other, and that as many hold, are one box."""
    vehicles = len(record.home.latest)
    merged: list[tuple[float, float, str, list[str]]] = []
    for block in sorted(blocks, key=lambda block: block.line.timestamp_us):
        begin, end = _reach(block, when, across)
        holders = block.line.holders
        looks = "building" if block.line.block_hash is None else f"copies{shade(len(holders), vehicles)}"
        if merged and merged[-1][2] == looks and begin - merged[-1][1] < TOUCHING and looks != "building":
            last = merged.pop()
            merged.append((last[0], max(last[1], end), looks, [*last[3], block.line.name]))
        else:
            merged.append((begin, max(end, begin + 1.5), looks, [block.line.name]))
    means = {
        "building": "current block",
        "copies0": "with one vehicle only",
        f"copies{SHADES - 1}": "with all vehicles",
    }
    return Markup("").join(
        Markup('<rect class="{}" x="{}" y="{}" width="{}" height="{}"><title>{}</title></rect>').format(
            looks, n(begin), n(top), n(end - begin), BOXES, f"{_named(names)}: {means.get(looks, 'with some vehicles')}"
        )
        for begin, end, looks, names in merged
    )


def _reach(block: BlockOnRecord, when: Span, across: svg.Axis) -> tuple[float, float]:
    times = [timestamp_us for timestamp_us, *_ in events_in(block.event_data)] or [block.line.timestamp_us]
    return across((min(times) - when.first_us) / 1e6), across((max(times) - when.first_us) / 1e6)


def _losses(
    agent_id: int, blocks: Sequence[BlockOnRecord], record: Consolidation, when: Span, across: svg.Axis, top: float
) -> Iterable[Markup]:
    """Hatched: from the last block before to the first after those that were lost; for a missing vehicle to the end."""
    reach = {block.line.name: _reach(block, when, across) for block in blocks}
    ordinals = sorted(int(name.partition(".")[2]) for name in reach if name.partition(".")[2].isdecimal())
    gaps: dict[tuple[float, float], list[str]] = {}
    for lost in record.lost_blocks:
        if lost.agent_id == agent_id and lost.block is not None:
            ordinal = int(lost.block.partition(".")[2])
            before = [other for other in ordinals if other < ordinal]
            after = [other for other in ordinals if other > ordinal]
            begin = reach[f"{agent_id}.{before[-1]}"][1] if before else across.start
            end = reach[f"{agent_id}.{after[0]}"][0] if after else across.end
            gaps.setdefault((begin, max(end, begin + 3)), []).append(lost.block)
    for (begin, end), names in gaps.items():
        yield _hatched(begin, end, top, f"{_named(names)}: lost")
    if any(missing.agent_id == agent_id for missing in record.missing):
        begin = max((end for _, end in reach.values()), default=across.start)
        yield _hatched(begin, max(across.end, begin + 3), top, "later records are missing")


def _hatched(begin: float, end: float, top: float, tip: str) -> Markup:
    return Markup('<rect class="gone" x="{}" y="{}" width="{}" height="{}"><title>{}</title></rect>').format(
        n(begin), n(top), n(end - begin), BARS + 2 + BOXES, tip
    )


def _named(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} to {names[-1]}, {len(names)} blocks"
