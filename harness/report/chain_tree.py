"""Combine the chains of all agents into a tree. Chains that begin with the same blocks share the marks of these blocks.

A block appears once for each sequence of blocks below it. If agents with diverged chains hold the same block, the block
is therefore on two branches (Figure 4.4). `marks` converts the tree to the marks of a picture: a box for each block, an
oval where chains end, and on request an ellipsis for the middle of a long sequence without branches.

A chain can be longer than Python's recursion limit. All functions here use loops instead of recursion.
"""

import math
from collections.abc import Mapping
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
    """The IDs of the agents whose chains contain this block after the same earlier blocks."""
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
    """The nodes of this mark: the block of a box, the hidden blocks of an ellipsis, or the last block before an
    oval.
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
    blocks to their names. The marks above a block are ordered by the lowest ID of the agents whose chains they show.
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
