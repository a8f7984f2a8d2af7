"""Draw the tree of chains as SVG, as in Figures 4.1 to 4.7 of the thesis, with a colour for each agent.

The colours are attributes, so that programs without style sheets also draw them. `chain_tree.css` adds a dark scheme.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from markupsafe import Markup

from harness.archive.exports import Export, name_blocks
from harness.present import text as words
from harness.present.colours import AgentColours
from harness.present.svg import filled
from harness.report.chain_tree import (
    BOX_HEIGHT,
    FONT_SIZE,
    LINE_HEIGHT,
    SMALL_FONT_SIZE,
    ChainTreeLayout,
    ChainTreeNode,
    PlacedMark,
    chain_tree,
    holders,
    lay_out,
    marks,
    ranges,
)

STYLE = (Path(__file__).parent / "chain_tree.css").read_text(encoding="utf-8")

_FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', 'DejaVu Sans', sans-serif"
_INCEPTION = AgentColours("#ffffff", "#5c6670", "#1c2126")
_CORNER = 6
_TURN = 11  # distance above a block at which links to diverging successors turn
_FIRST_DOT, _DOT_SPACING = 5, 7
_DOTS_LENGTH = 2 * _DOT_SPACING + 1  # three dots; the last one lies just before the end


class ChainTreePicture:
    """A picture of the tree of chains.

    The picture can be drawn with all blocks, or without the middle of long sequences of blocks. `key` makes the
    identifiers unique on a page with several pictures. `names` maps the hashes of blocks to names, if the caller knows
    more names than the exports contain.
    """

    def __init__(
        self,
        exports: Mapping[int, Export],
        ink: Mapping[int, AgentColours],
        key: str = "chains",
        names: Mapping[str, str] | None = None,
    ) -> None:
        self.key = key
        self._ink = ink
        self._names = name_blocks(exports) if names is None else names
        self._held_by = holders(exports)
        self._tree = chain_tree(exports)
        self._abridged = lay_out(marks(self._tree, self._names, abridged=True))
        self.hidden = sum(
            len(placed.mark.nodes) for placed in self._abridged.root.walk() if placed.mark.kind == "ellipsis"
        )
        """Number of blocks that the short form of the picture omits."""

    def draw(self, form: Literal["abridged", "full"]) -> Markup:
        """Return the picture as SVG. The page that contains the picture must include STYLE. The page may show both
        forms of the picture.
        """
        if form == "abridged":
            return self._draw(self._abridged, form, Markup(""))
        return self._draw(lay_out(marks(self._tree, self._names, abridged=False)), form, Markup(""))

    def standalone(self) -> str:
        """Return the abridged picture as the text of an SVG file."""
        paper = Markup('<style>{}</style><rect class="ground" width="100%" height="100%" fill="#ffffff"/>').format(
            STYLE
        )
        return str(self._draw(self._abridged, "abridged", paper))

    def description(self) -> str:
        """Return a text that describes the picture."""
        agents = self._tree.holders
        if not agents:
            return "No chain: only the inception block."
        top, mutual = self._tree, 0
        while not top.ends and len(top.children) == 1:
            (top,) = top.children.values()
            mutual += 1
        count = "1 block" if mutual == 1 else f"{mutual} blocks"
        shared = f"{count}, up to {self._name(top)}" if mutual else "only the inception block"
        endings = []
        for placed in self._abridged.root.walk():
            if placed.mark.kind == "oval":
                end = placed.mark.nodes[0]
                where = f"at {self._name(end)}" if end.block else "at the inception block"
                endings.append(f"{_agents(placed.mark.holders)} {where}")
        return f"{_agents(agents)}: all share {shared}. Chains end: {'; '.join(endings)}."

    def _draw(self, layout: ChainTreeLayout, form: str, paper: Markup) -> Markup:
        links, threads, dots = [], [], []
        shapes = []
        for placed in layout.root.walk():
            shapes.append(self._shape(placed))
            if placed.beside:
                threads.append(_path_beside(placed, placed.beside))
            for child in placed.children:
                if "ellipsis" in (placed.mark.kind, child.mark.kind):
                    dots.append(f"M{_n(placed.x)} {_n(placed.y - _FIRST_DOT)}v-{_DOTS_LENGTH}")
                elif child.mark.kind == "oval":
                    threads.append(_path(placed, child))
                else:
                    links.append(_path(placed, child) + "m-4 6l4-6 4 6")
        return Markup(
            '<svg xmlns="http://www.w3.org/2000/svg" class="chains" role="img" width="{w}" height="{h}"'
            ' viewBox="0 0 {w} {h}" aria-labelledby="{id}-title {id}-desc" font-family="{font}" font-size="{size}"'
            ' text-anchor="middle" fill="none" stroke-width="1.5">'
            '<title id="{id}-title">Chain tree</title><desc id="{id}-desc">{desc}</desc>{paper}\n'
            '<path class="link" stroke="#5c6670" d="{links}"/>\n'
            '<path class="thread" stroke="#5c6670" stroke-dasharray="2 4" d="{threads}"/>\n'
            '<path class="link" stroke="#5c6670" stroke-width="3" stroke-linecap="round"'
            ' stroke-dasharray="0 {spacing}" d="{dots}"/>\n{shapes}</svg>\n'
        ).format(
            w=_n(layout.width),
            h=_n(layout.height),
            id=f"{self.key}-{form}",
            font=_FONT,
            size=FONT_SIZE,
            desc=self.description(),
            paper=paper,
            links="".join(links),
            threads="".join(threads),
            spacing=_DOT_SPACING,
            dots="".join(dots),
            shapes=Markup("").join(shapes),
        )

    def _shape(self, placed: PlacedMark) -> Markup:
        """Draw one mark. The tooltip of the mark lists the agents that hold the block."""
        mark = placed.mark
        text = _text(placed, "#1c2126")
        if mark.kind == "ellipsis":
            first, last = self._name(mark.nodes[0]), self._name(mark.nodes[-1])
            return filled(
                '<g class="ellipsis"><title>{} to {}, of {}</title>{}</g>\n', first, last, _agents(mark.holders), text
            )
        if mark.kind == "oval":
            return filled(
                '<g class="oval"><title>The chain of {} ends here</title>'
                '{} rx="{}" stroke="#5c6670" stroke-dasharray="2 4"/>{}</g>\n',
                _agents(mark.holders),
                _rectangle(placed),
                _n(BOX_HEIGHT / 2),
                text,
            )
        block = mark.nodes[0].block
        ink = self._ink[block.agent_id] if block else _INCEPTION
        return filled(
            '<g class="{}"><title>{}</title>{} rx="3" fill="{}" stroke="{}"{}/>{}</g>\n',
            "block" if block else "inception",
            self._tooltip(mark.nodes[0]),
            _rectangle(placed),
            ink.fill,
            ink.stroke,
            Markup(' stroke-dasharray="6 3"') if ink.dashed else "",
            _text(placed, ink.text),
        )

    def _tooltip(self, node: ChainTreeNode) -> str:
        if node.block is None:
            return f"Inception block, of {_agents(node.holders)}" if node.holders else "Inception block"
        held_by = self._held_by[node.block.block_hash]
        lines = [
            f"{self._name(node)}, made by agent {node.block.agent_id}",
            words.moment(node.block.timestamp_us),
            node.block.block_hash,
            f"in the chain of {_agents(held_by)}",
        ]
        if node.holders != held_by:
            lines.append(f"with this history: {_agents(node.holders)}")
        return "\n".join(lines)

    def _name(self, node: ChainTreeNode) -> str:
        return self._names[node.block.block_hash] if node.block else "inception block"


def _path(below: PlacedMark, above: PlacedMark) -> str:
    """Return an SVG path from the top of one mark to the bottom of the mark above it. If the marks are not aligned, the
    path has two corners.
    """
    start, end = below.y, above.y + above.height
    if above.x == below.x:
        return f"M{_n(below.x)} {_n(start)}V{_n(end)}"
    side = 1 if above.x > below.x else -1
    corner = min(_CORNER, abs(above.x - below.x) / 2)
    turn = start - _TURN
    return (
        f"M{_n(below.x)} {_n(start)}V{_n(turn + corner)}q0 {_n(-corner)} {_n(side * corner)} {_n(-corner)}"
        f"H{_n(above.x - side * corner)}q{_n(side * corner)} 0 {_n(side * corner)} {_n(-corner)}V{_n(end)}"
    )


def _path_beside(block: PlacedMark, oval: PlacedMark) -> str:
    """Return an SVG path from the right side of a block to the oval beside it."""
    middle = block.y + block.height / 2
    return f"M{_n(block.x + block.width / 2)} {_n(middle)}H{_n(oval.x - oval.width / 2)}"


def _rectangle(placed: PlacedMark) -> Markup:
    """Return the beginning of a `<rect>` element."""
    return filled(
        '<rect x="{}" y="{}" width="{}" height="{}"',
        _n(placed.x - placed.width / 2),
        _n(placed.y),
        _n(placed.width),
        _n(placed.height),
    )


def _text(placed: PlacedMark, colour: str) -> Markup:
    small = placed.mark.kind == "ellipsis"
    line_height, size = (BOX_HEIGHT / 2, SMALL_FONT_SIZE) if small else (LINE_HEIGHT, FONT_SIZE)
    first = placed.y + placed.height / 2 - (len(placed.mark.lines) - 1) * line_height / 2 + 0.36 * size
    return Markup("").join(
        filled(
            '<text x="{}" y="{}" fill="{}"{}>{}</text>',
            _n(placed.x),
            _n(first + number * line_height),
            colour,
            Markup(' font-size="{}"').format(size) if small else "",
            line,
        )
        for number, line in enumerate(placed.mark.lines)
    )


def _agents(agent_ids: list[int]) -> str:
    return f"agent {agent_ids[0]}" if len(agent_ids) == 1 else f"agents {', '.join(ranges(agent_ids))}"


def _n(number: float) -> str:
    return f"{number:.1f}".removesuffix(".0")
