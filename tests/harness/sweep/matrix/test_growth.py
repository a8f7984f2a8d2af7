"""Test laws of growth in a matrix, without simulation.

Test the fit of power laws whose exponents are known.
"""

import csv
import itertools
import json
import math
import re
from pathlib import Path
from random import Random
from typing import Any
from xml.etree import ElementTree

import pytest
from rich.console import Console

from docs.generate.complexity import BEGIN, END, PAGE, tables
from harness.checker import Result
from harness.checker.judgement import Judgement
from harness.present import svg
from harness.scenario import Scenario
from harness.sweep.matrix import Matrix, MatrixRecord, matrix_outputs, matrix_table, run_matrix
from harness.sweep.matrix._growth import Variable, fit, overloaded
from harness.sweep.matrix._growth_picture import PANELS, draw_growth
from harness.sweep.matrix.matrix_run import on_cores
from tests.harness.sweep.matrix.stub import judge as judge_of_loss
from tests.harness.sweep.matrix.stub import matrix, played

SVG = "{http://www.w3.org/2000/svg}"


def sizes(
    agents: tuple[int, ...] = (5, 10, 40),
    lengths: tuple[float, ...] = (600, 1200, 2400),
    loss: tuple[float, ...] = (0.15,),
    seeds: int = 2,
) -> Matrix:
    return matrix(agents=list(agents), duration_s=list(lengths), loss=loss, seeds=seeds, scenario={})


def played_record(asked: Matrix) -> MatrixRecord:
    return played(asked, 1, judge).record


def judge(scenario: Scenario, seed: int) -> Result:
    """Return figures that follow known laws.

    Each agent completes a block in 200 s. N agents with B blocks send 3 N^1.5 B messages. Swarms of 40 and more agents
    never settle.
    """
    agents = len(scenario.roster)
    blocks = round(agents * scenario.duration_s / 200)
    messages = round(3 * agents**1.5 * blocks) if scenario.network.loss else 0
    figures: dict[str, Any] = {
        "agents": agents,
        "blocks": blocks,
        "mutual_chain": blocks,
        "longest_chain": blocks,
        "distinct_chains": seed,
        "uniform_at_s": scenario.duration_s + agents if seed == 1 else None,
        "reconciles": 0,
        "messages": messages,
        "bytes": 100 * messages,
        "messages_per_block": messages / blocks if blocks else None,
    }
    verdict: Any = "finished" if agents < 40 else "not finished"
    return Result({"3": Judgement("3", "holds", "")}, figures, {"liveness": Judgement("liveness", verdict, "")})


def shown(record: MatrixRecord, width: int = 80) -> str:
    console = Console(width=width)
    with console.capture() as capture:
        console.print(matrix_table.render(record))
    return capture.get().replace("\u00a0", " ")


def parsed(drawing: str) -> ElementTree.Element:
    return ElementTree.fromstring(drawing)  # noqa: S314 - ours


def test_matrix_finds_the_laws_that_its_runs_follow() -> None:
    growths = played_record(sizes()).growths
    found = {(it.metric, it.over, it.duration_s, it.agents): it.law for it in growths if it.load == "any"}
    assert found["messages", ("agents",), 600, None].exponents["agents"].value == pytest.approx(2.5, abs=1e-3)
    per_block = found["messages_per_block", ("agents",), 1200, None]
    assert per_block.exponents["agents"].value == pytest.approx(1.5, abs=1e-3)
    assert found["bytes", ("blocks",), None, 40].exponents["blocks"].value == pytest.approx(1, abs=1e-3)
    both = found["messages", ("agents", "blocks"), None, None].exponents
    assert (both["agents"].value, both["blocks"].value) == pytest.approx((1.5, 1), abs=1e-3)
    late = found["uniform_after_s", ("agents",), 600, None]
    assert (late.n, late.left_out, late.exponents["agents"].value) == (3, 3, 1)


def test_cells_on_both_sides_of_load_1_have_laws_of_their_own() -> None:
    record = played_record(sizes((5, 10, 15, 40, 80, 90)))
    assert [cell.agents for cell in record.cells if overloaded(cell)] == [40, 80, 90] * 3
    assert {it.load for it in record.growths} == {"any", "below 1", "from 1"}


def test_cell_has_the_shares_of_uniform_and_finished_runs() -> None:
    record = played_record(sizes())
    assert [cell.estimates["uniform"].mean for cell in record.cells] == [0.5] * 9
    assert [cell.finished.mean for cell in record.cells] == [1, 1, 0] * 3
    assert record.cells[0].estimates["uniform_after_s"].n == 1


