"""Combine the chains of all agents into a tree. Chains that begin with the same blocks share the marks of these blocks.

A block appears once for each sequence of blocks below it. If agents with diverged chains hold the same block, the block
is therefore on two branches (Figure 4.4). `marks` converts the tree to the marks of a picture: a box for each block,
and an oval where chains end. On request, an ellipsis replaces the middle of a long sequence without branches.

A chain can be longer than Python's recursion limit. All functions here therefore use loops instead of recursion.

`ChainTreeLayout` contains the positions of all marks in a picture of the chain tree. Time grows upwards, and columns do
not overlap. Each subtree is placed as close as possible to the subtrees on its left. To find this place, the layout
compares the outlines of the subtrees row by row (after Reingold and Tilford, "Tidier Drawings of Trees", 1981). A block
is below the middle of its successors. If more than half of the agents have the same successor, this successor is
exactly above the block, and the other successors are at the sides. An oval marks the end of chains. If other chains
continue above the last block, the oval is to the right of this block, otherwise above it.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal

from harness.archive.exports import Export, ExportedBlock

KEPT_AT_EACH_END = 3
"""Number of blocks that are drawn before and after an ellipsis."""
FEWEST_HIDDEN = 3
"""Minimum number of blocks that an ellipsis replaces. An ellipsis for fewer blocks would save no space."""

OVAL_LINE_CHARACTERS = 14


@dataclass(slots=True)
class ChainTreeNode:
    """A block in the tree. `block` is None for the inception block."""

    block: ExportedBlock | None
    holders: list[int] = field(default_factory=list)
    """The IDs of the agents whose chains contain this block on top of the same earlier blocks."""
    ends: list[int] = field(default_factory=list)
    """Agents whose chains end at this block."""
    children: dict[str, "ChainTreeNode"] = field(default_factory=dict)

    @property
    def is_plain(self) -> bool:
        """True if the block has exactly one successor, and no chain ends at it."""
        return self.block is not None and len(self.children) == 1 and not self.ends


@dataclass(slots=True)
class ChainTreeMark:
    """A mark of the picture (a box, an oval or an ellipsis), together with all marks above it."""

    kind: Literal["block", "ellipsis", "oval"]
    nodes: list[ChainTreeNode]
    """The blocks that the mark stands for: the block of a box, the hidden blocks of an ellipsis, or the last block
    below an oval.
    """
    lines: list[str]
    holders: list[int]
    children: list["ChainTreeMark"] = field(default_factory=list)
    beside: "ChainTreeMark | None" = None
    """The oval beside a block at which some chains end and other chains continue, or None if there is no such oval."""


def chain_tree(exports: Mapping[int, Export]) -> ChainTreeNode:
    """Return the inception block as the root of a tree with the chains of all agents."""
    inception = ChainTreeNode(None)
    for agent_id, export in sorted(exports.items()):
        node = inception
        node.holders.append(agent_id)
        for block in export.chain:
            node = node.children.setdefault(block.block_hash, ChainTreeNode(block))
            node.holders.append(agent_id)
        node.ends.append(agent_id)
    return inception


def holders(exports: Mapping[int, Export]) -> dict[str, list[int]]:
    """Return a mapping from block hashes to the agents whose chains contain the block."""
    held_by: dict[str, list[int]] = {}
    for agent_id, export in sorted(exports.items()):
        for block_hash in dict.fromkeys(export.chain_of_block_hashes):
            held_by.setdefault(block_hash, []).append(agent_id)
    return held_by


def marks(inception: ChainTreeNode, names: Mapping[str, str], *, abridged: bool) -> ChainTreeMark:
    """Return the mark of the inception block. All other marks can be reached from this mark. `names` maps the hashes of
    blocks to their names.

    Each mark above a block shows the chains of some agents. The marks are sorted by the lowest ID of these agents.
    """
    root = ChainTreeMark("block", [inception], ["inception block"], inception.holders)
    to_grow = [(root, inception)]
    while to_grow:
        mark, node = to_grow.pop()
        if node.ends:
            oval = ChainTreeMark("oval", [node], wrapped(ranges(node.ends)), node.ends)
            if node.children:
                mark.beside = oval
            else:
                mark.children.append(oval)
        for child in node.children.values():
            top, last = _stretch(mark, child, names, abridged)
            to_grow.append((top, last))
        mark.children.sort(key=lambda standing: standing.holders[0])
    return root


def _stretch(
    below: ChainTreeMark, first: ChainTreeNode, names: Mapping[str, str], abridged: bool
) -> tuple[ChainTreeMark, ChainTreeNode]:
    """Add marks for consecutive blocks above the mark `below`. These blocks begin with `first`, and end with the next
    block at which the tree branches or a chain ends.

    Return the topmost mark and its node.
    """
    stretch = [first]
    while stretch[-1].is_plain:
        stretch.extend(stretch[-1].children.values())
    hidden = range(0)
    if abridged and len(stretch) >= 2 * KEPT_AT_EACH_END + FEWEST_HIDDEN:
        hidden = range(KEPT_AT_EACH_END, len(stretch) - KEPT_AT_EACH_END)
    top = below
    for height, node in enumerate(stretch):
        if height in hidden[1:]:
            continue
        if height in hidden:
            mark = ChainTreeMark(
                "ellipsis", stretch[hidden.start : hidden.stop], [str(len(hidden)), "blocks"], node.holders
            )
        else:
            mark = ChainTreeMark("block", [node], [_name(node, names)], node.holders)
        top.children.append(mark)
        top = mark
    return top, stretch[-1]


def _name(node: ChainTreeNode, names: Mapping[str, str]) -> str:
    return names[node.block.block_hash] if node.block else "inception block"


def ranges(agent_ids: list[int]) -> list[str]:
    """Return agent IDs as texts. Three or more consecutive IDs become one text with an en dash: [1, 2, 3, 5, 6] gives
    "1 to 3", "5", "6", with an en dash in place of "to".
    """
    runs: list[list[int]] = []
    for agent_id in sorted(agent_ids):
        if runs and agent_id == runs[-1][-1] + 1:
            runs[-1].append(agent_id)
        else:
            runs.append([agent_id])
    texts: list[str] = []
    for run in runs:
        texts += [f"{run[0]}\u2013{run[-1]}"] if len(run) > 2 else [str(agent_id) for agent_id in run]
    return texts


def wrapped(parts: list[str]) -> list[str]:
    """Join the parts with commas. Divide the resulting text into lines of similar length."""
    characters = len(", ".join(parts))
    widest = max(OVAL_LINE_CHARACTERS, round((2.5 * characters) ** 0.5))
    even = math.ceil(characters / math.ceil(characters / widest)) + 1
    lines = [""]
    for position, part in enumerate(parts):
        text = part if position == len(parts) - 1 else f"{part}, "
        if lines[-1] and len(lines[-1]) + len(text.rstrip()) > even:
            lines.append("")
        lines[-1] += text
    return [line.rstrip() for line in lines]


FONT_SIZE = 13
CHARACTER_WIDTH = 0.66 * FONT_SIZE
"""Upper limit for the width of a digit or lower-case letter in common system fonts, in pixels. DejaVu Sans and Verdana
have 0.64 em.
"""
SMALL_FONT_SIZE = 12
BOX_HEIGHT = 26
LINE_HEIGHT = 17
PADDING = 7
COLUMN_GAP = 10
OVAL_GAP = 18
ROW_GAP = 24
ROW_HEIGHT = BOX_HEIGHT + ROW_GAP
MARGIN = 8


@dataclass(slots=True)
class PlacedMark:
    """A mark of the picture (a box, an oval or an ellipsis) with its position in CSS pixels. `x` is the horizontal
    centre of the mark, and `y` is its upper edge. `y` increases downwards.
    """

    mark: ChainTreeMark
    width: float
    height: float
    row: int
    x: float = 0.0
    y: float = 0.0
    children: list["PlacedMark"] = field(default_factory=list)
    beside: "PlacedMark | None" = None

    @property
    def rows(self) -> range:
        """The rows that the mark occupies together with the gap above it. Row 0 is the lowest row."""
        return range(self.row, self.row + math.ceil((self.height + ROW_GAP) / ROW_HEIGHT))

    def walk(self) -> Iterator["PlacedMark"]:
        """Yield this mark and all marks above it. A mark is yielded after the mark below it."""
        to_visit = [self]
        while to_visit:
            placed = to_visit.pop()
            yield placed
            if placed.beside:
                yield placed.beside
            to_visit.extend(reversed(placed.children))


@dataclass(slots=True)
class ChainTreeLayout:
    root: PlacedMark
    width: float
    height: float


class _SubtreeOutline:
    """The outline of a subtree: the leftmost and the rightmost position in each row, as distances from the root of the
    subtree.
    """

    def __init__(self) -> None:
        self.shift = 0.0
        self._rows: dict[int, tuple[float, float]] = {}

    def add(self, rows: range, width: float) -> None:
        for row in rows:
            self._rows[row] = (-width / 2 - self.shift, width / 2 - self.shift)

    def distance_to(self, right: "_SubtreeOutline", gap: float = COLUMN_GAP) -> float:
        """Return the distance at which the root of the subtree `right` must be placed on the right of this root. This
        is the smallest distance that keeps `gap` free between the two subtrees.
        """
        shared = self._rows.keys() & right._rows.keys()
        return max(
            (self._rows[row][1] + self.shift - right._rows[row][0] - right.shift + gap for row in shared),
            default=0.0,
        )

    def merged_with(self, other: "_SubtreeOutline", x: float) -> "_SubtreeOutline":
        """Merge two outlines, and return the result. The root of `other` is `x` to the right of this root. The two old
        outlines become invalid, so the caller must not use them again.
        """
        other.shift += x
        large, small = (self, other) if len(self._rows) >= len(other._rows) else (other, self)
        by = small.shift - large.shift
        for row, (left, right) in small._rows.items():
            far_left, far_right = large._rows.get(row, (left + by, right + by))
            large._rows[row] = (min(far_left, left + by), max(far_right, right + by))
        return large


def lay_out(root: ChainTreeMark) -> ChainTreeLayout:
    placed = _sized(root)
    placed_marks = list(placed.walk())
    offsets = _offsets(placed_marks)
    for item in placed_marks:
        for child in item.children:
            child.x = item.x + offsets[id(child)]
        if item.beside:
            item.beside.x = item.x + offsets[id(item.beside)]
    left = min(item.x - item.width / 2 for item in placed_marks) - MARGIN
    right = max(item.x + item.width / 2 for item in placed_marks) + MARGIN
    floor = max(item.row * ROW_HEIGHT + item.height for item in placed_marks) + MARGIN
    for item in placed_marks:
        item.x -= left
        item.y = floor - item.row * ROW_HEIGHT - item.height
    return ChainTreeLayout(placed, right - left, floor + MARGIN)


def _sized(root: ChainTreeMark) -> PlacedMark:
    """Return the marks of the picture with their sizes and rows, but without positions.

    All boxes are as wide as the longest label, except the box of the inception block.
    """
    names = [0]
    to_measure = list(root.children)
    while to_measure:
        mark = to_measure.pop()
        names += [len(line) for line in mark.lines if mark.kind == "block"]
        to_measure.extend(mark.children)
    box_width = _width(max(names))

    def sized(mark: ChainTreeMark, row: int) -> PlacedMark:
        if mark.kind == "ellipsis":
            longest = max(len(line) for line in mark.lines)
            return PlacedMark(mark, longest * CHARACTER_WIDTH * SMALL_FONT_SIZE / FONT_SIZE, BOX_HEIGHT, row)
        width = max(_width(len(line)) for line in mark.lines)
        if mark.kind == "block":
            width = max(width, box_width)
        return PlacedMark(mark, width, BOX_HEIGHT + (len(mark.lines) - 1) * LINE_HEIGHT, row)

    placed = sized(root, 0)
    to_size = [placed]
    while to_size:
        below = to_size.pop()
        below.children = [sized(mark, below.row + 1) for mark in below.mark.children]
        if below.mark.beside:
            below.beside = sized(below.mark.beside, below.row)
        to_size.extend(below.children)
    return placed


def _width(characters: int) -> float:
    return float(round(characters * CHARACTER_WIDTH + 2 * PADDING))


def _offsets(placed_marks: list[PlacedMark]) -> dict[int, float]:
    """Return the horizontal distance between each mark and the mark below it. A key is the Python object ID of a
    mark.
    """
    offsets: dict[int, float] = {}
    outlines: dict[int, _SubtreeOutline] = {}
    beside = {id(item.beside) for item in placed_marks}
    for item in reversed(placed_marks):
        if id(item) in beside:
            continue
        outline = _SubtreeOutline()
        positions: list[float] = []
        for child in item.children:
            right = outlines.pop(id(child))
            x = outline.distance_to(right)
            positions.append(x)
            outline = outline.merged_with(right, x)
        own = _root_position(item, positions)
        outline.shift -= own
        outline.add(item.rows, item.width)
        if item.beside:
            oval = _SubtreeOutline()
            oval.add(item.beside.rows, item.beside.width)
            offsets[id(item.beside)] = outline.distance_to(oval, OVAL_GAP)
            outline = outline.merged_with(oval, offsets[id(item.beside)])
        outlines[id(item)] = outline
        for child, x in zip(item.children, positions, strict=True):
            offsets[id(child)] = x - own
    return offsets


def _root_position(item: PlacedMark, positions: list[float]) -> float:
    for child, x in zip(item.children, positions, strict=True):
        if 2 * len(child.mark.holders) > len(item.mark.holders):
            return x
    return (positions[0] + positions[-1]) / 2 if positions else 0.0
