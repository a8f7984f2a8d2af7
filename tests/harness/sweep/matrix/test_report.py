"""Test report.html of a matrix: summaries, runs and nights in one small, safe file.

Test summary.md, junit.xml, table and picture, also for several numbers of agents and backends.
"""

import csv
import html
import io
import json
import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml
from rich.console import Console

from harness.checker import Result
from harness.checker.judgement import Judgement
from harness.scenario import Scenario, load_scenario
from harness.scenario.verdict_names import Verdict
from harness.sweep.matrix import Finished, MatrixRecord, matrix_outputs, matrix_table
from harness.sweep.matrix._cell import Run
from harness.sweep.matrix._cell_play import directory_name
from harness.sweep.matrix._matrix_file import scenario_file, write_scenarios
from harness.sweep.matrix._matrix_picture import PANELS, draw
from harness.sweep.matrix.matrix_outputs import to_junit
from harness.sweep.matrix.matrix_run import compare_with
from harness.sweep.matrix.matrix_table import to_markdown
from harness.sweep.matrix.nights import BaselineNight, StoredNights
from harness.sweep.matrix.report import _drilldown, _heatmap, _trend, to_html
from harness.sweep.matrix.report._heatmap import known_figures
from tests.harness.command import harness
from tests.harness.sweep.matrix.stub import judge, matrix, played

HOSTILE = "</title></style><script>alert(1)</script><img src=x onerror=alert(2)>\"'{{ 7 * 7 }}"


def breaks(scenario: Scenario, seed: int) -> Result:
    if seed == 3 and scenario.network.loss:
        raise RuntimeError(HOSTILE)
    return judge(scenario, seed)


def tiles(finished: Finished, name: str) -> dict[str, _heatmap.HeatmapTile]:
    """Return the tiles of one figure. The key of a tile is the page section to which it links."""
    (figure,) = [one for one in known_figures(finished.record.cells) if one.metric.name == name]
    grids = _heatmap.heatmap(finished.record, figure).grids
    return {str(tile.href): tile for grid in grids for _, row in grid.rows for tile in row}


def over(finished: Finished, nights: int) -> StoredNights:
    record = finished.record
    days = [record.model_copy(update={"started_at": f"2026-01-{day:02}T02:17:00Z"}) for day in range(1, nights + 1)]
    return StoredNights(Path("nights"), days, [])


def test_each_cell_has_its_number_and_the_shade_grows_with_it() -> None:
    finished = played(matrix(loss=(0.0, 0.25, 1.0), agents=[5, 10]), 1, judge)
    found = tiles(finished, "mutual_share")
    assert len(found) == 6
    shown = [found[f"#loss-{loss}-agents-5-sim"] for loss in (0.0, 0.25, 1.0)]
    assert [tile.mean for tile in shown] == ["98.8\u00a0%", "73.8\u00a0%", "\u22121.25\u00a0%".replace("\u2212", "-")]
    shades = [tile.shade for tile in tiles(finished, "copies_mean").values()]
    assert shades[:3] == [10, 8, 0]


def test_violations_and_failures_are_marked_for_every_figure() -> None:
    finished = played(matrix(), 1, breaks)
    for name in ("uniform", "reconciles", "violated"):
        well, bad = tiles(finished, name).values()
        assert well.marks == []
        assert [(mark.sign, mark.text) for mark in bad.marks] == [("\u2717", "1 violated"), ("!", "1 failed")]
        assert "1 violated, 1 failed" in bad.in_words


def test_worse_figure_is_marked_where_it_is_shown() -> None:
    finished = played(matrix(), 1, judge)
    baseline = json.loads(json.dumps(finished.record.to_json()))
    for run in baseline["results"]:
        run["figures"]["reconciles"] -= 5 * (run["loss"] == 0.5)
    record = MatrixRecord.model_validate(baseline)
    finished = compare_with(finished, BaselineNight(Path("before.json"), record, frozenset(matrix().points), []))
    assert [mark.text for mark in tiles(finished, "reconciles")["#loss-0.5-agents-5-sim"].marks] == [
        "1 violated",
        "worse",
    ]
    assert [mark.text for mark in tiles(finished, "uniform")["#loss-0.5-agents-5-sim"].marks] == ["1 violated"]


