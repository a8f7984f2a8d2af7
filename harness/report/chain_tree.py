"""The system-wide result as a tree: the agents' chains, together where they agree and apart where they do not.

A block stands in the tree once per history that it follows, so one that diverged agents both hold is on two branches
(Figure 4.4). `marks` turns the tree into what is drawn: a box per block, an oval where agents' chains end and, if
asked, an ellipsis for the middle of a long branchless stretch.

Chains are long and Python's stack is not: everything here loops instead of recursing.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from harness.archive.exports import Export, ExportedBlock

KEPT_AT_EACH_END = 3
"""Blocks of a stretch that are drawn before and after its ellipsis."""
FEWEST_HIDDEN = 3
"""An ellipsis for less would save no room."""

OVAL_LINE_CHARACTERS = 14


@dataclass(slots=True)
class Node:
    """A block after one history, or the inception block (`block` is None)."""

    block: ExportedBlock | None
    holders: list[int] = field(default_factory=list)
    """Agents whose chain follows this history up to here or beyond."""
    ends: list[int] = field(default_factory=list)
    """Agents whose chain ends here."""
    children: dict[str, "Node"] = field(default_factory=dict)

    @property
    def is_plain(self) -> bool:
        """A block after which nothing happens but the next."""
        return self.block is not None and len(self.children) == 1 and not self.ends


@dataclass(slots=True)
class Mark:
    """Something to draw, and what stands on it."""

    kind: Literal["block", "ellipsis", "oval"]
    nodes: list[Node]
    """The block; the blocks hidden by an ellipsis; the block at which an oval's agents end."""
    lines: list[str]
    holders: list[int]
    children: list["Mark"] = field(default_factory=list)
    beside: "Mark | None" = None
    """The oval of a block that some chains end at and others go on from."""


def chain_tree(exports: Mapping[int, Export]) -> Node:
    """The inception block, and above it the chains of all agents."""
    inception = Node(None)
    for agent_id, export in sorted(exports.items()):
        node = inception
        node.holders.append(agent_id)
        for block in export.chain:
            node = node.children.setdefault(block.block_hash, Node(block))
            node.holders.append(agent_id)
        node.ends.append(agent_id)
    return inception


def holders(exports: Mapping[int, Export]) -> dict[str, list[int]]:
    """Block hash -> the agents that have the block in their chain, whatever its history there."""
    held_by: dict[str, list[int]] = {}
    for agent_id, export in sorted(exports.items()):
        for block_hash in dict.fromkeys(export.chain_of_block_hashes):
            held_by.setdefault(block_hash, []).append(agent_id)
    return held_by


def marks(inception: Node, names: Mapping[str, str], *, abridged: bool) -> Mark:
    """What to draw, from the inception block up; `names` are those of `harness.archive.exports.name_blocks`.

    What stands on a block is ordered by the lowest agent ID that it leads to.
    """
    root = Mark("block", [inception], ["inception block"], inception.holders)
    to_grow = [(root, inception)]
    while to_grow:
        mark, node = to_grow.pop()
        if node.ends:
            oval = Mark("oval", [node], wrapped(ranges(node.ends)), node.ends)
            if node.children:
                mark.beside = oval
            else:
                mark.children.append(oval)
        for child in node.children.values():
            top, last = _stretch(mark, child, names, abridged)
            to_grow.append((top, last))
        mark.children.sort(key=lambda standing: standing.holders[0])
    return root


def _stretch(below: Mark, first: Node, names: Mapping[str, str], abridged: bool) -> tuple[Mark, Node]:
    """Put the blocks from `first` to the next that is not plain onto `below`; the topmost mark and its node."""
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
            mark = Mark("ellipsis", stretch[hidden.start : hidden.stop], [str(len(hidden)), "blocks"], node.holders)
        else:
            mark = Mark("block", [node], [_name(node, names)], node.holders)
        top.children.append(mark)
        top = mark
    return top, stretch[-1]


def _name(node: Node, names: Mapping[str, str]) -> str:
    return names[node.block.block_hash] if node.block else "inception block"


def ranges(agent_ids: list[int]) -> list[str]:
    """[1, 2, 3, 5, 6] -> 1 to 3, 5, 6: three or more in a row are a range, written with an en dash."""
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
    """The parts as one comma-separated text, broken into even lines that are wider the more there is to say."""
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
