"""Draw which vehicle holds which block. Each vehicle has a row, and each block has a column. The columns have the order
of the record.
"""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from typing import NamedTuple

from markupsafe import Markup

from harness.field.depot.consolidation import MergedRecord, RecordedBlock
from harness.present import svg
from harness.present.svg import n

WIDTH, LEFT, RIGHT, TOP, BOTTOM = 900, 76, 12, 26, 8
ROW, GAP = 22, 6
MIN_CELL_PX = 1.0
"""Minimum width of a visible cell, in pixels."""
MAX_COLUMN_PX = 14.0
"""Maximum width of a column, in pixels."""

GROUPS = {
    "mutual": "mutual chain",
    "chain": "in some chains",
    "aside": "in no chain",
    "edited": "edited",
    "building": "current block",
    "lost": "lost",
}
PLACES = {
    "chain": "in its chain",
    "deque": "to be committed",
    "stack": "on its reconcile stack",
    "current block": "current block",
    "earlier export": "only in an earlier export",
}


def draw(record: MergedRecord) -> Markup:
    """Draw the columns in groups. One group has the blocks in all chains, another the lost blocks, and so on."""
    columns = _columns(record)
    groups = [(group, list(members)) for group, members in groupby(columns, key=lambda column: column[0])]
    available_px = WIDTH - LEFT - RIGHT - GAP * (len(groups) - 1)
    column_px = min(MAX_COLUMN_PX, available_px / max(1, len(columns)))
    roster = record.header.roster
    height = TOP + ROW * len(roster) + BOTTOM
    missing = {lost.agent_id for lost in record.missing}
    parts = []
    left = float(LEFT)
    for group, members in groups:
        width = column_px * len(members)
        parts.append(_group(group, members, left, column_px, roster, missing))
        parts.append(_heading(group, len(members), left, width))
        left += width + GAP
    names = (
        Markup('<text x="{}" y="{}" text-anchor="end"{}>{}{}</text>').format(
            n(LEFT - 10),
            n(TOP + ROW * number + 15),
            Markup(' class="absent"') if agent_id in missing else "",
            agent_id,
            "\u00a0✗" if agent_id in missing else "",
        )
        for number, agent_id in enumerate(roster)
    )
    return Markup(
        '<svg xmlns="http://www.w3.org/2000/svg" class="holdings" role="img" width="{w}" height="{h}"'
        ' viewBox="0 0 {w} {h}" aria-label="{desc}" font-family="{font}" font-size="12">{parts}{names}</svg>'
    ).format(
        w=WIDTH,
        h=height,
        desc=f"Which of {len(roster)} vehicles holds which of {len(columns)} blocks",
        font=svg.FONT,
        parts=Markup("\n").join(parts),
        names=Markup("").join(names),
    )


Column = tuple[str, str, Mapping[int, str]]
"""A column of the drawing, which shows a block: its group, its name, and the place of the block on each vehicle."""


class _BlockRange(NamedTuple):
    """A range of columns, from `begin` up to but not including `end`. `place` is the place at which the agent holds the
    blocks of these columns, such as its chain or its deque. `fraction` is "part" if the agent holds only some of these
    blocks, and empty otherwise.
    """

    place: str
    fraction: str
    begin: int
    end: int
    names: str


def _columns(record: MergedRecord) -> list[Column]:
    columns = [(_group_of(block), block.line.name, _places(block)) for block in record.blocks]
    columns += [("lost", lost.block or "", {}) for lost in record.lost_blocks]
    order = list(GROUPS)
    return sorted(columns, key=lambda column: order.index(column[0]))


def _group_of(block: RecordedBlock) -> str:
    if block.line.mutual:
        return "mutual"
    if block.line.claimed_hash is not None:
        return "edited"
    if block.line.block_hash is None:
        return "building"
    return "chain" if any(held.place == "chain" for held in block.line.held) else "aside"


