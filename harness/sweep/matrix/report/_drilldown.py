"""List the runs of each cell, with failed runs first and a command that plays one of the runs again."""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

from harness.present import text
from harness.report.verdict_section import ICONS
from harness.scenario.verdict_names import RUN_CHECKS, kind_of
from harness.sweep.matrix._cell import Run, is_wrong
from harness.sweep.matrix._cell_play import directory_name
from harness.sweep.matrix._matrix_file import scenario_file
from harness.sweep.matrix.matrix_run import Finished
from harness.sweep.matrix.matrix_table import name_of
from harness.sweep.matrix.report._heatmap import anchor

MAX_ROWS = 12_000
"""Maximum number of rows of all cells together. With this limit, the page stays below 3 MB."""


@dataclass(frozen=True, slots=True)
class RunRow:
    """A table row about one run."""

    seed: int
    href: str | None
    """The link to the report of the run. None if the run directory was not kept."""
    verdicts: list[str]
    figures: list[str]
    failed: str | None
    """The reason why the run has no verdicts, if it is an error. None otherwise."""
    unsupported: str | None
    """The feature that an agent lacks, so the run has no verdicts, or None."""


@dataclass(frozen=True, slots=True)
class CellRuns:
    """The runs of one summary. `left_out` is the number of runs for which the table has no row."""

    anchor: str
    name: str
    runs: str
    command: str
    figures: list[str]
    rows: list[RunRow]
    left_out: int


def drilldown(finished: Finished, directory: Path) -> list[CellRuns]:
    """Return the runs of each cell, with failed and bad runs first. `directory` is the directory of the page. Links are
    relative to it.
    """
    by_point = [(point, list(runs)) for point, runs in groupby(finished.runs, key=lambda run: run.point)]
    room = MAX_ROWS // max(1, len(by_point))
    cells = []
    for point, runs in by_point:
        runs.sort(key=lambda run: (run.failed is None, not _bad(run), run.judged))
        figures = list(dict.fromkeys(name for run in runs for name in run.figures if name != "agents"))
        played = ["ucp-harness", "run", scenario_file(point), "--backend", point.backend, "--seed", str(runs[0].seed)]
        cells.append(
            CellRuns(
                anchor(point),
                name_of(finished.record.matrix, point),
                _count(runs),
                shlex.join(played),
                [text.label(name) for name in figures],
                [_row(run, figures, directory) for run in runs[:room]],
                max(0, len(runs) - room),
            )
        )
    return cells


def _count(runs: Sequence[Run]) -> str:
    counts = [f"{text.value(len(runs))} run{'s' if len(runs) > 1 else ''}"]
    if number := sum(map(_bad, runs)):
        counts.append(f"{number} with violations")
    if number := sum(run.failed is not None for run in runs):
        counts.append(f"{number} failed")
    if number := sum(run.unsupported is not None for run in runs):
        counts.append(f"{number} not supported")
    return ", ".join(counts)


def _bad(run: Run) -> bool:
    return any(map(is_wrong, run.verdicts.values()))


def _row(run: Run, figures: Sequence[str], directory: Path) -> RunRow:
    kept = f"runs/{directory_name(run.task)}/report.html"
    return RunRow(
        run.seed,
        kept if (directory / kept).exists() else None,
        [] if not run.judged else [ICONS[kind_of(run.verdicts.get(key, ""))] for key in RUN_CHECKS],
        [] if not run.judged else [text.value(run.figures.get(name)) for name in figures],
        run.failed,
        run.unsupported,
    )