def test_growth_does_not_depend_on_the_number_of_jobs() -> None:
    one, two = (played(sizes(loss=(0.0, 0.15)), jobs, judge) for jobs in (1, 2))
    assert one.runs == two.runs
    assert one.record.cells == two.record.cells
    assert one.record.growths == two.record.growths


def test_longest_runs_start_first_and_results_are_in_order() -> None:
    order: list[tuple[int, float]] = []

    def noted(scenario: Scenario, seed: int) -> Result:
        order.append((len(scenario.roster), scenario.duration_s))
        return judge(scenario, seed)

    finished = played(sizes(lengths=(600, 1200), seeds=1), 1, noted)
    assert order == [(40, 1200), (40, 600), (10, 1200), (10, 600), (5, 1200), (5, 600)]
    in_order = [(5, 600), (10, 600), (40, 600), (5, 1200), (10, 1200), (40, 1200)]
    assert [(run.agents, run.duration_s) for run in finished.runs] == in_order


def test_files_of_growth_read_back_as_they_were_written(tmp_path: Path) -> None:
    finished = played(sizes(), 1, judge)
    matrix_outputs.write(finished, tmp_path)
    assert MatrixRecord.model_validate_json((tmp_path / "matrix.json").read_text()) == finished.record
    with (tmp_path / "runs.csv").open() as file:
        runs = list(csv.DictReader(file))
    assert [*runs[0]][:5] == ["loss", "agents", "backend", "duration_s", "seed"]
    assert (runs[0]["loss"], runs[0]["agents"], runs[0]["duration_s"], runs[0]["seed"]) == ("0.15", "5", "600.0", "1")
    assert (float(runs[0]["uniform_after_s"]), runs[1]["uniform_after_s"]) == (5, ""), "an unknown figure is empty"
    with (tmp_path / "matrix.csv").open() as file:
        assert {cell["duration_s"] for cell in csv.DictReader(file)} == {"600.0", "1200.0", "2400.0"}
    parsed((tmp_path / "growth.svg").read_text())


def test_report_and_file_names_contain_the_mission_length(tmp_path: Path) -> None:
    finished = played(sizes(agents=(5,), seeds=1), 1, judge)
    matrix_outputs.write(finished, tmp_path)
    assert sorted(path.name for path in (tmp_path / "cells").iterdir()) == [
        "loss-0.15-agents-5-duration-1200.0.yaml",
        "loss-0.15-agents-5-duration-2400.0.yaml",
        "loss-0.15-agents-5-duration-600.0.yaml",
    ]
    page = (tmp_path / "report.html").read_text().replace("\u00a0", " ")
    assert "600 s, 1200 s, 2400 s mission" in page
    assert "<caption>sim, 600 s</caption>" in page and "<caption>sim, 1200 s</caption>" in page
    identifiers = re.findall(r'\bid="([^"]*)"', page)
    assert len(identifiers) == len(set(identifiers))
    assert "| length |" in (tmp_path / "summary.md").read_text()
    assert 'name="15 % loss, 1200 s"' in (tmp_path / "junit.xml").read_text().replace("\u00a0", " ")


def test_matrix_of_lengths_alone_grows_over_blocks(tmp_path: Path) -> None:
    asked = matrix(duration_s=[600, 1200, 2400], loss=(0.0, 0.15), seeds=2)
    finished = played(asked, 1, judge)
    assert {(it.over, it.agents) for it in finished.record.growths} == {(("blocks",), 5)}
    matrix_outputs.write(finished, tmp_path)
    texts = ["".join(text.itertext()) for text in parsed((tmp_path / "growth.svg").read_text()).iter(f"{SVG}text")]
    assert {f"{panel.title}, over blocks" for panel in PANELS} <= set(texts)
    assert "B 5 agents" in shown(finished.record)


def test_interrupted_matrix_has_growth_of_the_runs_that_had_ended(tmp_path: Path) -> None:
    calls = itertools.count()

    def interrupted(scenario: Scenario, seed: int) -> Result:
        if next(calls) == 5:
            raise KeyboardInterrupt
        return judge(scenario, seed)

    finished = played(sizes(), 1, interrupted)
    assert (finished.record.runs, finished.record.runs_asked, finished.record.exit_status) == (5, 18, 130)
    matrix_outputs.write(finished, tmp_path)
    assert "interrupted: 18 were asked for" in (tmp_path / "growth.svg").read_text()
    assert '<h2 id="growth">' in (tmp_path / "report.html").read_text()