def test_unplayed_cells_are_empty_and_partial_cells_are_marked() -> None:
    def interrupted(scenario: Scenario, seed: int) -> Result:
        if seed == 3:
            raise KeyboardInterrupt
        return judge(scenario, seed)

    finished = played(matrix(), 1, interrupted)
    found = tiles(finished, "uniform")
    assert found["None"].shade is None
    assert [mark.text for mark in found["#loss-0.0-agents-5-sim"].marks] == ["2 of 4 runs"]
    assert "This matrix was interrupted: 2 of 8 runs had ended." in to_html(finished, Path())


def test_bad_runs_of_a_cell_come_first() -> None:
    well, bad = _drilldown.drilldown(played(matrix(), 1, breaks), Path())
    assert [row.seed for row in well.rows] == [1, 2, 3, 4]
    assert [row.seed for row in bad.rows] == [3, 2, 1, 4]
    assert bad.rows[0].failed is not None and bad.rows[0].failed.startswith("RuntimeError: </title>")
    assert bad.rows[1].verdicts == [*"✓✓✗✓✓✓", *4 * ["\u2013"]]
    assert bad.rows[1].figures[bad.figures.index("mutual chain")] == "20"
    assert bad.command == "ucp-harness run cells/loss-0.5-agents-5.yaml --backend sim --seed 3"
    assert bad.runs == "4 runs, 1 with violations, 1 failed"


def test_kept_run_links_to_its_report(tmp_path: Path) -> None:
    finished = played(matrix(seeds=2), 1, judge)
    runs = [run.model_copy(update={"backend": "process"}) for run in finished.runs]
    kept = tmp_path / "runs" / directory_name(runs[1].task)
    kept.mkdir(parents=True)
    (kept / "report.html").touch()
    cells = _drilldown.drilldown(Finished(finished.record, runs), tmp_path)
    assert [row.href for row in cells[0].rows] == [None, "runs/loss-0.0-agents-5-process-seed-2/report.html"]


def test_runs_above_the_limit_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_drilldown, "MAX_ROWS", 4)
    finished = played(matrix(), 1, breaks)
    assert [(len(cell.rows), cell.left_out) for cell in _drilldown.drilldown(finished, Path())] == [(2, 2), (2, 2)]
    assert "runs.csv has 2 more runs." in to_html(finished, Path())


def test_trend_has_a_panel_for_each_loss_and_a_dot_for_each_night() -> None:
    finished = played(matrix(agents=[5, 10]), 1, judge)
    page = to_html(finished, Path(), over(finished, 3))
    (drawings,) = re.findall(
        r'<div class="figure of-uniform">\s*<h3>one chain</h3>\s*<h4>.*?</div>\n</div>', page, re.S
    )
    assert drawings.count('<g class="panel">') == 4
    assert drawings.count("<circle") == 4 * 3
    assert re.search("<title>2026-01-02 02:17, commit .*?: 100\u00a0% \\(51\u2013100\u00a0%\\)</title>", drawings)
    assert drawings.count('class="band"') == 4


def test_nights_differ_in_their_panel() -> None:
    finished = played(matrix(), 1, judge)
    nights = over(finished, 3).records
    (figure,) = [one for one in known_figures(finished.record.cells) if one.metric.name == "reconciles"]
    cell = nights[1].cells[1]
    busier = {**cell.estimates, "reconciles": cell.estimates["reconciles"].model_copy(update={"mean": 40.0})}
    nights[1] = nights[1].model_copy(
        update={"cells": [nights[1].cells[0], cell.model_copy(update={"estimates": busier})]}
    )
    ((_, drawing),) = _trend.trend(nights, finished.record, figure)
    first, second = drawing.split('<g class="panel">')[1:]
    heights = [set(re.findall(r'cy="([\d.]+)"', panel)) for panel in (first, second)]
    assert [len(one) for one in heights] == [1, 2]


def test_trend_begins_with_the_second_night_and_the_page_explains_it() -> None:
    finished = played(matrix(), 1, judge)
    assert "With --nights DIR, the command keeps each completed night" in to_html(finished, Path())
    assert "The trend needs two nights. nights has one night" in to_html(finished, Path(), over(finished, 1))
    assert "The trend needs" not in to_html(finished, Path(), over(finished, 2))


def test_nights_with_absurd_figures_are_drawn_without_these_figures() -> None:
    finished = played(matrix(), 1, judge)
    nights = over(finished, 2)
    for value in (1e308, -1e308, 0.0, 1e-300):
        estimates = {name: {"n": 4, "mean": value, "low": -value, "high": value} for name in ("uniform", "reconciles")}
        record = nights.records[0].to_json()
        record["cells"][0]["estimates"] = estimates
        record["started_at"] = HOSTILE
        nights.records[0] = MatrixRecord.model_validate(record)
        assert "1e+308" not in to_html(finished, Path(), nights)


