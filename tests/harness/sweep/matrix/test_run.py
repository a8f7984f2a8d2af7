"""Test a matrix from its runs to its files, without simulation.

Test `--budget`: uncertain cells come first, no run begins after the time is over, and the output lists the omitted
runs.
"""

import csv
import itertools
import json
import re
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import pytest
from rich.console import Console

from docs.generate.matrix_thesis import BEGIN, END, OBSERVED, PAGE, put_between_markers
from docs.generate.matrix_thesis import table as thesis_table
from harness.checker import Result
from harness.errors import MachineError
from harness.scenario import Scenario
from harness.sweep.matrix import MatrixRecord, _results_file, matrix_outputs, matrix_table, run_matrix
from harness.sweep.matrix._cell import Run
from harness.sweep.matrix._matrix_file import MatrixTask
from harness.sweep.matrix._matrix_picture import PANELS, draw
from harness.sweep.matrix.matrix_run import informative, on_cores
from harness.sweep.matrix.matrix_table import to_markdown, verdict
from tests.harness.command import harness
from tests.harness.sweep.matrix.stub import judge, matrix, played

SVG = "{http://www.w3.org/2000/svg}"


def shown(record: MatrixRecord, width: int = 80) -> str:
    console = Console(width=width)
    with console.capture() as capture:
        console.print(matrix_table.render(record))
    return capture.get().replace("\u00a0", " ")


def test_each_cell_sums_up_its_runs() -> None:
    record = played(matrix(), 2, judge).record
    perfect, lossy = record.cells
    assert (perfect.loss, perfect.runs, perfect.failed, perfect.violated) == (0.0, 4, 0, {})
    assert perfect.estimates["uniform"].mean == 1.0
    assert lossy.estimates["uniform"].mean == 0.0
    assert lossy.estimates["mutual_share"].mean == pytest.approx((20 - 0.5) / 40)
    assert lossy.estimates["reconciles"].mean == 12.5
    assert lossy.verdicts["3"] == {"holds": 3, "violated": 1}
    assert lossy.violated == {"3": [2]}
    assert record.exit_status == 1


def test_result_does_not_depend_on_the_number_of_jobs() -> None:
    one, two = (played(matrix(seeds=[5, 3, 9]), jobs, judge) for jobs in (1, 2))
    assert one.runs == two.runs
    assert [(run.loss, run.seed) for run in one.runs] == [(0.0, 5), (0.0, 3), (0.0, 9), (0.5, 5), (0.5, 3), (0.5, 9)]
    assert one.record.cells == two.record.cells
    assert one.record.exit_status == 0


def test_failed_run_is_reported_and_the_others_count() -> None:
    def breaks(scenario: Scenario, seed: int) -> Result:
        if seed == 3:
            raise KeyError("block")
        return judge(scenario, seed)

    record = played(matrix(loss=(0.0,)), 2, breaks).record
    (cell,) = record.cells
    assert (cell.runs, cell.failed, cell.estimates["reconciles"].n) == (4, 1, 3)
    (failed,) = record.failed
    assert (failed.seed, failed.reason[:17]) == (3, "KeyError: 'block'")
    assert record.exit_status == 1
    assert "seed 3 failed: KeyError: 'block'" in shown(record)


def test_unplayable_scenario_causes_one_error() -> None:
    def refuses(scenario: Scenario, seed: int) -> Result:
        raise MachineError("not in the simulation")

    with pytest.raises(MachineError, match="not in the simulation"):
        played(matrix(), 2, refuses)


def test_interrupt_keeps_the_runs_that_had_ended(tmp_path: Path) -> None:
    calls = itertools.count()

    def interrupted(scenario: Scenario, seed: int) -> Result:
        if next(calls) == 5:
            raise KeyboardInterrupt
        return judge(scenario, seed)

    finished = played(matrix(), 1, interrupted)
    assert finished.record.outcome == "interrupted"
    assert finished.record.exit_status == 130
    assert [cell.runs for cell in finished.record.cells] == [4, 1]
    matrix_outputs.write(finished, tmp_path)
    assert json.loads((tmp_path / "matrix.json").read_text())["outcome"] == "interrupted"
    assert "interrupted: 8 were asked for" in (tmp_path / "matrix.svg").read_text()


