"""A sweep from its runs to its files, with a judge in the place of the simulation."""

import csv
import itertools
import json
import re
from pathlib import Path
from xml.etree import ElementTree

import pytest
from rich.console import Console

from docs.generate.complexity import BEGIN, END, PAGE, tables
from harness.checker import Result
from harness.play.mission import RunOutcome
from harness.scenario import Scenario
from harness.sweep.scale import Scale, ScaleRecord, outputs, run_scale, table
from harness.sweep.scale._picture import PANELS, draw
from tests.harness.sweep.scale.stub import judge, scale

SVG = "{http://www.w3.org/2000/svg}"


def shown(record: ScaleRecord, width: int = 80) -> str:
    console = Console(width=width)
    with console.capture() as capture:
        console.print(table.render(record))
    return capture.get().replace("\u00a0", " ")


def parsed(drawing: str) -> ElementTree.Element:
    return ElementTree.fromstring(drawing)  # noqa: S314 - ours


def test_it_finds_the_laws_that_the_runs_follow() -> None:
    record = run_scale(scale(), 1, judge).record
    found = {(it.metric, it.over, it.minutes, it.agents): it.law for it in record.growths if it.load == "any"}
    assert found["messages", ("agents",), 10, None].exponents["agents"].value == pytest.approx(2.5, abs=1e-3)
    assert found["messages_per_block", ("agents",), 20, None].exponents["agents"].value == pytest.approx(1.5, abs=1e-3)
    assert found["bytes", ("blocks",), None, 40].exponents["blocks"].value == pytest.approx(1, abs=1e-3)
    both = found["messages", ("agents", "blocks"), None, None].exponents
    assert (both["agents"].value, both["blocks"].value) == pytest.approx((1.5, 1), abs=1e-3)
    late = found["uniform_after_s", ("agents",), 10, None]
    assert (late.n, late.left_out, late.exponents["agents"].value) == (3, 3, 1)


def test_sizes_whose_blocks_come_faster_than_votes_end_have_laws_of_their_own() -> None:
    record = run_scale(scale(agents=(5, 10, 40, 80)), 1, judge).record
    assert [cell.agents for cell in record.cells if cell.overloaded] == [40, 80, 40, 80]
    assert {it.load for it in record.growths} == {"any", "below 1", "from 1"}
    assert {it.load for it in run_scale(scale(), 1, judge).record.growths if it.minutes} == {"any", "below 1"}


def test_a_cell_says_how_many_runs_are_uniform_and_how_many_settled() -> None:
    record = run_scale(scale(), 1, judge).record
    assert [cell.estimates["uniform"].mean for cell in record.cells] == [0.5] * 6
    assert [cell.estimates["settled"].mean for cell in record.cells] == [1, 1, 0] * 2
    assert record.cells[0].estimates["uniform_after_s"].n == 1
    assert "15 % loss: not settled in 20 min, with figures up to then: 10 min 40 agents (2 of 2)" in shown(record, 200)


def test_what_is_not_of_this_machine_does_not_depend_on_the_number_of_jobs() -> None:
    one, two = (run_scale(scale(loss=(0.0, 0.15)), jobs, judge) for jobs in (1, 2))
    assert one.record.repeatable() == two.record.repeatable()
    assert [(run.size, run.seed) for run in one.runs] == [(run.size, run.seed) for run in two.runs]
    assert "processor_s" not in json.dumps(one.record.repeatable())
    assert "wall_s" not in json.dumps(one.record.repeatable())


def test_the_longest_come_first_and_results_are_in_order() -> None:
    order: list[tuple[int, float]] = []

    def noted(scenario: Scenario, seed: int) -> tuple[RunOutcome, Result]:
        order.append((len(scenario.roster), scenario.duration_s / 60))
        return judge(scenario, seed)

    finished = run_scale(scale(seeds=1), 1, noted)
    assert order == [(40, 20), (40, 10), (10, 20), (10, 10), (5, 20), (5, 10)]
    assert [run.size[1:] for run in finished.runs] == [(10, 5), (10, 10), (10, 40), (20, 5), (20, 10), (20, 40)]


def test_the_files_read_back_as_what_they_were_written_from(tmp_path: Path) -> None:
    finished = run_scale(scale(), 1, judge)
    outputs.write(finished, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"scale.json", "scale.csv", "scale.svg", "report.html"}
    document = json.loads((tmp_path / "scale.json").read_text())
    assert document["schema"] == "ucp-scale/1"
    assert ScaleRecord.model_validate(document) == finished.record
    with (tmp_path / "scale.csv").open() as file:
        runs = list(csv.DictReader(file))
    assert len(runs) == 12
    assert (runs[0]["loss"], runs[0]["minutes"], runs[0]["agents"], runs[0]["seed"]) == ("0.15", "10.0", "5", "1")
    assert (float(runs[0]["uniform_after_s"]), runs[1]["uniform_after_s"]) == (5, ""), "unknown is empty"
    assert list(runs[0])[-2:] == ["machine_processor_s", "machine_wall_s"]
    parsed((tmp_path / "scale.svg").read_text())


