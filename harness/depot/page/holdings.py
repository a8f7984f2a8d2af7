"""Who holds what: a row for each vehicle, a column for each block in the order of the record, and what was lost."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby

from markupsafe import Markup

from harness.depot.consolidation import BlockOnRecord, Consolidation
from harness.present import svg
from harness.present.svg import n

WIDTH, LEFT, RIGHT, TOP, BOTTOM = 900, 76, 12, 26, 8
ROW, GAP = 22, 6
WIDEST = 14.0
"""Pixels of a column, however few there are."""

GROUPS = {
    "mutual": "mutual chain",
    "chain": "in some chains",
    "aside": "in no chain",
    "edited": "edited",
    "building": "being built",
    "lost": "lost",
}
PLACES = {
    "chain": "in its chain",
    "deque": "to be committed",
    "stack": "on its reconcile stack",
    "current block": "being built",
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
        for place, begin, end, names in _stretches(members, agent_id):
            parts.append(
                Markup('<rect class="{}" x="{}" y="{}" width="{}" height="{}"><title>{}</title></rect>').format(
                    f"at-{place.replace(' ', '-')}",
                    n(left + begin * each),
                    top,
                    n(max(0.8, (end - begin) * each)),
                    ROW - 2,
                    f"vehicle {agent_id}: {names} {PLACES[place]}",
                )
            )
    return Markup("").join(parts)


def _stretches(members: Sequence[Column], agent_id: int) -> Iterator[tuple[str, int, int, str]]:
    """Blocks in a row that the agent holds in the same place: where, from and to which column, and their names."""
    at = 0
    for place, alike in groupby(members, key=lambda column: column[2].get(agent_id)):
        names = [name for _, name, _ in alike]
        if place is not None:
            named = names[0] if len(names) == 1 else f"{names[0]} to {names[-1]}, {len(names)} blocks,"
            yield place, at, at + len(names), named
        at += len(names)


def _heading(group: str, count: int, left: float, width: float) -> Markup:
    text = f"{GROUPS[group]}: {count}"
    fits = width > 6.4 * len(text)
    short = text if fits else str(count) if width > 8 * len(str(count)) else ""
    return Markup(
        '<path class="bracket" d="M{} {}v-4h{}v4"/><text class="quiet{}" x="{}" y="12"><title>{}</title>{}</text>'
    ).format(n(left), TOP - 4, n(max(width, 2.0)), " first" if left == LEFT else "", n(left), text, short)
