"""Test agents with deliberate errors with the conformance test: `python -m docs.generate.wrong_agents.conformance_page
[QUIRK ...]`.

The vectors are played in virtual time. In virtual time, the test compares the same outputs as over UDP, and also the
expiry of the next timer. An agent that passes the vectors also plays the handwritten cases over UDP. The program writes
the table rows of the named quirks into docs/appendix/wrong-agents-conformance.md. Without an argument, it writes the
rows of all quirks. The text around the table is written by hand.
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
from harness.conformance.conformance_run import ConformanceRequest, conform
from harness.conformance.results import ConformanceResults
from harness.conformance.vectors import VectorSet, generate
from harness.errors import HarnessError
from ucp.agent_files import write_atomically
from ucp.quirks import QUIRKS

PAGE = Path(__file__).parents[3] / "docs/appendix/wrong-agents-conformance.md"
HEADER = "| quirk | Algorithm | mistake | named | failed | tried |\n|---|--:|---|---|--:|--:|\n"
NOTHING = "**nothing**"
ALIKE = {
    "count_no_votes": "commit_whatever_the_vote",
}
"""Quirk -> another quirk that has the same effect outside the agent but belongs to another Algorithm."""


def test(quirk: str) -> ConformanceResults:
    """Run the conformance test for an agent with this error, and return the results. Raises HarnessError if the test
    cannot run.
    """
    command = (sys.executable, "-P", "-m", quirky.__name__, quirk)
    with TemporaryDirectory(prefix="ucp-conformance-") as place:
        results = conform(ConformanceRequest(command, None, None, virtual=True), Path(place), _no_progress, _vectors())
    if results.failures:
        return results
    with TemporaryDirectory(prefix="ucp-conformance-") as place:
        by_hand = conform(ConformanceRequest(command, None, None), Path(place), _no_progress, [])
    return replace(by_hand, counted=results.counted)


def _no_progress(count: int, total: int) -> None:
    """Show no progress."""


@cache
def _vectors() -> list[VectorSet]:
    """Return the generated tests for the default settings."""
    return generate()[:1]


def row(quirk: str, results: ConformanceResults) -> str:
    """Return the table row of an error. It lists the accused Algorithms with the number of failures of each."""
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
    """Test the named errors, or all errors if none is named. Keep the other rows of the table."""
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
