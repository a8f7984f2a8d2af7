"""Write the output files of a matrix.

matrix.json   the complete results, schema `ucp-matrix/1`
matrix.csv    one row for each cell
runs.csv      one row for each run: loss, agents, backend, mission length if it is an axis, seed, figures, verdicts
matrix.svg    the picture
growth.svg    growth with the swarm or the mission, if the matrix has three sizes of one of them
report.html   a page for people, one file
summary.md    table and findings in Markdown
junit.xml     one test case for each cell

All of these files are made from results.jsonl, which is written during the runs (`_results_file`). runs/ holds the kept
run directories of processes. cells/ holds the scenarios, with which any run can be played again.
"""

import csv
import io
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from harness.errors import MachineError
from harness.present.junit import JunitCase, to_xml
from harness.scenario.verdict_names import CHARACTERISTICS, ENDED, FURTHER_CHECKS, RUN_CHECKS
from harness.sweep.matrix._cell import Cell, Run
from harness.sweep.matrix._estimate import METRICS
from harness.sweep.matrix._growth_picture import draw_growth
from harness.sweep.matrix._matrix_file import MatrixPoint, write_scenarios
from harness.sweep.matrix._matrix_picture import draw
from harness.sweep.matrix.matrix_record import MatrixRecord
from harness.sweep.matrix.matrix_run import Finished
from harness.sweep.matrix.matrix_table import name_of, to_markdown, troubles, unsupported
from harness.sweep.matrix.nights import StoredNights
from harness.sweep.matrix.report import to_html
from ucp.agent_files import write_atomically, write_json_atomically


def to_junit(record: MatrixRecord) -> str:
    """Return the results of a matrix as JUnit XML.

    The test case of a cell fails if one of its runs failed or has a bad verdict, or if the cell is worse than in the
    earlier night. A cell with missing or unsupported runs is skipped.
    """
    return to_xml(record.matrix.name, "matrix", record.started_at, record.wall_s, _cases(record))


def _cases(record: MatrixRecord) -> Iterator[JunitCase]:
    cells = {cell.point: cell for cell in record.cells}
    for point in record.matrix.points:
        name, cell = name_of(record.matrix, point), cells.get(point)
        if wrong := list(troubles(record, cell)) if cell else []:
            yield JunitCase(name, wrong)
        elif lacking := list(unsupported(record, cell)) if cell else []:
            yield JunitCase(name, skipped="; ".join(lacking))
        elif cell is None or cell.runs < len(record.matrix.seed_list):
            ended = cell.runs if cell else 0
            why = "the time was used up" if record.outcome == "completed" else "interrupted"
            yield JunitCase(name, skipped=f"{why}: {ended} of {len(record.matrix.seed_list)} runs had ended")
        else:
            yield JunitCase(name)


def write(finished: Finished, directory: Path, nights: StoredNights | None = None) -> None:
    """Write all output files. `nights` contains earlier results, which are drawn as a trend. Raises MachineError if a
    file cannot be written.
    """
    record = finished.record
    try:
        write_json_atomically(directory / "matrix.json", record.to_json())
        write_atomically(directory / "matrix.csv", to_csv(_cell_row(cell) for cell in record.cells))
        write_atomically(directory / "runs.csv", to_csv(run_rows(finished.runs)))
        write_atomically(directory / "matrix.svg", draw(record))
        if record.matrix.grows:
            write_atomically(directory / "growth.svg", draw_growth(record))
        write_scenarios(record.matrix, directory)
        write_atomically(directory / "report.html", to_html(finished, directory, nights))
        write_atomically(directory / "summary.md", to_markdown(record))
        write_atomically(directory / "junit.xml", to_junit(record))
    except OSError as error:
        raise MachineError(f"{error.filename or directory} cannot be written: {error.strerror}") from None


def _cell_row(cell: Cell) -> dict[str, object]:
    row: dict[str, Any] = {
        **_place(cell.point),
        "runs": cell.runs,
        "failed": cell.failed,
        "unsupported": cell.unsupported,
    }
    for metric in METRICS:
        estimate = cell.estimates[metric.name]
        row |= {metric.name: estimate.mean, f"{metric.name}_low": estimate.low, f"{metric.name}_high": estimate.high}
    return row | {f"violated_{key}": len(cell.violated.get(key, [])) for key in RUN_CHECKS}


def _place(point: MatrixPoint) -> dict[str, object]:
    """Return the names of the table columns that identify a combination of values. If all runs have the same mission
    length, there is no column for it.
    """
    return {axis: value for axis, value in point._asdict().items() if value is not None}


def run_rows(runs: Sequence[Run]) -> Iterator[dict[str, Any]]:
    """Yield a row of `runs.csv` for each run. It contains the values of the matrix, the seed, the numeric results and
    the verdicts. For a run without results, it contains the reason.
    """
    figures = list(dict.fromkeys(name for run in runs for name in run.figures if name != "agents"))
    for run in runs:
        yield {
            **_place(run.point),
            "seed": run.seed,
            **{name: run.figures.get(name) for name in figures},
            **{f"characteristic_{number}": run.verdicts.get(number) for number in CHARACTERISTICS},
            **{key: run.verdicts.get(key) for key in (*FURTHER_CHECKS, ENDED)},
            "failed": run.failed,
            "unsupported": run.unsupported,
        }


def to_csv(rows: Iterable[dict[str, Any]]) -> str:
    """Return the rows as CSV. The field of an unknown value is empty."""
    file = io.StringIO()
    writer: csv.DictWriter[str] | None = None
    for row in rows:
        if writer is None:
            writer = csv.DictWriter(file, list(row), lineterminator="\n")
            writer.writeheader()
        writer.writerow(row)
    return file.getvalue()
