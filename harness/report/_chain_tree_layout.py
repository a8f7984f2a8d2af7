"""Compute the positions of all marks in a picture of the chain tree. Time grows upwards, and columns do not overlap.

Each subtree is placed as close as possible to the subtrees on its left. Their outlines are compared row by row (after
Reingold and Tilford, "Tidier Drawings of Trees", 1981). A block is below the middle of its successors. If more than
half of the agents have the same successor, this successor is exactly above the block, and the others are at its sides.
An oval marks the end of chains. It is above the last block of these chains, or on its right if other chains continue
above it.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

from harness.report.chain_tree import ChainTreeMark

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
        """Merge two outlines, and return the result. The root of `other` is `x` to the right of this root. The caller
        may not use the two old outlines again.
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
    """Return the horizontal distance between each mark and the mark below it. The keys are the Python object IDs of the
    marks.
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