def test_interrupt_before_the_first_run_still_writes_all_files(tmp_path: Path) -> None:
    def interrupted(scenario: Scenario, seed: int) -> Result:
        raise KeyboardInterrupt

    finished = played(matrix(), 1, interrupted)
    matrix_outputs.write(finished, tmp_path)
    ElementTree.parse(tmp_path / "matrix.svg")  # noqa: S314 - ours
    assert MatrixRecord.model_validate_json((tmp_path / "matrix.json").read_text()).cells == []
    assert shown(finished.record)


def test_files_read_back_equal_the_written_data(tmp_path: Path) -> None:
    finished = played(matrix(), 1, judge)
    matrix_outputs.write(finished, tmp_path)
    document = json.loads((tmp_path / "matrix.json").read_text())
    assert document["schema"] == "ucp-matrix/1"
    assert MatrixRecord.model_validate(document) == finished.record
    with (tmp_path / "matrix.csv").open() as file:
        cells = list(csv.DictReader(file))
    assert [float(cell["loss"]) for cell in cells] == [0.0, 0.5]
    assert float(cells[1]["reconciles"]) == 12.5
    assert float(cells[1]["reconciles_low"]) < 12.5 < float(cells[1]["reconciles_high"])
    assert [cell["violated_3"] for cell in cells] == ["0", "1"]
    with (tmp_path / "runs.csv").open() as file:
        runs = list(csv.DictReader(file))
    assert len(runs) == 8
    assert (runs[5]["loss"], runs[5]["seed"], runs[5]["characteristic_3"]) == ("0.5", "2", "violated")
    assert (runs[5]["bytes"], runs[5]["failed"]) == ("", ""), "unknown is empty"


def test_table_fits_eighty_columns_and_names_violations() -> None:
    lines = shown(played(matrix(), 1, judge).record)
    assert "\u2026" not in lines
    assert "100 %" in lines
    assert "50 % loss: characteristic 3 violated in 1 of 4 runs, seed 2" in lines
    assert "Means of 4 runs per cell, with 95 % intervals. All cells have the same seeds." in lines


def test_single_run_has_no_interval_and_this_is_reported() -> None:
    record = played(matrix(seeds=1), 1, judge).record
    assert record.cells[0].estimates["reconciles"].low is None
    assert "\u00b1" not in shown(record)
    assert "Each cell has one run, so there are no intervals." in shown(record)
    drawing = draw(record)
    assert 'class="band"' not in drawing
    assert "no intervals" in drawing


def test_picture_has_a_panel_for_each_figure_and_a_dot_for_each_mean() -> None:
    drawing = ElementTree.fromstring(draw(played(matrix(), 1, judge).record))  # noqa: S314 - ours
    texts = {element.text for element in drawing.iter(f"{SVG}text")}
    assert {panel.title for panel in PANELS} <= texts
    lines = sum(len(panel.lines) for panel in PANELS)
    assert len(list(drawing.iter(f"{SVG}circle"))) == 2 * lines
    tips = [element.text or "" for element in drawing.iter(f"{SVG}title")]
    assert "50\u00a0% loss: 12.5 (\u00b12.1)" in tips


def test_picture_escapes_names_and_refers_to_no_file() -> None:
    drawing = draw(played(matrix(name='<script>"&'), 1, judge).record)
    assert "<script" not in drawing
    ElementTree.fromstring(drawing)  # noqa: S314 - ours
    assert set(re.findall(r"https?://[^\"']*", drawing)) == {"http://www.w3.org/2000/svg"}


@pytest.mark.parametrize("loss", [(0.0,), (1.0,), (0.3,), (0.01, 0.011)])
def test_any_range_of_losses_can_be_drawn(loss: tuple[float, ...]) -> None:
    drawing = ElementTree.fromstring(draw(played(matrix(loss=loss), 1, judge).record))  # noqa: S314 - ours
    places = [float(dot.attrib["cx"]) for dot in drawing.iter(f"{SVG}circle")]
    assert all(0 < place < 900 for place in places)


def test_thesis_page_has_a_place_for_the_table_and_every_rate() -> None:
    record = played(matrix(loss=tuple(OBSERVED)), 1, judge).record
    page = put_between_markers(PAGE.read_text(), thesis_table(record))
    rows = page.split(BEGIN)[1].split(END)[0].splitlines()
    assert len(rows) == 2 + len(OBSERVED)
    assert all(row.count("|") == rows[0].count("|") for row in rows)