def test_oldest_nights_are_left_out_if_there_are_too_many(monkeypatch: pytest.MonkeyPatch) -> None:
    finished = played(matrix(), 1, judge)
    monkeypatch.setattr(_trend, "MAX_DOTS", 2 * 8 * 3)
    page = to_html(finished, Path(), over(finished, 5))
    assert "3 nights, from 2026-01-03 to 2026-01-05" in page


def test_hostile_texts_stay_text_and_nothing_is_loaded() -> None:
    finished = played(matrix(name=HOSTILE, about=HOSTILE), 1, breaks)
    page = to_html(finished, Path(), StoredNights(Path(HOSTILE), [], [HOSTILE]))
    assert "<script" not in page
    assert "<img" not in page
    assert html.escape(HOSTILE).replace("&#x27;", "&#39;").replace("&quot;", "&#34;") in page
    assert "default-src 'none'; style-src 'sha256-" in page
    assert "script-src" not in page
    assert not re.findall(r'(?:src|href)="(?!#|data:,|runs/)', page)


def test_eight_by_two_hundred_runs_stay_small() -> None:
    finished = played(matrix(loss=tuple(n / 10 for n in range(8)), seeds=200), 1, judge)
    page = to_html(finished, Path(), over(finished, 60))
    assert page.count("<tr><th>") == 1600
    assert len(page.encode()) < 1_500_000


def test_any_run_can_be_played_again_from_its_cells_scenario(tmp_path: Path) -> None:
    network = {"receivers": {3: {"loss": 0.5}}}
    scenario = {"duration_s": 300, "events": {"source": "random"}, "clocks": {2: {"offset_s": -2}}, "network": network}
    asked = matrix(name="again # and: \u2026", agents=[4, 5], loss=(0.15,), scenario=scenario)
    write_scenarios(asked, tmp_path)
    for point in asked.points:
        assert load_scenario(tmp_path / scenario_file(point)) == asked.scenario_at(point)
    (tmp_path / "matrix.yaml").write_text(yaml.safe_dump(asked.model_dump(mode="json", exclude_unset=True)))
    assert harness("matrix", tmp_path / "matrix.yaml", "--out", tmp_path / "out").returncode == 0
    page = (tmp_path / "out" / "report.html").read_text()
    (command,) = re.findall(r"<code>ucp-harness (run .*agents-4.*)</code>", page)
    assert harness(*command.split(), "--out", "again", cwd=tmp_path / "out").returncode == 0
    lines = (tmp_path / "out" / "results.jsonl").read_text().splitlines()[1:]
    (played_first,) = [run for run in map(Run.model_validate_json, lines) if (run.agents, run.seed) == (4, 1)]
    again = json.loads((tmp_path / "out" / "again" / "run.json").read_text())
    assert {name: again["figures"][name] for name in played_first.figures} == played_first.figures


SVG = "{http://www.w3.org/2000/svg}"


def breaks_with_markup(scenario: Scenario, seed: int) -> Result:
    if seed == 3 and scenario.network.loss:
        raise RuntimeError("<broken> | [away](\x00)\nfor good")
    return judge(scenario, seed)


def cases(finished: Finished) -> dict[str | None, list[ElementTree.Element]]:
    suites = ElementTree.fromstring(to_junit(finished.record))  # noqa: S314 - ours
    return {case.get("name"): list(case) for case in suites.iter("testcase")}


def test_each_cell_is_a_test_case() -> None:
    found = cases(played(matrix(), 1, judge))
    assert list(found) == ["0\u00a0% loss", "50\u00a0% loss"]
    assert found["0\u00a0% loss"] == []
    (failure,) = found["50\u00a0% loss"]
    assert failure.tag == "failure"
    assert failure.get("message") == "characteristic 3 violated in 1 of 4 runs, seed 2"


def test_failed_run_fails_its_case_in_any_event() -> None:
    finished = played(matrix(seeds=[1, 3]), 1, breaks_with_markup)
    (failure,) = cases(finished)["50\u00a0% loss"]
    assert "seed 3 failed: RuntimeError: <broken> | [away](?)" in (failure.text or "")
    suites = ElementTree.fromstring(to_junit(finished.record))  # noqa: S314 - ours
    assert {name: suites[0].get(name) for name in ("tests", "failures", "skipped")} == {
        "tests": "2",
        "failures": "1",
        "skipped": "0",
    }


