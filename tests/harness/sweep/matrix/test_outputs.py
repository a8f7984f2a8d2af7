"""Test summary.md, junit.xml, table and picture, also for several numbers of agents and backends."""

import csv
import io
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

from rich.console import Console

from harness.checker import Result
from harness.checker.judgement import Judgement
from harness.scenario import Scenario
from harness.scenario.verdict_names import Verdict
from harness.sweep.matrix import Finished, matrix_outputs, matrix_table
from harness.sweep.matrix._matrix_picture import PANELS, draw
from harness.sweep.matrix.matrix_outputs import to_junit
from harness.sweep.matrix.matrix_summary import to_markdown
from harness.sweep.matrix.report._heatmap import known_figures
from tests.harness.sweep.matrix.stub import judge, matrix, played

SVG = "{http://www.w3.org/2000/svg}"


def breaks(scenario: Scenario, seed: int) -> Result:
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
    finished = played(matrix(seeds=[1, 3]), 1, breaks)
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


def test_the_summary_is_a_markdown_table_with_what_went_wrong_below() -> None:
    lines = to_markdown(played(matrix(name="a | b"), 1, breaks).record).splitlines()
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


def test_column_without_values_is_left_out() -> None:
    shown = Console(width=100, record=True, file=io.StringIO())
    shown.print(matrix_table.render(played(matrix(), 1, judge).record))
    assert "fin-" not in shown.export_text()