def test_an_interrupt_keeps_the_runs_that_had_ended(tmp_path: Path) -> None:
    calls = itertools.count()

    def interrupted(scenario: Scenario, seed: int) -> tuple[RunOutcome, Result]:
        if next(calls) == 5:
            raise KeyboardInterrupt
        return judge(scenario, seed)

    finished = run_scale(scale(), 1, interrupted)
    assert (finished.record.runs, finished.record.runs_asked) == (5, 12)
    assert finished.record.exit_status == 130
    outputs.write(finished, tmp_path)
    assert json.loads((tmp_path / "scale.json").read_text())["outcome"] == "interrupted"
    assert "interrupted: 12 were asked for" in (tmp_path / "scale.svg").read_text()
    page = (tmp_path / "report.html").read_text()
    assert "This was interrupted: 5 of 12 runs had ended." in page
    assert page.count('<section aria-labelledby="loss-') == len(finished.record.scale.loss)
    assert page.count("<script") == 0


def test_an_interrupt_before_the_first_run_ended_leaves_files_all_the_same(tmp_path: Path) -> None:
    def interrupted(scenario: Scenario, seed: int) -> tuple[RunOutcome, Result]:
        raise KeyboardInterrupt

    finished = run_scale(scale(), 1, interrupted)
    outputs.write(finished, tmp_path)
    parsed((tmp_path / "scale.svg").read_text())
    assert "0 of 12 runs had ended" in (tmp_path / "report.html").read_text()
    assert ScaleRecord.model_validate_json((tmp_path / "scale.json").read_text()).cells == []
    assert shown(finished.record)


def test_a_run_that_fails_is_told_and_the_others_count() -> None:
    def breaks(scenario: Scenario, seed: int) -> tuple[RunOutcome, Result]:
        if seed == 2 and len(scenario.roster) == 5:
            raise KeyError("block")
        return judge(scenario, seed)

    record = run_scale(scale(minutes=(10,)), 2, breaks).record
    assert [(cell.runs, cell.failed) for cell in record.cells] == [(2, 1), (2, 0), (2, 0)]
    assert record.exit_status == 1
    assert "5 agents: seed 2 failed: KeyError: 'block'" in shown(record, 200)


@pytest.mark.parametrize(
    "asked",
    [
        scale(agents=(5,), minutes=(10,), seeds=1),
        scale(agents=(1, 2), minutes=(0.1,), seeds=1),
        scale(loss=(0.0,)),
        scale(loss=(0.0, 0.1, 0.2), minutes=(1, 2, 4)),
        scale(agents=tuple(range(5, 60))),
    ],
    ids=["one size", "hardly a block", "no message", "many lines", "many agents"],
)
def test_any_sweep_can_be_shown_and_drawn(asked: Scale) -> None:
    record = run_scale(asked, 1, judge).record
    assert shown(record)
    drawing = parsed(draw(record))
    places = [float(dot.attrib[axis]) for dot in drawing.iter(f"{SVG}circle") for axis in ("cx", "cy")]
    assert all(0 <= place <= 900 for place in places)


def test_the_picture_has_panels_exponents_and_a_description_and_refers_to_nothing() -> None:
    drawing = draw(run_scale(scale(), 1, judge).record)
    texts = ["".join(element.itertext()) for element in parsed(drawing).iter(f"{SVG}text")]
    assert {panel.title for panel in PANELS if panel.over == "agents"} <= set(texts)
    assert "Messages, over blocks" in texts
    assert any(text.startswith("N2.50 \u00b1") for text in texts)
    assert "Messages per block, 10\u00a0min (exponent 1.50" in drawing
    assert set(re.findall(r"https?://[^\"']*", drawing)) == {"http://www.w3.org/2000/svg"}


def test_the_table_fits_eighty_columns() -> None:
    lines = shown(run_scale(scale(agents=(5, 10, 40, 80)), 1, judge).record)
    assert "\u2026" not in lines
    assert "N 10 min, load < 1" in lines
    assert "B 40 agents" in lines
    assert "2.50\u00b1.00" in lines


def test_the_page_has_the_tables_of_a_sweep() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert page.count(BEGIN) == page.count(END) == 1
    text = tables(run_scale(scale(agents=(5, 10, 40, 80)), 1, judge).record)
    assert "| 15\u00a0% | 5 | 30 |" in text
    assert "| 15\u00a0% | any | N | 1.50\u00b1.00<br>" in text
    assert len({line.count("|") for line in text.split("\n\n")[0].splitlines()}) == 1
