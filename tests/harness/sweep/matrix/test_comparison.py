"""Test `--against`: which figures count as worse than an earlier night, and which nights can be compared.

Test the comparison of a protocol variant with the original protocol. Both use the same seeds.
"""

import json
from pathlib import Path
from typing import Any

import pytest

from harness.checker import Result
from harness.errors import ScenarioError
from harness.present.text import escaped
from harness.scenario import Scenario
from harness.sweep.matrix import Finished, MatrixRecord, matrix_outputs
from harness.sweep.matrix._cell import Cell
from harness.sweep.matrix._comparison import compare
from harness.sweep.matrix._estimate import BY_NAME, Estimate
from harness.sweep.matrix.matrix_run import compare_with
from harness.sweep.matrix.nights import keep, load_baseline
from tests.harness.command import harness
from tests.harness.run.test_variant import CORE, HEAD, REFERENCE, write_variant
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
    """Return a summary of a cell. Each figure without a given estimate is 0.5, with the interval 0.4 to 0.6."""
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


def test_figure_of_only_one_night_is_not_compared() -> None:
    without = cell()
    del without.estimates["reconciles"]
    assert not list(compare([without], [cell(reconciles=at(5))]))
    assert not list(compare([cell(reconciles=at(5))], [without]))


def test_cells_are_compared_at_the_same_point_only() -> None:
    assert not list(compare([cell(loss=0.1)], [cell(loss=0.2, uniform=at(0.0))]))


def busier(scenario: Scenario, seed: int) -> Result:
    """Judge like `judge`, but with more reconciles if there is loss."""
    result = judge(scenario, seed)
    result.figures["reconciles"] += 30 if scenario.network.loss else 0  # type: ignore[operator]
    return result


def night(directory: Path, **keys: Any) -> Path:
    """Write the matrix.json of a night with these results."""
    directory.mkdir()
    matrix_outputs.write(played(matrix(**{"seeds": [1, 3, 4], **keys}), 1, judge), directory)
    return directory / "matrix.json"


def tonight(baseline: Path, judged: Any = judge) -> Finished:
    asked = matrix(seeds=[1, 3, 4])
    record = load_baseline(baseline, asked)
    return compare_with(played(asked, 1, judged), record)


def test_same_night_again_is_no_regression(tmp_path: Path) -> None:
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
    sentence = "reconciles worse: 42.7, was 12.7; +237\u00a0% in 3 pairs (+237 to +237)"
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
    ("keys", "sentence", "compared"),
    [
        ({"loss": (0.0, 0.4)}, "the baseline lacks some cells, which are not compared", 1),
        ({"agents": [3]}, "the baseline lacks some cells, which are not compared", 0),
        (
            {"scenario": {"agents": 5, "duration_s": 90}},
            "`scenario.duration_s` was 90.0 and is 1200.0, so the baseline is not compared",
            0,
        ),
        ({"traces": False}, "`traces` was False and is True, so no cell is compared", 0),
    ],
)
def test_cells_that_differ_are_named_and_not_compared(
    tmp_path: Path, keys: dict[str, Any], sentence: str, compared: int
) -> None:
    before = night(tmp_path / "before", **keys)
    assert len(load_baseline(before, matrix(seeds=[1, 3, 4])).points) == compared
    finished = tonight(before, busier)
    assert finished.record.against is not None
    assert finished.record.against.not_compared == [sentence]
    assert finished.record.exit_status == 0
    matrix_outputs.write(finished, tmp_path)
    summary = (tmp_path / "summary.md").read_text()
    assert f"- {escaped(sentence)}\n" in summary
    assert ("not all cells are compared" if compared else "not compared with the baseline") in summary
    assert ("worse than" in summary) == bool(compared)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ('{"schema": "ucp-matrix/1"}', ": this version of the harness cannot read its `matrix`"),
        ('{"schema": "ucp-matrix/2"}', " has schema ucp-matrix/2, and this version of the harness reads ucp-matrix/1"),
    ],
)
def test_baseline_of_another_version_is_named_and_not_compared(tmp_path: Path, content: str, sentence: str) -> None:
    path = tmp_path / "baseline.json"
    path.write_text(content)
    finished = tonight(path)
    assert finished.record.against is not None
    sentence = f"{path}{sentence}, so no cell is compared"
    assert finished.record.against.not_compared == [sentence]
    matrix_outputs.write(finished, tmp_path)
    assert f"- {escaped(sentence)}\n" in (tmp_path / "summary.md").read_text()


def rarely_busier(scenario: Scenario, seed: int) -> Result:
    """Judge like `judge`, but with one more reconcile for seed 3."""
    result = judge(scenario, seed)
    result.figures["reconciles"] += seed == 3  # type: ignore[operator]
    return result


def test_single_changed_run_is_named_and_no_regression(tmp_path: Path) -> None:
    finished = tonight(night(tmp_path / "before"), rarely_busier)
    record = finished.record
    assert record.against is not None
    assert [(changed.loss, changed.pairs, changed.seeds) for changed in record.against.changed_runs] == [
        (0.0, 3, [3]),
        (0.5, 3, [3]),
    ]
    assert not record.against.changes
    assert record.exit_status == 0
    matrix_outputs.write(finished, tmp_path)
    assert "1 of 3 runs differ from the baseline, seed 3" in (tmp_path / "report.html").read_text()


