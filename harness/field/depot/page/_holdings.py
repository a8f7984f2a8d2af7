"""Who holds what: a row for each vehicle, a column for each block in the order of the record, and what was lost."""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from typing import NamedTuple

from markupsafe import Markup

from harness.field.depot.consolidation import BlockOnRecord, Consolidation
from harness.present import svg
from harness.present.svg import n

WIDTH, LEFT, RIGHT, TOP, BOTTOM = 900, 76, 12, 26, 8
ROW, GAP = 22, 6
FINEST = 1.0
"""Pixels that anybody can tell apart."""
WIDEST = 14.0
"""Pixels of a column, however few there are."""

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


def draw(record: Consolidation) -> Markup:
    """Columns in groups: what all share, what some have in their chains, what is in none, and what is gone."""
    columns = _columns(record)
    groups = [(group, list(members)) for group, members in groupby(columns, key=lambda column: column[0])]
    room = WIDTH - LEFT - RIGHT - GAP * (len(groups) - 1)
    each = min(WIDEST, room / max(1, len(columns)))
    roster = record.header.roster
    height = TOP + ROW * len(roster) + BOTTOM
    missing = {lost.agent_id for lost in record.missing}
    parts = []
    left = float(LEFT)
    for group, members in groups:
        width = each * len(members)
        parts.append(_group(group, members, left, each, roster, missing))
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
"""Group, name, and where each vehicle holds the block."""


class _Stretch(NamedTuple):
    """From column `begin` up to `end`: where the agent holds them; `share` is "part" if it does not hold all."""

    place: str
    share: str
    begin: int
    end: int
    names: str


def _columns(record: Consolidation) -> list[Column]:
    columns = [(_group_of(block), block.line.name, _places(block)) for block in record.blocks]
    columns += [("lost", lost.block or "", {}) for lost in record.lost_blocks]
    order = list(GROUPS)
    return sorted(columns, key=lambda column: order.index(column[0]))


def _group_of(block: BlockOnRecord) -> str:
    if block.line.mutual:
        return "mutual"
    if block.line.claimed_hash is not None:
        return "edited"
    if block.line.block_hash is None:
        return "building"
    return "chain" if any(held.place == "chain" for held in block.line.held) else "aside"


def _places(block: BlockOnRecord) -> dict[int, str]:
    """By agent; one that holds it in two places in the first."""
    places: dict[int, str] = {}
    for held in block.line.held:
        for agent_id in held.agents:
            places.setdefault(agent_id, held.place)
    return places


def _group(
    group: str, members: Sequence[Column], left: float, each: float, roster: Sequence[int], missing: set[int]
) -> Markup:
    width = each * len(members)
    parts = []
    if group == "lost":
        tip = ", ".join(name for _, name, _ in members[:20]) + (" …" if len(members) > 20 else "")
        return Markup('<rect class="gone" x="{}" y="{}" width="{}" height="{}"><title>{}</title></rect>').format(
            n(left), TOP, n(max(width, 4.0)), ROW * len(roster) - 2, f"lost: {tip}"
        )
    for number, agent_id in enumerate(roster):
        top = TOP + ROW * number
        looks = "absent" if agent_id in missing else "lane"
        parts.append(
            Markup('<rect class="{}" x="{}" y="{}" width="{}" height="{}"/>').format(
                looks, n(left), top, n(width), ROW - 2
            )
        )
        for stretch in _stretches(members, agent_id, each):
            parts.append(
                Markup('<rect class="{}" x="{}" y="{}" width="{}" height="{}"><title>{}</title></rect>').format(
                    f"at-{stretch.place.replace(' ', '-')} {stretch.share}".rstrip(),
                    n(left + stretch.begin * each),
                    top,
                    n(max(0.8, (stretch.end - stretch.begin) * each)),
                    ROW - 2,
                    f"vehicle {agent_id}: {stretch.names} {PLACES[stretch.place]}",
                )
            )
    return Markup("").join(parts)


def _stretches(members: Sequence[Column], agent_id: int, each: float) -> Iterator[_Stretch]:
    """Blocks in a row that the agent holds in the same place; of columns that nobody could tell apart, most of them.

    Each cell is a column, or as many as make a pixel, and has the place where most of its blocks are that the agent
    holds, and how many these are of all: none, some, or all.
    """
    together = max(1, math.ceil(FINEST / each))
    cells = [members[at : at + together] for at in range(0, len(members), together)]
    kinds = (_kind(cell, agent_id) for cell in cells)
    at = 0
    for (place, share), alike in groupby(kinds):
        begin, at = at, at + len(list(alike))
        if place is not None:
            held = members[begin * together : at * together]
            yield _Stretch(place, share, begin * together, begin * together + len(held), _named(held, share))


def _kind(cell: Sequence[Column], agent_id: int) -> tuple[str | None, str]:
    """Where the agent holds these blocks, and whether all of them."""
    places = Counter(place for _, _, held in cell if (place := held.get(agent_id)) is not None)
    if not places:
        return None, ""
    (place, _), *_ = places.most_common(1)
    return place, "" if places.total() == len(cell) else "part"


def _named(held: Sequence[Column], share: str) -> str:
    first, last = held[0][1], held[-1][1]
    if share:
        return f"some of {len(held)} blocks from {first} to {last}"
    return first if len(held) == 1 else f"{first} to {last}, {len(held)} blocks,"


def _heading(group: str, count: int, left: float, width: float) -> Markup:
    text = f"{GROUPS[group]}: {count}"
    fits = width > 6.4 * len(text)
    short = text if fits else str(count) if width > 8 * len(str(count)) else ""
    return Markup(
        '<path class="bracket" d="M{} {}v-4h{}v4"/><text class="quiet{}" x="{}" y="12"><title>{}</title>{}</text>'
    ).format(n(left), TOP - 4, n(max(width, 2.0)), " first" if left == LEFT else "", n(left), text, short)