def test_matrix_interrupted_before_its_first_run_ended_has_a_picture(tmp_path: Path) -> None:
    def interrupted(scenario: Scenario, seed: int) -> Result:
        raise KeyboardInterrupt

    finished = played(sizes(), 1, interrupted)
    matrix_outputs.write(finished, tmp_path)
    assert "No run has ended." in (tmp_path / "growth.svg").read_text()
    assert finished.record.growths == []
    assert shown(finished.record)


def test_failed_run_is_named_with_its_length_and_is_no_point_of_a_law() -> None:
    def breaks(scenario: Scenario, seed: int) -> Result:
        if seed == 2 and len(scenario.roster) == 5 and scenario.duration_s == 600:
            raise KeyError("block")
        return judge(scenario, seed)

    record = played(sizes(), 1, breaks).record
    assert [(cell.runs, cell.failed) for cell in record.cells] == [(2, 1)] + [(2, 0)] * 8
    assert record.exit_status == 1
    assert "15 % loss, 5 agents, 600 s: seed 2 failed: KeyError: 'block'" in shown(record, 200)
    laws = [it.law for it in record.growths if it.metric == "messages" and (it.duration_s, it.load) == (600, "any")]
    assert [(law.n, law.left_out) for law in laws] == [(5, 0)]


@pytest.mark.parametrize(
    "asked",
    [
        sizes(seeds=1),
        sizes(agents=(1, 2, 3), lengths=(6,), seeds=1),
        sizes(loss=(0.0,)),
        sizes(loss=(0.0, 0.1, 0.2), lengths=(60, 120, 240)),
        sizes(agents=tuple(range(5, 60)), lengths=(600,)),
        sizes(agents=(5,)),
    ],
    ids=["one seed", "hardly a block", "no message", "many lines", "many agents", "one number of agents"],
)
def test_any_growth_can_be_shown_and_drawn(asked: Matrix) -> None:
    record = played_record(asked)
    assert shown(record)
    drawing = parsed(draw_growth(record))
    places = [float(dot.attrib[axis]) for dot in drawing.iter(f"{SVG}circle") for axis in ("cx", "cy")]
    assert all(0 <= place <= svg.WIDTH for place in places)


def test_picture_has_panels_exponents_and_a_description_and_no_links() -> None:
    drawing = draw_growth(played_record(sizes()))
    texts = ["".join(element.itertext()) for element in parsed(drawing).iter(f"{SVG}text")]
    assert {panel.title for panel in PANELS} <= set(texts)
    assert {"Messages, over blocks", "Bytes, over blocks"} <= set(texts)
    assert any(text.startswith("N2.50 \u00b1") for text in texts)
    assert "Messages per block, 600\u00a0s (exponent 1.50" in drawing
    assert set(re.findall(r"https?://[^\"']*", drawing)) == {"http://www.w3.org/2000/svg"}


def test_table_of_growth_fits_eighty_columns() -> None:
    lines = shown(played_record(sizes((5, 10, 40, 80))))
    assert "\u2026" not in lines
    assert max(map(len, lines.splitlines())) <= 80
    assert "N 600 s, load < 1" in lines
    assert "B 40 agents" in lines
    assert "2.50\u00b1.00" in lines


def test_matrix_without_three_sizes_has_no_growth(tmp_path: Path) -> None:
    finished = played(matrix(agents=[5, 10], scenario={}), 1, judge_of_loss)
    matrix_outputs.write(finished, tmp_path)
    assert finished.record.growths == []
    assert not (tmp_path / "growth.svg").exists()
    with (tmp_path / "runs.csv").open() as file:
        assert "duration_s" not in next(csv.reader(file))


def test_matrix_without_traces_has_the_same_figures_and_judges_no_step(tmp_path: Path) -> None:
    keys: dict[str, Any] = {"loss": (0.3,), "seeds": 1, "scenario": {"agents": 3, "duration_s": 300}}
    runs = []
    for traces in (True, False):
        asked = matrix(**keys, traces=traces)
        runs += run_matrix(asked, tmp_path / str(traces), on_cores(asked, 1)).runs
    traced, untraced = runs
    assert untraced.figures == traced.figures
    changed = {key for key, verdict in traced.verdicts.items() if untraced.verdicts[key] != verdict}
    assert changed == {"1", "steps", "records"}
    assert {untraced.verdicts[key] for key in changed} == {"not applicable"}


def test_page_has_the_tables_of_a_matrix() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert page.count(BEGIN) == page.count(END) == 1
    text = tables(played_record(sizes((5, 10, 40, 80))))
    assert "| 15\u00a0% | 5 | 30 |" in text
    assert "| 15\u00a0% | any | N | 1.50\u00b1.00<br>" in text
    assert len({line.count("|") for line in text.split("\n\n")[0].splitlines()}) == 1


