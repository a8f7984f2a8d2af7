"""`python -m docs.generate.wrong_agents.conformance_page [QUIRK ...]`: what conformance finds of each wrong agent.

The vectors are played in virtual time, which sees what is seen over UDP and the instant at which the next timer ends;
of an agent that passes them the cases by hand are played, over UDP. Rows for these quirks, or for all, are put into
docs/how-to/test-one-agent.md; the words around them are written by hand.
"""

import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from docs.generate.matrix_thesis import put_between_markers
from docs.generate.wrong_agents import quirky
from docs.generate.wrong_agents.trials_page import rows_of
from harness.conformance.conformance_run import Asked, conform
from harness.conformance.results import Results
from harness.conformance.vectors import Vectors, generate
from harness.errors import HarnessError
from ucp.agent_files import write_atomically
from ucp.quirks import QUIRKS

PAGE = Path(__file__).parents[3] / "docs/how-to/test-one-agent.md"
HEADER = "| quirk | Algorithm | what the agent does wrong | named | failed | tried |\n|---|--:|---|---|--:|--:|\n"
NOTHING = "**nothing**"
ALIKE = {
    "count_no_votes": "commit_whatever_the_vote",
}
"""Quirk -> another, of another Algorithm, that looks the same from outside."""


def test(quirk: str) -> Results:
    """Raises HarnessError."""
    command = (sys.executable, "-P", "-m", quirky.__name__, quirk)
    with TemporaryDirectory(prefix="ucp-conformance-") as place:
        results = conform(Asked(command, None, None, virtual=True), Path(place), _told, _vectors())
    if results.failures:
        return results
    with TemporaryDirectory(prefix="ucp-conformance-") as place:
        by_hand = conform(Asked(command, None, None), Path(place), _told, [])
    return replace(by_hand, counted=results.counted)


def _told(count: int, total: int) -> None:
    """Progress is not shown."""


@cache
def _vectors() -> list[Vectors]:
    """Those of the default settings."""
    return generate()[:1]


def row(quirk: str, results: Results) -> str:
    """A line of the table: which Algorithms are named, and how often."""
    about = QUIRKS[quirk]
    named = Counter(case.algorithm for case in results.failures)
    words = ", ".join(f"{algorithm or 'program'} ({count})" for algorithm, count in named.most_common())
    if quirk in ALIKE:
        words += f": as `{ALIKE[quirk]}`"
    cells = [
        f"`{quirk}`",
        ", ".join(map(str, about.algorithms)),
        about.sentence,
        words or NOTHING,
        str(len(results.failures)),
        str(sum(row.tried for row in results.rows())),
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
