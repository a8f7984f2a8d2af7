"""`--against`: what counts as worse than an earlier night, and which nights can be compared."""

import json
from pathlib import Path
from typing import Any

import pytest

from harness.checker import Result
from harness.errors import ScenarioError
from harness.scenario import Scenario
from harness.sweep.matrix import Finished, MatrixRecord, matrix_outputs
from harness.sweep.matrix._cell import Cell
from harness.sweep.matrix._comparison import compare
from harness.sweep.matrix._estimate import BY_NAME, Estimate
from harness.sweep.matrix.matrix_run import compare_with
from harness.sweep.matrix.nights import load_baseline
from tests.harness.sweep.matrix.stub import judge, matrix, played

WORSE = {
    "uniform": "lower",
    "mutual_share": "lower",
    "distinct_chains": "higher",
    "reconciles": "higher",
    "copies_mean": "lower",
    "copies_min": "lower",
    "messages_per_block": "higher",
    "uniform_before_final_reconcile": "lower",
    "mutual_share_before_final_reconcile": "lower",
}


def cell(loss: float = 0.15, **estimates: Estimate) -> Cell:
    """Return a cell in which each figure is 0.5 (0.4 to 0.6), except for the given ones."""
    usual = Estimate(n=10, mean=0.5, low=0.4, high=0.6)
    known = {name: estimates.get(name, usual) for name in BY_NAME}
    return Cell(loss=loss, agents=5, backend="sim", runs=10, failed=0, estimates=known, verdicts={}, violated={})


def at(mean: float, margin: float = 0.1) -> Estimate:
    return Estimate(n=10, mean=mean, low=mean - margin, high=mean + margin)


@pytest.mark.parametrize("metric", WORSE)
def test_each_figure_has_a_direction_that_is_worse(metric: str) -> None:
    for direction, mean in (("lower", 0.2), ("higher", 0.8)):
        (change,) = compare([cell()], [cell(**{metric: at(mean)})])
        assert (change.metric, change.loss) == (metric, 0.15)
        assert change.worse == (direction == WORSE[metric])


def test_intervals_that_touch_are_no_change() -> None:
    assert not list(compare([cell()], [cell(uniform=Estimate(n=10, mean=0.3, low=0.2, high=0.4))]))
    assert list(compare([cell()], [cell(uniform=Estimate(n=10, mean=0.3, low=0.2, high=0.3999))]))


def test_figure_without_an_interval_is_not_compared() -> None:
    assert not list(compare([cell()], [cell(uniform=Estimate(n=1, mean=0.0), reconciles=Estimate(n=0))]))
    assert not list(compare([cell(uniform=Estimate(n=0))], [cell(uniform=at(0.0))]))


def test_a_figure_that_only_one_night_has_is_not_compared() -> None:
    without = cell()
    del without.estimates["reconciles"]
    assert not list(compare([without], [cell(reconciles=at(5))]))
    assert not list(compare([cell(reconciles=at(5))], [without]))


def test_cells_are_compared_at_the_same_point_only() -> None:
    assert not list(compare([cell(loss=0.1)], [cell(loss=0.2, uniform=at(0.0))]))


def busier(scenario: Scenario, seed: int) -> Result:
    """Judge as `judge` does, with more reconciles under loss."""
    result = judge(scenario, seed)
    result.figures["reconciles"] += 30 if scenario.network.loss else 0  # type: ignore[operator]
    return result


def night(directory: Path, **keys: Any) -> Path:
    """A matrix.json."""
    directory.mkdir()
    matrix_outputs.write(played(matrix(**{"seeds": [1, 3, 4], **keys}), 1, judge), directory)
    return directory / "matrix.json"


def tonight(baseline: Path, judged: Any = judge) -> Finished:
    asked = matrix(seeds=[1, 3, 4])
    record = load_baseline(baseline, asked)
    return compare_with(played(asked, 1, judged), record, str(baseline))


def test_the_same_night_again_is_no_regression(tmp_path: Path) -> None:
    record = tonight(night(tmp_path / "before")).record
    assert record.against is not None
    assert not record.against.changes
    assert record.exit_status == 0


def test_worse_figure_fails_the_night_and_is_reported_everywhere(tmp_path: Path) -> None:
    finished = tonight(night(tmp_path / "before"), busier)
    assert finished.record.exit_status == 1
    matrix_outputs.write(finished, tmp_path)
    read = MatrixRecord.model_validate_json((tmp_path / "matrix.json").read_text())
    assert read == finished.record
    assert [(change.loss, change.metric) for change in read.against.regressions] == [(0.5, "reconciles")]  # type: ignore[union-attr]
    sentence = "reconciles worse: 42.7 (\u00b13.8), was 12.7 (\u00b13.8)"
    assert f'message="{sentence}"' in (tmp_path / "junit.xml").read_text()
    summary = (tmp_path / "summary.md").read_text()
    assert f"- 50\u00a0% loss: {sentence}\n" in summary
    assert "1 figure is worse than on " in summary


def test_better_figure_is_reported_and_passes(tmp_path: Path) -> None:
    before = tmp_path / "matrix.json"
    before.write_text(json.dumps(played(matrix(seeds=[1, 3, 4]), 1, busier).record.to_json()))
    finished = tonight(before)
    assert finished.record.exit_status == 0
    matrix_outputs.write(finished, tmp_path)
    assert "reconciles better: 12.7" in (tmp_path / "summary.md").read_text()
    assert "failure" not in (tmp_path / "junit.xml").read_text().replace('failures="0"', "")


def test_changed_names_do_not_prevent_a_comparison(tmp_path: Path) -> None:
    assert tonight(night(tmp_path / "before", name="before", about="as it was", keep="all"))


@pytest.mark.parametrize(
    ("keys", "sentence"),
    [
        ({"loss": (0.0, 0.4)}, "is of another matrix: `loss` differs, so nothing can be compared"),
        ({"seeds": 5, "agents": [5]}, "is of another matrix: `seeds`, `agents` differ"),
        ({"scenario": {"agents": 5, "duration_s": 60}}, "is of another matrix: `scenario` differs"),
    ],
)
def test_another_matrix_is_refused(tmp_path: Path, keys: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ScenarioError) as told:
        tonight(night(tmp_path / "before", **keys))
    assert sentence in str(told.value)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (None, "cannot be read: No such file or directory"),
        ("", "is not JSON: an earlier night is its matrix.json"),
        ("[]", "names no schema: an earlier night is its matrix.json, whose schema is ucp-matrix/1"),
        ('{"schema": "ucp-run/1"}', "has schema 'ucp-run/1': an earlier night is its matrix.json"),
        ('{"schema": "ucp-matrix/1"}', "says of itself that it is a ucp-matrix/1, but its `matrix` is not"),
    ],
)
def test_invalid_baseline_is_refused(tmp_path: Path, content: str | None, sentence: str) -> None:
    path = tmp_path / "baseline.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(ScenarioError) as told:
        load_baseline(path, matrix())
    assert sentence in str(told.value)
    assert "\n" not in str(told.value)
    assert told.value.exit_status == 2


def test_an_interrupted_night_is_no_baseline(tmp_path: Path) -> None:
    path = night(tmp_path / "before")
    path.write_text(json.dumps({**json.loads(path.read_text()), "outcome": "interrupted"}))
    with pytest.raises(ScenarioError, match="is of a matrix that was interrupted"):
        tonight(path)


def test_one_seed_has_no_intervals_to_compare(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match="which one seed has not: give the matrix more `seeds`"):
        load_baseline(night(tmp_path / "before", seeds=1), matrix(seeds=1))
