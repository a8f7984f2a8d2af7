"""Run the comparisons in order of their cost, and record which comparison first detects each planted mistake."""

import hashlib
import json
import re
import sys
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

from harness.proof.bounds import Bounds, Network
from harness.proof.specification import _tlc
from harness.run.parallel import FailedTask, cores, sweep
from tests.harness.proof.specification.mutation.comparisons import (
    NO_GAP,
    READINGS,
    Comparison,
    DirectedInputs,
    RandomInputs,
    States,
)
from tests.harness.proof.specification.mutation.edits import Edit, edits, specification
from ucp.agent_files import write_atomically

SCORE_FILE = Path(__file__).with_name("score.json")
PAGE = Path(__file__).parents[5] / "docs" / "explanation" / "specification.md"
BEGIN, END = "<!-- score: begin -->", "<!-- score: end -->"


def _states(agents: int, blocks: int, network: Network, settings: Mapping[str, Any] = {}, **keys: Any) -> States:
    keys = {"timers_any": True, "reduced": False, **keys}
    return States(Bounds(agents, blocks, network, settings=settings, **keys))


OTHER_SETTINGS = tuple({**READINGS, **NO_GAP}.items())
"""Settings of an agent, with as many differences from the defaults as the specification supports."""

COMPARISONS: tuple[Comparison, ...] = (
    _states(2, 1, "lossy"),
    _states(2, 2, "lossless"),
    _states(2, 2, "lossy"),
    _states(2, 3, "lossless"),
    _states(3, 2, "lossless"),
    _states(3, 2, "lossless", READINGS),
    _states(2, 3, "lossless", NO_GAP, timers_any=False),
    DirectedInputs(),
    DirectedInputs(OTHER_SETTINGS),
    RandomInputs(),
    RandomInputs(OTHER_SETTINGS),
)
"""All comparisons, in the order in which they run. Tests also run each with the specification without an edit."""
BATCH = 16
"""Number of edited specifications that a comparison tests at once."""


class MistakeResult(NamedTuple):
    """The result for one mistake.

    `by` is the first comparison that detects the mistake, and `difference` is the difference that it finds. Both are
    None if no comparison detects the mistake.
    """

    text: str
    """The digest of the edited specification."""
    by: str | None = None
    difference: str | None = None
    missed_by: tuple[str, ...] = ()
    """Names of the comparisons that do not detect the mistake."""


def digest(edit: Edit) -> str:
    """Return a digest of the specification with the mistake. Comments do not affect the digest."""
    texts = edit.applied(specification()), (_tlc.MODULES / "Swarm.tla").read_text("utf-8")
    code = [" ".join(re.sub(r"\(\*.*?\*\)|\\\*[^\n]*", "", text, flags=re.DOTALL).split()) for text in texts]
    return hashlib.sha256("\n".join(code).encode()).hexdigest()[:16]


def stored() -> dict[str, MistakeResult]:
    """Return the results of `score.json` by the name of the edit."""
    if not SCORE_FILE.exists():
        return {}
    results = json.loads(SCORE_FILE.read_text("utf-8"))
    return {
        name: MistakeResult(text, by, difference, tuple(missed))
        for name, (text, by, difference, missed) in results.items()
    }


def store(results: Mapping[str, MistakeResult]) -> None:
    """Write `score.json`. Each mistake has one line."""
    lines = [f"{json.dumps(edit.name)}: {json.dumps(results[edit.name])}" for edit in edits() if edit.name in results]
    write_atomically(SCORE_FILE, "{\n" + ",\n".join(lines) + "\n}\n")


def main() -> int:
    """Test each mistake that has no valid result yet, and store the results."""
    valid = stored()
    results = {edit.name: MistakeResult(digest(edit)) for edit in edits()}
    results |= {name: valid[name] for name, new in results.items() if name in valid and valid[name].text == new.text}
    jobs = int(sys.argv[1]) if len(sys.argv) > 1 else cores()
    for comparison in COMPARISONS:
        _find(comparison, results, jobs)
    store(results)
    write_page()
    return 0


def _find(comparison: Comparison, results: dict[str, MistakeResult], jobs: int) -> None:
    """Run a comparison for each mistake that no earlier comparison detected, and record the differences."""
    name = comparison.name
    waiting = [edit for edit in edits() if (found := results[edit.name]).by is None and name not in found.missed_by]
    if not waiting:
        return
    comparison.prepare()
    batches = [waiting[start : start + BATCH] for start in range(0, len(waiting), BATCH)]

    def compare(batch: Sequence[Edit]) -> list[str | None]:
        return comparison.differences([edit.applied(specification()) for edit in batch])

    with sweep(batches, compare, jobs, what=name, in_order=False) as outcomes:
        for batch, outcome in outcomes:
            if isinstance(outcome, FailedTask):
                raise RuntimeError(f"{name}: {outcome.reason}")
            for edit, difference in zip(batch, outcome, strict=True):
                found = results[edit.name]
                if difference is None:
                    results[edit.name] = found._replace(missed_by=(*found.missed_by, name))
                else:
                    results[edit.name] = found._replace(by=name, difference=difference)
            store(results)


def _row(title: str, group: Sequence[Edit], results: Mapping[str, MistakeResult]) -> str:
    found = sum(results[edit.name].by is not None for edit in group)
    without_effect = sum(edit.reason is not None for edit in group)
    return f"| {title} | {len(group)} | {found} | {without_effect} | {len(group) - found - without_effect} |"


def tables() -> str:
    """Return the tables of the page: the number of mistakes in each Algorithm, and the comparisons that first detect
    them.
    """
    results = stored()
    lines = ["| Algorithm | mistakes | found | without effect | open |", "|--:|--:|--:|--:|--:|"]
    for algorithm, group in groupby(edits(), lambda edit: edit.algorithm):
        lines.append(_row(str(algorithm) if algorithm else "shared text", list(group), results))
    lines.append(_row("all", edits(), results))
    lines += ["", "| mistake without effect | reason |", "|---|---|"]
    lines += [f"| {edit.name} | {edit.reason.because} |" for edit in edits() if edit.reason]
    lines += ["", "| comparison | mistakes tried | found |", "|---|--:|--:|"]
    for comparison in COMPARISONS:
        finds = sum(result.by == comparison.name for result in results.values())
        tried = finds + sum(comparison.name in result.missed_by for result in results.values())
        lines.append(f"| {comparison.name} | {tried} | {finds} |")
    return "\n".join(lines) + "\n"


def write_page() -> None:
    """Write the tables into the page."""
    head, _, rest = PAGE.read_text("utf-8").partition(BEGIN)
    _, _, tail = rest.partition(END)
    write_atomically(PAGE, f"{head}{BEGIN}\n{tables()}\n{END}{tail}")