def test_growth_in_the_record_names_the_scope_of_each_law() -> None:
    laws = json.loads(played_record(sizes(lengths=(600,))).model_dump_json())["growths"]
    assert {(law["backend"], law["loss"], law["duration_s"], law["agents"]) for law in laws} == {
        ("sim", 0.15, 600, None)
    }


AGENTS: list[Variable] = ["agents"]
BOTH: list[Variable] = ["agents", "blocks"]


@pytest.mark.parametrize("exponent", [-1.0, 0.0, 0.5, 1.0, 2.0, 3.3])
def test_law_without_noise_is_found_exactly(exponent: float) -> None:
    law = fit(AGENTS, [([n], 0.7 * n**exponent) for n in (5, 10, 20, 50, 200)])
    assert law
    found = law.exponents["agents"]
    assert (found.value, found.low, found.high) == pytest.approx((exponent,) * 3, abs=1e-6)
    assert law.factor == pytest.approx(0.7, rel=1e-5)
    assert law.r_squared == (None if exponent == 0 else pytest.approx(1))
    assert (law.n, law.left_out) == (5, 0)


def test_fit_separates_two_variables() -> None:
    law = fit(BOTH, [([n, n * m], 2 * n**1.5 * (n * m) ** 0.8) for n in (5, 20, 80) for m in (3, 6, 12)])
    assert law
    assert law.exponents["agents"].value == pytest.approx(1.5)
    assert law.exponents["blocks"].value == pytest.approx(0.8)
    assert law.factor == pytest.approx(2)
    assert law.r_squared == pytest.approx(1)


@pytest.mark.parametrize("variables", [AGENTS, BOTH])
def test_nineteen_of_twenty_intervals_contain_the_exponent_of_noisy_data(variables: list[Variable]) -> None:
    random = Random(1)
    trials, held = 400, 0
    for _ in range(trials):
        sizes = [(n, n * m) for n in (5, 10, 20, 50) for m in (1, 2, 4)]
        points = [
            ((n, b)[: len(variables)], 4 * n**2 * math.exp(random.gauss(0, 0.3)) * (b if len(variables) > 1 else 1))
            for n, b in sizes
        ]
        law = fit(variables, points)
        assert law
        held += law.exponents["agents"].low <= 2 <= law.exponents["agents"].high
    assert 0.91 <= held / trials <= 0.99


def test_interval_equals_that_of_a_worked_example() -> None:
    """The logarithms are x = 1 to 5 and y = 2, 4, 5, 4, 5. The slope is 0.6, the standard error sqrt(0.08), and t is
    3.1824.
    """
    law = fit(AGENTS, [([math.exp(x)], math.exp(y)) for x, y in zip(range(1, 6), (2, 4, 5, 4, 5), strict=True)])
    assert law
    found = law.exponents["agents"]
    assert found.value == pytest.approx(0.6)
    assert found.high - found.value == pytest.approx(3.1824463 * math.sqrt(0.08), rel=1e-5)
    assert law.r_squared == pytest.approx(0.6)


def test_points_without_logarithm_are_left_out_and_counted() -> None:
    law = fit(AGENTS, [([n], y) for n, y in ((1, 1), (2, 4), (4, 16), (8, 0), (16, -3), (0, 5))])
    assert law
    assert (law.n, law.left_out) == (3, 3)
    assert law.exponents["agents"].value == pytest.approx(2)


@pytest.mark.parametrize(
    ("variables", "points"),
    [
        (AGENTS, []),
        (AGENTS, [([5.0], 1.0), ([10.0], 2.0)]),
        (AGENTS, [([5.0], 1.0), ([5.0], 2.0), ([5.0], 3.0)]),
        (AGENTS, [([5.0], 0.0), ([10.0], 0.0), ([20.0], 0.0)]),
        (BOTH, [([n, 3 * n], 2.0 * n) for n in (5.0, 10.0, 20.0, 40.0)]),
        (BOTH, [([5.0, b], 2.0 * b) for b in (5.0, 10.0, 20.0, 40.0)]),
        (BOTH, [([n, 7.0], 2.0 * n) for n in (5.0, 10.0, 20.0, 40.0)]),
    ],
    ids=["nothing", "two points", "one size", "no messages", "two as one", "one number of agents", "one of blocks"],
)
def test_fit_finds_no_law_in_unsuitable_points(
    variables: list[Variable], points: list[tuple[list[float], float]]
) -> None:
    assert fit(variables, points) is None
