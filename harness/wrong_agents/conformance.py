"""`python -m harness.wrong_agents.conformance [QUIRK ...]`: what conformance finds of each wrong agent, over UDP.

Rows for these quirks, or for all, are put into docs/conformance.md; the words around them are written by hand.
"""

import sys
import time
from collections import Counter
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from harness.conformance.results import Results
from harness.conformance.run import Asked, conform
from harness.conformance.vectors import Vectors, generate
from harness.errors import HarnessError
from harness.matrix.thesis import put_between_markers
from harness.wrong_agents import quirky
from harness.wrong_agents.page import rows_of
from ucp.files import write_atomically
from ucp.quirks import QUIRKS

PAGE = Path(__file__).parents[2] / "docs" / "conformance.md"
ENOUGH = 6
"""Suspicions, after which no more are looked for."""
LIMIT_S = 30.0
"""Of the tours of one agent: many vectors are not tried then, but most wrong agents have shown themselves."""
HEADER = "| quirk | Algorithm | what the agent does wrong | named | failed | s |\n|---|--:|---|---|--:|--:|\n"
NOTHING = "**nothing**"
HIDDEN: dict[str, str] = {}
"""Quirk -> why nobody can see it from outside."""


def test(quirk: str, limit_s: float = LIMIT_S) -> Results:
    """Raises HarnessError."""
    command = (sys.executable, "-P", "-m", quirky.__name__, quirk)
    with TemporaryDirectory(prefix="ucp-conformance-") as place:
        asked = Asked(command, None, None, by_hand=False, enough=ENOUGH, limit_s=limit_s)
        return conform(asked, Path(place), lambda count, total: None, _vectors())


@cache
def _vectors() -> list[Vectors]:
    """Those of the default settings."""
    return generate()[:1]


def row(quirk: str, results: Results) -> str:
    """A line of the table: which Algorithms are named, and how often."""
    about = QUIRKS[quirk]
    named = Counter(case.algorithm for case in results.failures)
    words = ", ".join(f"{algorithm or 'program'} ({count})" for algorithm, count in named.most_common())
    cells = [
        f"`{quirk}`",
        ", ".join(map(str, about.algorithms)),
        about.sentence,
        words or f"{NOTHING}{': ' + HIDDEN[quirk] if quirk in HIDDEN else ''}",
        str(len(results.failures)),
        f"{results.wall_s:.0f}",
    ]
    return f"| {' | '.join(cells)} |\n"


def main(names: Sequence[str]) -> None:
    """Test these quirks, or all if none is named; the rows of the others stay as they are."""
    for quirk in names or QUIRKS:
        began = time.monotonic()
        try:
            results = test(quirk)
        except HarnessError as error:
            sys.stderr.write(f"{quirk}: {error}\n")
            continue
        line = row(quirk, results)
        sys.stdout.write(f"{line.strip()} {time.monotonic() - began:.0f} s\n")
        sys.stdout.flush()
        page = PAGE.read_text(encoding="utf-8")
        rows = rows_of(page) | {quirk: line}
        write_atomically(
            PAGE, put_between_markers(page, HEADER + "".join(rows[name] for name in QUIRKS if name in rows))
        )


if __name__ == "__main__":
    main(sys.argv[1:])