def slightly_busier(scenario: Scenario, seed: int) -> Result:
    """Judge like `judge`, but with one or two more reconciles. The numbers of different seeds differ by more than
    that.
    """
    result = judge(scenario, seed)
    result.figures["reconciles"] += 1 + seed % 2  # type: ignore[operator]
    return result


def test_pairs_show_a_change_that_is_smaller_than_the_spread_of_the_seeds(tmp_path: Path) -> None:
    seeds = list(range(20))
    before = night(tmp_path / "before", seeds=seeds)
    asked = matrix(seeds=seeds)
    now = played(asked, 1, slightly_busier)
    record = compare_with(now, load_baseline(before, asked)).record
    assert record.against is not None
    assert {change.metric for change in record.against.regressions} == {"reconciles"}
    assert not list(compare(MatrixRecord.model_validate_json(before.read_text()).cells, now.record.cells))


def test_kept_nights_have_no_single_runs(tmp_path: Path) -> None:
    record = played(matrix(), 1, judge).record
    assert record.results
    keep(record, tmp_path)
    (kept,) = tmp_path.iterdir()
    assert json.loads(kept.read_text())["results"] == []


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (None, "cannot be read: No such file or directory"),
        ("", "not JSON at line 1; name the matrix.json of an earlier night"),
        ("[]", "names no schema: name the matrix.json of an earlier night, whose schema is ucp-matrix/1"),
        ('{"schema": "ucp-run/1"}', "has schema 'ucp-run/1': name the matrix.json of an earlier night"),
    ],
)
def test_invalid_baseline_is_refused(tmp_path: Path, content: str | None, sentence: str) -> None:
    path = tmp_path / "baseline.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(ScenarioError) as error:
        load_baseline(path, matrix())
    assert sentence in str(error.value)
    assert "\n" not in str(error.value)
    assert error.value.exit_status == 2


def test_interrupted_night_is_no_baseline(tmp_path: Path) -> None:
    path = night(tmp_path / "before")
    path.write_text(json.dumps({**json.loads(path.read_text()), "outcome": "interrupted"}))
    with pytest.raises(ScenarioError, match="contains results of a matrix that was interrupted"):
        tonight(path)


def test_one_seed_has_no_intervals_to_compare(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match="which need several seeds: give the matrix more `seeds`"):
        load_baseline(night(tmp_path / "before", seeds=1), matrix(seeds=1))


MATRIX = """
name: Ties
scenario: {agents: 4, duration_s: 600, events: {source: random, mean_s: 30}, vehicles: {kind: none}}
loss: [0, 0.3]
seeds: 4
"""


@pytest.fixture
def variants_matrix(tmp_path: Path) -> Path:
    path = tmp_path / "matrix.yaml"
    path.write_text(MATRIX)
    return path


def compared(variants_matrix: Path, variant: Path, out: Path) -> dict[float, dict[str, Any]]:
    """Return the row with each label, for each loss rate."""
    done = harness("matrix", variants_matrix, "--variant", variant, "--out", out, "--jobs", 1, "--json")
    assert done.returncode == 0, done.stderr
    cells = json.loads(done.stdout)["cells"]
    return {cell["loss"]: {row["label"]: row for row in cell["rows"]} for cell in cells}


def test_variant_is_compared_with_the_original_seed_by_seed(variants_matrix: Path, tmp_path: Path) -> None:
    variant = write_variant(tmp_path, HEAD + CORE + REFERENCE)
    rows = compared(variants_matrix, variant, tmp_path / "out")
    assert rows[0]["messages"]["differing_seeds"] == [], "without losses there is no tie"
    assert rows[0.3]["messages"]["differing_seeds"], "with losses there is one"
    assert rows[0.3]["runs with a step that deviates"]["variant"] == 0
    page = (tmp_path / "out" / "comparison.md").read_text()
    assert page.startswith("# pops (Algorithm 11) beside the original\n")
    assert "| runs with a livelock | 4 |" in page
    (beside,) = [path for path in (tmp_path / "out").iterdir() if path.name.startswith("pops-")]
    assert json.loads((beside / "matrix.json").read_text())["versions"]["variant"].startswith("pops ")
    assert "variant" not in json.loads((tmp_path / "out" / "original" / "matrix.json").read_text())["versions"]


def test_variant_that_changes_nothing_has_no_difference(variants_matrix: Path, tmp_path: Path) -> None:
    same = HEAD + CORE.replace("yes <= no", "yes < no") + REFERENCE.replace("yes > no", "yes >= no")
    rows = compared(variants_matrix, write_variant(tmp_path, same), tmp_path / "out")
    assert [row["differing_seeds"] for cell in rows.values() for row in cell.values()] == [[]] * 22


def test_variant_excludes_other_comparisons(variants_matrix: Path, tmp_path: Path) -> None:
    variant = write_variant(tmp_path, HEAD + CORE + REFERENCE)
    done = harness("matrix", variants_matrix, "--variant", variant, "--nights", tmp_path / "nights")
    assert done.returncode == 2
    assert "--variant excludes" in " ".join(done.stderr.split())
