"""Scenario files: a mistake is told with the key, the value and what is allowed."""

from pathlib import Path

import pytest

from harness.errors import ScenarioError
from harness.scenario import Scenario, load_scenario
from harness.timeline import network_changes

SCENARIOS = sorted((Path(__file__).parents[2] / "scenarios").glob("*.yaml"))


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "scenario.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("path", SCENARIOS, ids=lambda path: path.stem)
def test_every_scenario_of_the_library_is_valid_and_says_what_it_shows(path: Path) -> None:
    assert load_scenario(path).about
    assert path.read_text().startswith("#")


def test_a_name_is_enough_and_gives_the_thesis_s_experiment(tmp_path: Path) -> None:
    scenario = load_scenario(write(tmp_path, "name: x"))
    assert (scenario.roster, scenario.duration_s, scenario.network.loss) == ((1, 2, 3, 4, 5), 1200, 0)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("name: x\nspeedpu: 3", "`speedpu` is unknown: there are name, about, agents"),
        ("name: x\nnetwork: {lost: 1}", "`network.lost` is unknown: there are loss, receivers"),
        ("name: x\ntimeline: [{at_s: 1, heel: true}]", "`timeline.0.heel` is unknown"),
        ("agents: 3", "`name` is missing"),
        ("name: x\nnetwork: {loss: 1.5}", "`network.loss` is 1.5: it should be less than or equal to 1"),
        ("name: x\nnetwork: {loss: .nan}", "`network.loss` is nan"),
        ("name: x\nnetwork: {receivers: {9: {loss: 0.1}}}", "vehicle 9, which does not exist: there are 1, 2, 3, 4, 5"),
        ("name: x\ntimeline: [{at_s: 1, partition: [[1], [9]]}]", "unknown vehicle 9"),
        ("name: x\ntimeline: [{at_s: 1, partition: [[1], [1, 2]]}]", "vehicle 1 is in an earlier group too"),
        ("name: x\ntimeline: [{at_s: 1, heal: true}, {at_s: 1, loss: 0}]", "two entries"),
        ("name: x\ntimeline: [{at_s: 1, heal: true, loss: 0}]", "exactly one of"),
        ("name: x\ntimeline: [{at_s: 9999, heal: true}]", "after the mission's end at 1200 s"),
        ("name: x\nagents: 0", "number of agents 1..1000"),
        ("name: x\nagents: [1, 1]", "names 1 twice"),
        ("name: x\nagents: [1, 70000]", "70000 is not an agent ID"),
        ("name: x\nspeedup: 0", "`speedup` is 0: it should be greater than 0"),
        ("name: x\nsettings: {vote: 1}", "vote is unknown: there are vote_timeout_s"),
        ("name: x\nsettings: {vote_timeout_s: -1}", "vote_timeout_s must be more than 0"),
        ("name: x\nquirks: {ignore_commit: 2}", "probability 0..1"),
        ("name: x\nvehicles: {kind: boat}", "it should be 'ardupilot', 'embedded' or 'none'"),
        ("name: x\nvehicles: {home: [100, 0, 0, 0]}", "latitude -90..90"),
        ("name: [x", "not YAML at line 1"),
        ("- 1", "a YAML mapping"),
        ("!!python/object/apply:os.system ['true']", "not YAML"),
    ],
)
def test_a_mistake_names_the_key_the_value_and_what_is_allowed(tmp_path: Path, text: str, sentence: str) -> None:
    path = write(tmp_path, text)
    with pytest.raises(ScenarioError) as caught:
        load_scenario(path)
    message = str(caught.value)
    assert sentence in message
    assert message.startswith(str(path))
    assert "\n" not in message


def test_an_alias_bomb_is_refused_at_once(tmp_path: Path) -> None:
    lines = ["x0: &x0 [lol, lol]"] + [f"x{n}: &x{n} [{', '.join([f'*x{n - 1}'] * 9)}]" for n in range(1, 40)]
    bomb = write(tmp_path, "\n".join(lines) + "\nname: *x39")
    with pytest.raises(ScenarioError) as caught:
        load_scenario(bomb)
    assert len(str(caught.value)) < 1000


def test_a_missing_or_oversized_file_is_told(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match="cannot be read: No such file"):
        load_scenario(tmp_path / "none.yaml")
    with pytest.raises(ScenarioError, match="larger than"):
        load_scenario(write(tmp_path, "#" * 2_000_000))


def test_the_timeline_is_the_sequence_of_network_states() -> None:
    scenario = Scenario.model_validate(
        {
            "name": "x",
            "network": {"loss": 0.1, "receivers": {2: {"loss": 0.5}}},
            "timeline": [
                {"at_s": 600, "heal": True},
                {"at_s": 300, "partition": [[1, 2]]},
                {"at_s": 700, "loss": 0},
            ],
        }
    )
    changes = network_changes(scenario)
    assert [(change.at_s, change.what, change.detail) for change in changes] == [
        (0, "start", "loss 10 %, loss 50 % to 2"),
        (300, "partition", "loss 10 %, loss 50 % to 2, partition 1 2"),
        (600, "heal", "loss 10 %, loss 50 % to 2"),
        (700, "loss", "loss 0 %, loss 50 % to 2"),
    ]
    assert changes[1].conditions.is_cut(1, 3)
    assert not changes[1].conditions.is_cut(3, 4)  # the vehicles that no group names stay together


def test_a_change_at_mission_second_0_is_the_network_s_first_state() -> None:
    scenario = Scenario.model_validate({"name": "x", "timeline": [{"at_s": 0, "partition": [[1], [2]]}]})
    (change,) = network_changes(scenario)
    assert change.what == "partition"
