"""Draw a picture of the imports between the packages of the harness for `docs/explanation/architecture.md`."""

import ast
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]
MARK = "<!-- rooms -->"
CELL, LEFT, TOP, BOX = 26, 110, 96, 22


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    if MARK not in markdown:
        return markdown
    rooms = re.findall(
        r"^\| \[(\w+)/\]\(\.\./\.\./harness/\w+\)", markdown.split("In [harness/](../../harness)")[1], re.MULTILINE
    )
    return markdown.replace(MARK, picture(rooms, uses(rooms)))


def uses(rooms: list[str]) -> Counter[tuple[str, str]]:
    """Count, for each pair of packages, the files of the first package that import the second package."""
    counted: Counter[tuple[str, str]] = Counter()
    for room in rooms:
        for path in (ROOT / "harness" / room).rglob("*.py"):
            counted.update((room, other) for other in set(_imported(path)) & {*rooms} - {room})
    return counted


def _imported(path: Path) -> Iterator[str]:
    """Yield the packages that a file imports."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("harness."):
            yield node.module.split(".")[1]


def picture(rooms: list[str], counted: Counter[tuple[str, str]]) -> str:
    """Return an SVG table of imports with a row for each package. A darker cell means that more files import the
    package.
    """
    size = len(rooms) * CELL
    most = max(counted.values())
    parts = []
    for at, room in enumerate(rooms):
        y = TOP + at * CELL
        parts.append(f'<text x="{LEFT - 8}" y="{y + 15}" text-anchor="end">{room}</text>')
        x = LEFT + at * CELL + 14
        parts.append(f'<text transform="translate({x},{TOP - 8}) rotate(-60)">{room}</text>')
        parts.append(f'<rect x="{LEFT + at * CELL}" y="{y}" width="{BOX}" height="{BOX}" class="self"/>')
        for other, name in enumerate(rooms):
            if number := counted[room, name]:
                shade = 0.25 + 0.75 * number / most
                title = f"{number} of the files in {room}/ use {name}/"
                place = f'x="{LEFT + other * CELL}" y="{y}" width="{BOX}" height="{BOX}"'
                parts.append(f'<rect {place} class="uses" fill-opacity="{shade:.2f}"><title>{title}</title></rect>')
    frame = f'viewBox="0 0 {LEFT + size + 60} {TOP + size}" style="max-width: {LEFT + size + 60}px"'
    label = f"Imports between {len(rooms)} rooms: each room imports only rooms before it"
    return f'<svg class="rooms" role="img" aria-label="{label}" {frame}>{"".join(parts)}</svg>'