def test_coverage_on_request_counts_only_runs_of_this_command(tmp_path: Path) -> None:
    asked = matrix(loss=(0.0, 1.0), seeds=2, scenario={"duration_s": 60, "agents": 2})
    record = run_matrix(asked, tmp_path / "out", on_cores(asked, 1), covers=True).record
    assert record.tried is not None
    assert record.tried.runs == 4
    assert record.tried.all_cells["untold"] is None
    assert [cell.loss for cell in record.tried.cells] == [0.0, 1.0]
    assert MatrixRecord.model_validate(record.to_json()) == record
    assert "Coverage of 4 runs" in to_markdown(record)
    assert "reached" not in (tmp_path / "out" / _results_file.FILE).read_text()
    again = run_matrix(asked, tmp_path / "out", on_cores(asked, 1), covers=True).record
    assert again.tried is not None
    assert again.tried.all_cells["untold"] == "an earlier command played 4 of 4 runs"


LOSS = (0.0, 0.1, 0.2)


def ticking(seconds: list[float]) -> Callable[[], float]:
    """Return a clock whose time increases by one second at each call."""

    def clock() -> float:
        seconds[0] += 1
        return seconds[0]

    return clock


def order(most: float, chains: Callable[[float, int], int], late: int = 0) -> list[MatrixTask]:
    """Return the tasks in the order in which they begin. The result of a task is known after `late` more tasks have
    begun.
    """
    asked, runs, begun = matrix(loss=LOSS, seeds=20), dict[MatrixTask, Run](), list[MatrixTask]()
    for task in informative(asked.tasks, runs, most, ticking([0.0])):
        begun.append(task)
        if len(begun) > late:
            known = begun[len(begun) - 1 - late]
            figures = {"distinct_chains": chains(known.point.loss, known.seed), "messages_per_block": 20}
            runs[known] = Run(**known.point._asdict(), seed=known.seed, figures=figures)
    return begun


@pytest.mark.parametrize("late", [0, 3])
def test_uncertain_cell_gets_the_time_after_two_runs_of_each(late: int) -> None:
    begun = order(24, lambda loss, seed: 1 + seed % 2 if loss == 0.1 else 1, late)
    assert Counter(task.point.loss for task in begun[:6]) == dict.fromkeys(LOSS, 2)
    counts = Counter(task.point.loss for task in begun)
    assert counts[0.1] > max(counts[0.0], counts[0.2]) >= 2
    assert [task.seed for task in begun if task.point.loss == 0.1] == list(range(1, counts[0.1] + 1))


def test_all_runs_are_played_if_the_time_suffices() -> None:
    begun = order(1000, lambda loss, seed: 1)
    assert sorted(begun) == sorted(matrix(loss=LOSS, seeds=20).tasks)


@pytest.mark.parametrize(
    ("ended", "sentence"),
    [
        (0, "No run has ended."),
        (1, "Each cell has one run, so there are no intervals."),
        (2, "Means of 2 runs per cell, with 95 % intervals."),
        (6, "Means of 2 to 4 runs per cell, with 95 % intervals."),
    ],
)
def test_interrupted_matrix_has_the_number_of_its_runs(ended: int, sentence: str) -> None:
    calls = itertools.count()

    def interrupted(scenario: Scenario, seed: int) -> Result:
        if next(calls) == ended:
            raise KeyboardInterrupt
        return judge(scenario, seed)

    assert matrix_table.explanation(played(matrix(), 1, interrupted).record) == sentence


def test_run_that_did_not_begin_is_no_interruption(tmp_path: Path) -> None:
    asked = matrix(seeds=3)
    finished = run_matrix(asked, tmp_path, on_cores(asked, 1), budget_s=1e-9)
    assert (finished.record.outcome, finished.record.exit_status, finished.runs) == ("completed", 0, [])
    assert verdict(finished.record).startswith("0 runs of 6 in the given time")
    matrix_outputs.write(finished, tmp_path)
    assert (tmp_path / "junit.xml").read_text().count('message="the time was used up: 0 of 3 runs had ended"') == 2


def test_wrong_budget_is_refused() -> None:
    refused = harness("matrix", "growth_matrix", "--budget", "soon")
    assert refused.returncode == 2
    assert "is not a time" in refused.stderr
