"""Test the matrix file: its contents, and the error messages about mistakes in it."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from harness.errors import ScenarioError
from harness.sweep.matrix import Matrix, load_matrix
from harness.sweep.matrix._matrix_file import MatrixPoint

SCENARIOS = Path(__file__).parents[4] / "scenarios"
THESIS = SCENARIOS / "thesis_matrix.yaml"
NIGHTLY = Path(__file__).parents[4] / "docs/how-to/run-a-matrix-every-night.md"


def written(directory: Path, **keys: Any) -> Path:
    path = directory / "matrix.yaml"
    document = {"name": "test", "scenario": {"agents": 3}, "loss": [0.0, 0.5], "seeds": 2, **keys}
    path.write_text(json.dumps({key: value for key, value in document.items() if value is not None}))
    return path


def test_thesis_matrix_has_the_rates_of_section_4_2() -> None:
    matrix = load_matrix(THESIS)
    assert matrix.loss == [0.0, 0.1, 0.15, 0.25, 0.3, 0.5, 0.75, 1.0]
    assert matrix.seed_list == list(range(1, 201))
    assert matrix.scenario.name == matrix.name
    assert len(matrix.scenario.roster) == 5


def test_growth_matrix_grows_with_agents_and_lengths_and_leaves_no_traces() -> None:
    matrix = load_matrix(SCENARIOS / "growth_matrix.yaml")
    assert matrix.grows_with_agents and matrix.grows_with_length
    assert (len(matrix.tasks), matrix.traces) == (7 * 3 * 2 * 3, False)


def test_page_on_nights_begins_with_a_matrix_of_six_cells() -> None:
    block = re.search(r" *```yaml\n(.*?)```", NIGHTLY.read_text(), re.DOTALL)
    assert block is not None
    assert len(Matrix.model_validate(yaml.safe_load(block[1])).points) == 6


def test_each_cell_has_the_scenario_with_its_loss(tmp_path: Path) -> None:
    scenario = {"agents": 3, "network": {"receivers": {2: {"loss": 0.9}}}}
    cell = load_matrix(written(tmp_path, scenario=scenario)).scenario_at(MatrixPoint(0.5, 3, "sim"))
    assert cell.network.loss == 0.5
    assert cell.network.receivers[2].loss == 0.9
    assert cell.agents == 3


def test_scenario_may_be_in_a_separate_file(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text("name: base\nagents: 7")
    matrix = load_matrix(written(tmp_path, scenario="base.yaml"))
    assert (matrix.scenario.name, matrix.scenario.agents) == ("base", 7)


def test_cells_are_all_combinations_of_backends_agents_and_losses(tmp_path: Path) -> None:
    asked = load_matrix(written(tmp_path, scenario={}, agents=[3, 10], backend=["sim", "process"]))
    assert asked.points == [
        MatrixPoint(loss, agents, backend) for backend in asked.backend for agents in (3, 10) for loss in (0.0, 0.5)
    ]
    assert len(asked.tasks) == len(set(asked.tasks)) == 2 * len(asked.points)
    assert len(asked.scenario_at(MatrixPoint(0.5, 10, "sim")).roster) == 10


def test_cells_have_the_mission_lengths_of_the_axis(tmp_path: Path) -> None:
    asked = load_matrix(written(tmp_path, duration_s=[60, 90.5]))
    assert asked.points == [MatrixPoint(loss, 3, "sim", length) for length in (60, 90.5) for loss in (0.0, 0.5)]
    assert [asked.scenario_at(point).duration_s for point in asked.points] == [60, 60, 90.5, 90.5]
    assert asked.points[2].file_name == "loss-0.0-agents-3-duration-90.5"


def test_without_the_axis_the_length_is_the_scenarios(tmp_path: Path) -> None:
    asked = load_matrix(written(tmp_path, scenario={"agents": 3, "duration_s": 77}))
    assert asked.points[0].duration_s is None
    assert asked.points[0].file_name == "loss-0.0-agents-3"
    assert asked.scenario_at(asked.points[0]).duration_s == 77
    assert asked.lengths == [77]


def test_growth_needs_three_values_of_an_axis(tmp_path: Path) -> None:
    two = load_matrix(written(tmp_path, scenario={}, agents=[2, 3], duration_s=[60, 90]))
    assert not two.grows
    three = load_matrix(written(tmp_path, duration_s=[60, 90, 120]))
    assert (three.grows_with_agents, three.grows_with_length, three.grows) == (False, True, True)


def test_axis_may_be_one_value(tmp_path: Path) -> None:
    asked = load_matrix(written(tmp_path, scenario={}, agents=7, duration_s=60, backend="process"))
    assert (asked.agents, asked.duration_s, asked.backend) == ([7], [60], ["process"])


def test_without_the_axis_agents_are_the_scenarios(tmp_path: Path) -> None:
    asked = load_matrix(written(tmp_path, scenario={"agents": [7, 9]}))
    assert asked.points[1] == MatrixPoint(0.5, 2, "sim")
    assert asked.scenario_at(asked.points[1]).roster == (7, 9)


def test_separate_scenario_file_must_not_set_the_axis(tmp_path: Path) -> None:
    base = tmp_path / "base.yaml"
    base.write_text("name: base")
    assert load_matrix(written(tmp_path, scenario="base.yaml", agents=[2, 4])).scenario.agents == 2
    base.write_text("name: base\nagents: 7")
    with pytest.raises(ScenarioError, match="sets agents to 7"):
        load_matrix(written(tmp_path, scenario="base.yaml", agents=[2, 4]))


def test_mistake_in_a_separate_scenario_file_names_the_file(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text("name: base\nagents: 0")
    with pytest.raises(ScenarioError, match=r"base\.yaml: `agents`"):
        load_matrix(written(tmp_path, scenario="base.yaml"))


def test_matrix_in_matrix_json_can_be_loaded_again(tmp_path: Path) -> None:
    matrix = load_matrix(written(tmp_path, scenario={}, agents=[3, 4], duration_s=[60, 90.5], traces=False))
    assert Matrix.model_validate_json(matrix.model_dump_json()) == matrix


@pytest.mark.parametrize(
    ("keys", "sentence"),
    [
        ({"loss": [0.0, 1.5]}, "`loss.1` is 1.5: it should be less than or equal to 1"),
        ({"loss": []}, "`loss` is []: List should have at least 1 item"),
        ({"loss": [0.1, 0.2, 0.1]}, "`loss` is [0.1, 0.2, 0.1]: names 0.1 twice"),
        ({"loss": None}, "`loss` is missing"),
        ({"seeds": 0}, "`seeds` is 0: it should be a number of seeds 1..10000, or a list of them"),
        ({"seeds": True}, "`seeds` is True: it should be a number of seeds"),
        ({"seeds": "many"}, "`seeds` is 'many': it should be a number of seeds"),
        ({"seeds": [1, -1]}, "`seeds` is [1, -1]: -1 is not a seed: it should be 0..4294967295"),
        ({"seeds": [7, 7]}, "`seeds` is [7, 7]: names 7 twice"),
        (
            {"losses": [0.1]},
            "`losses` is unknown: use one of name, about, scenario, loss, seeds, agents, duration_s, "
            "backend, keep, traces",
        ),
        ({"scenario": {"agents": 0}}, "`scenario.agents` is 0: use a number of agents 1..1000"),
        ({"scenario": {"agent": 5}}, "`scenario.agent` is unknown: use one of name, about, agents,"),
        (
            {"scenario": {"network": {"loss": 0.2}}},
            "sets network.loss to 0.2, but the key `loss` of the matrix sets it",
        ),
        ({"agents": [5]}, "`scenario` sets agents to 3, but the key `agents` of the matrix sets it"),
        ({"agents": [5, 0], "scenario": {}}, "`agents.1` is 0: it should be greater than or equal to 1"),
        ({"agents": [5, 5], "scenario": {}}, "`agents` is [5, 5]: names 5 twice"),
        (
            {"agents": [5, 3], "scenario": {"clocks": {4: {"drift": 0.1}}}},
            "`scenario` is wrong if `agents` has 3: clocks names vehicle 4",
        ),
        ({"duration_s": [60, 0]}, "`duration_s.1` is 0: it should be greater than 0"),
        ({"duration_s": [60, -1]}, "`duration_s.1` is -1: it should be greater than 0"),
        ({"duration_s": []}, "`duration_s` is []: List should have at least 1 item"),
        ({"duration_s": [60, 60.0]}, "`duration_s` is [60, 60.0]: names 60.0 twice"),
        ({"duration_s": [60, "Infinity"]}, "`duration_s.1` is 'Infinity': it should be a finite number"),
        ({"duration_s": [60, "NaN"]}, "`duration_s.1` is 'NaN': it should be a finite number"),
        ({"duration_s": [60, 1e9]}, "`duration_s.1` is 1000000000.0: it should be less than or equal to"),
        ({"duration_s": [60, "long"]}, "`duration_s.1` is 'long': it should be a valid number"),
        (
            {"duration_s": [60], "scenario": {"duration_s": 90}},
            "`scenario` sets duration_s to 90, but the key `duration_s` of the matrix sets it",
        ),
        (
            {"duration_s": [600, 60], "scenario": {"timeline": [{"at_s": 100, "kill": [1]}]}},
            "`scenario` is wrong if `duration_s` has 60: ",
        ),
        (
            {"agents": [5, 3], "duration_s": [60], "scenario": {"clocks": {4: {"drift": 0.1}}}},
            "`scenario` is wrong if `agents` has 3 and `duration_s` has 60: clocks names vehicle 4",
        ),
        ({"traces": 2}, "`traces` is 2: "),
        ({"backend": "kernel"}, "`backend.0` is 'kernel': it should be 'process', 'docker' or 'sim'"),
        ({"keep": "none"}, "`keep` is 'none': it should be 'violated' or 'all'"),
        (
            {"delay": [0.1]},
            "`delay` is unknown: use one of name, about, scenario, loss, seeds, agents, duration_s, "
            "backend, keep, traces",
        ),
        ({"scenario": "nowhere.yaml"}, "nowhere.yaml: no such file or scenario"),
        ({"name": None}, "is missing"),
        ({"scenario": None, "timeline": []}, "this is a scenario; a matrix names one, `scenario: "),
    ],
)
def test_mistake_is_reported_with_key_value_and_allowed_values(
    tmp_path: Path, keys: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(ScenarioError) as error:
        load_matrix(written(tmp_path, **keys))
    assert sentence in str(error.value)
    assert str(tmp_path) in str(error.value)
    assert "\n" not in str(error.value)