def test_cells_without_all_their_runs_are_skipped() -> None:
    def interrupted(scenario: Scenario, seed: int) -> Result:
        if seed == 3:
            raise KeyboardInterrupt
        return judge(scenario, seed)

    finished = played(matrix(), 1, interrupted)
    (first,), (second,) = cases(finished).values()
    assert (first.tag, first.get("message")) == ("skipped", "interrupted: 2 of 4 runs had ended")
    assert (second.tag, second.get("message")) == ("skipped", "interrupted: 0 of 4 runs had ended")
    assert "**2 runs of 8, interrupted; no violations**" in to_markdown(finished.record)


def test_summary_is_a_markdown_table_followed_by_the_problems() -> None:
    lines = to_markdown(played(matrix(name="a | b"), 1, breaks_with_markup).record).splitlines()
    assert lines[0] == "## a \\| b"
    assert lines[2] == "**8 runs; 1 with violations; 1 failed**"
    rows = [line for line in lines if line.startswith("|")]
    assert len(rows) == 4
    assert len({row.count("|") for row in rows}) == 1
    assert rows[3].startswith("| 50\u00a0% | 4 | 0\u00a0%<br><sub>")
    assert rows[3].endswith("| **1** | **1** |")
    assert "- 50\u00a0% loss: characteristic 3 violated in 1 of 4 runs, seed 2" in lines
    (failed,) = [line for line in lines if "seed 3 failed" in line]
    assert "\\<broken\\> \\| \\[away\\](\x00) for good" in failed


def test_number_of_agents_is_named_everywhere(tmp_path: Path) -> None:
    finished = played(matrix(agents=[3, 10]), 1, judge)
    assert list(cases(finished))[3] == "50\u00a0% loss, 10 agents"
    assert "| loss | agents | runs |" in to_markdown(finished.record)
    console = Console(width=80)
    with console.capture() as capture:
        console.print(matrix_table.render(finished.record))
    assert "\u2026" not in capture.get()
    assert "\n10 agents\n" in capture.get()
    assert "50\u00a0% loss, 10 agents: characteristic 3 violated" in " ".join(capture.get().split(" ")).replace(
        "\n", " "
    )
    matrix_outputs.write(finished, tmp_path)
    with (tmp_path / "matrix.csv").open() as file:
        assert [(row["agents"], row["backend"]) for row in csv.DictReader(file)] == [("3", "sim")] * 2 + [
            ("10", "sim")
        ] * 2
    drawing = ElementTree.fromstring(draw(finished.record))  # noqa: S314 - ours
    texts = [element.text for element in drawing.iter(f"{SVG}text")]
    assert texts.index("3 agents") < texts.index("10 agents")
    assert all(texts.count(panel.title) == 2 for panel in PANELS)


def test_share_of_finished_swarms_is_a_column() -> None:
    def endless(scenario: Scenario, seed: int) -> Result:
        judged = judge(scenario, seed)
        verdict: Verdict = "never finishes" if scenario.network.loss and seed > 1 else "finished"
        return replace(judged, beside={"liveness": Judgement("liveness", verdict, "")})

    finished = played(matrix(), 1, endless)
    lines = to_markdown(finished.record).splitlines()
    header, _, well, bad = (line.split("|") for line in lines if line.startswith("|"))
    column = [cell.strip() for cell in header].index("finished")
    assert [well[column].strip(), bad[column].strip()] == ["100\u00a0%", "25\u00a0%"]
    shown = Console(width=100, record=True, file=io.StringIO())
    shown.print(matrix_table.render(finished.record))
    text = shown.export_text()
    assert "fin-" in text and "25\u00a0%" in text
    assert [figure.of(finished.record.cells[1]).mean for figure in known_figures(finished.record.cells)][-2] == 0.25


def test_terminal_has_the_headline_of_the_page() -> None:
    record = played(matrix(), 1, judge).record
    shown = Console(width=100, record=True, file=io.StringIO())
    shown.print(matrix_table.render(record))
    assert f"\n{matrix_table.verdict(record)}\n" in shown.export_text()


def test_column_without_values_is_left_out() -> None:
    shown = Console(width=100, record=True, file=io.StringIO())
    shown.print(matrix_table.render(played(matrix(), 1, judge).record))
    assert "fin-" not in shown.export_text()