def _places(block: RecordedBlock) -> dict[int, str]:
    """Return the place at which each agent holds the block (chain, deque or others), by agent ID. If an agent holds the
    block at two places, return the first place.
    """
    places: dict[int, str] = {}
    for held in block.line.held:
        for agent_id in held.agents:
            places.setdefault(agent_id, held.place)
    return places


def _group(
    group: str, members: Sequence[Column], left: float, column_px: float, roster: Sequence[int], missing: set[int]
) -> Markup:
    width = column_px * len(members)
    parts = []
    if group == "lost":
        tip = ", ".join(name for _, name, _ in members[:20]) + (" …" if len(members) > 20 else "")
        return Markup('<rect class="gone" x="{}" y="{}" width="{}" height="{}"><title>{}</title></rect>').format(
            n(left), TOP, n(max(width, 4.0)), ROW * len(roster) - 2, f"lost: {tip}"
        )
    for number, agent_id in enumerate(roster):
        top = TOP + ROW * number
        css_class = "absent" if agent_id in missing else "lane"
        parts.append(
            Markup('<rect class="{}" x="{}" y="{}" width="{}" height="{}"/>').format(
                css_class, n(left), top, n(width), ROW - 2
            )
        )
        for held_range in _ranges(members, agent_id, column_px):
            parts.append(
                Markup('<rect class="{}" x="{}" y="{}" width="{}" height="{}"><title>{}</title></rect>').format(
                    f"at-{held_range.place.replace(' ', '-')} {held_range.fraction}".rstrip(),
                    n(left + held_range.begin * column_px),
                    top,
                    n(max(0.8, (held_range.end - held_range.begin) * column_px)),
                    ROW - 2,
                    f"vehicle {agent_id}: {held_range.names} {PLACES[held_range.place]}",
                )
            )
    return Markup("").join(parts)


def _ranges(members: Sequence[Column], agent_id: int, column_px: float) -> Iterator[_BlockRange]:
    """Yield ranges of consecutive blocks that the agent holds in the same place: chain, deque or stack.

    Each block has a column in the picture. Columns that are narrower than a pixel are combined into one cell. A
    combined cell shows the place that holds most of its blocks, and whether the agent holds all of them.
    """
    columns_per_cell = max(1, math.ceil(MIN_CELL_PX / column_px))
    cells = [members[at : at + columns_per_cell] for at in range(0, len(members), columns_per_cell)]
    kinds = (_cell_state(cell, agent_id) for cell in cells)
    at = 0
    for (place, fraction), alike in groupby(kinds):
        begin, at = at, at + len(list(alike))
        if place is not None:
            held = members[begin * columns_per_cell : at * columns_per_cell]
            yield _BlockRange(
                place,
                fraction,
                begin * columns_per_cell,
                begin * columns_per_cell + len(held),
                _range_text(held, fraction),
            )


def _cell_state(cell: Sequence[Column], agent_id: int) -> tuple[str | None, str]:
    """Return the place at which the agent holds the most blocks of this cell, or None if it holds none of them. The
    second result is "part" if the agent holds only some of the blocks, and empty otherwise.
    """
    places = Counter(place for _, _, held in cell if (place := held.get(agent_id)) is not None)
    if not places:
        return None, ""
    (place, _), *_ = places.most_common(1)
    return place, "" if places.total() == len(cell) else "part"


def _range_text(held: Sequence[Column], fraction: str) -> str:
    first, last = held[0][1], held[-1][1]
    if fraction:
        return f"some of {len(held)} blocks from {first} to {last}"
    return first if len(held) == 1 else f"{first} to {last}, {len(held)} blocks,"


def _heading(group: str, count: int, left: float, width: float) -> Markup:
    text = f"{GROUPS[group]}: {count}"
    fits = width > 6.4 * len(text)
    short = text if fits else str(count) if width > 8 * len(str(count)) else ""
    return Markup(
        '<path class="bracket" d="M{} {}v-4h{}v4"/><text class="quiet{}" x="{}" y="12"><title>{}</title>{}</text>'
    ).format(n(left), TOP - 4, n(max(width, 2.0)), " first" if left == LEFT else "", n(left), text, short)
