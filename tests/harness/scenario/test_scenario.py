"""Test scenario files: an error message names the key, the value and the allowed values."""

from pathlib import Path

import pytest

from harness.errors import ScenarioError
from harness.scenario import Scenario, load_scenario
from harness.scenario.changes import NetworkChange, describe, timeline_of
from harness.scenario.load import parse, parse_yaml
from netem.conditions import Delay, GilbertElliott, LinkConditions, NetworkConditions

LIBRARY = sorted((Path(__file__).parents[3] / "scenarios").glob("*.yaml"))
SCENARIOS = [path for path in LIBRARY if not path.stem.endswith("_matrix")]


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "scenario.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("path", SCENARIOS, ids=lambda path: path.stem)
def test_library_scenario_is_valid_and_has_a_description(path: Path) -> None:
    assert load_scenario(path).about
    assert path.read_text().startswith("#")


def test_scenario_with_only_a_name_is_the_experiment_of_the_thesis(tmp_path: Path) -> None:
    scenario = load_scenario(write(tmp_path, "name: x"))
    assert (scenario.roster, scenario.duration_s, scenario.network.loss) == ((1, 2, 3, 4, 5), 1200, 0)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("name: x\nspeedpu: 3", "`speedpu` is unknown: use one of name, about, agents"),
        ("name: x\nscenario: {name: y}", "this is a matrix: play it with `ucp-harness matrix "),
        ("name: x\nspeedpu: 3", "; did you mean `speedup`?"),
        ("name: x\ntimeline: [{at_s: 3, partion: [[1]]}]", "; did you mean `partition`?"),
        ("name: x\nsettings: {vote_timout_s: 3}", "; did you mean `vote_timeout_s`?"),
        ("name: x\nvehicles: {kind: ardupilt}", "; did you mean `ardupilot`?"),
        ("name: x\nexpect: {6: violated}", "`expect.6` is unknown: use one of characteristics, "),
        ("name: x\nexpect: {figures: {mutual_chian: 3}}", "; did you mean `mutual_chain`?"),
        ("name: x\ntimeline: [{at_s: 1, kill: 2}]", "`timeline.0.kill` is 2: it should be a valid list, as [2]"),
        (
            "name: x\nnetwork: {lost: 1}",
            "`network.lost` is unknown: use one of loss, delay, duplicate, reorder, corrupt, rate, limit, "
            "receivers, links",
        ),
        ("name: x\ntimeline: [{at_s: 1, heel: true}]", "`timeline.0.heel` is unknown"),
        ("agents: 3", "`name` is missing"),
        ("name: x\nnetwork: {loss: 1.5}", "`network.loss` is 1.5: it should be less than or equal to 1"),
        ("name: x\nnetwork: {loss: .nan}", "`network.loss` is nan"),
        ("name: x\nnetwork: {loss: much}", "`network.loss` is 'much': it should be a valid number"),
        ("name: x\nnetwork: {loss: {p: 2, r: 1}}", "`network.loss.p` is 2: it should be less than or equal to 1"),
        ("name: x\nnetwork: {loss: {p: 1}}", "`network.loss.r` is missing"),
        ("name: x\nnetwork: {loss: {p: 1, r: 1, h: 1}}", "`network.loss.h` is unknown: use one of p, r, loss_bad"),
        ("name: x\nnetwork: {delay: -1}", "`network.delay` is -1: it should be greater than or equal to 0"),
        ("name: x\nnetwork: {delay: 61}", "`network.delay` is 61: it should be less than or equal to 60"),
        (
            "name: x\nnetwork: {delay: {mean_s: 0.1, jitter_s: 0.2}}",
            "jitter_s: 0.2 is out of range; allowed is 0..mean_s",
        ),
        (
            "name: x\nnetwork: {delay: {mean_s: 1, distribution: gauss}}",
            "`network.delay.distribution` is 'gauss': it should be 'uniform', 'normal', 'pareto' or 'paretonormal'",
        ),
        ("name: x\nnetwork: {duplicate: 2}", "`network.duplicate` is 2: it should be less than or equal to 1"),
        ("name: x\nnetwork: {reorder: 0.1}", "reorder: 0.1 needs a delay to overtake"),
        ("name: x\nnetwork: {delay: 1, reorder: 0.1, receivers: {3: {delay: 0}}}", "receivers.3: reorder: 0.1 needs"),
        ("name: x\nnetwork: {corrupt: -1}", "`network.corrupt` is -1: it should be greater than or equal to 0"),
        ("name: x\nnetwork: {rate: 0}", "`network.rate` is 0: it should be greater than or equal to 8"),
        ("name: x\nnetwork: {rate: 1mbit}", "`network.rate` is '1mbit': it should be a valid number"),
        ("name: x\nnetwork: {rate: 1000, limit: 0}", "`network.limit` is 0: it should be greater than or equal to 1"),
        ("name: x\nnetwork: {rate: 1000, limit: 1.5}", "`network.limit` is 1.5: it should be a valid integer"),
        ("name: x\nnetwork: {limit: 10}", "limit: 10 needs a delay or a rate to wait for"),
        ("name: x\nnetwork: {rate: 9, limit: 9, receivers: {3: {rate: none}}}", "receivers.3: limit: 9 needs a delay"),
        (
            "name: x\nnetwork: {receivers: {3: {los: 0}}}",
            "`network.receivers.3.los` is unknown: use one of loss, delay",
        ),
        ("name: x\nnetwork: {links: [{from: 1}]}", "`network.links.0.to` is missing"),
        ("name: x\nnetwork: {links: [{from: 1, to: []}]}", "`network.links.0.to` is []: List should have at least 1"),
        (
            "name: x\nnetwork: {links: [{from: a, to: 1}]}",
            "`network.links.0.from.0` is 'a': it should be a valid integer",
        ),
        ("name: x\nnetwork: {links: [{from: 1, to: [2, 1]}]}", "links.0: a link from vehicle 1 to itself"),
        ("name: x\nnetwork: {links: [{from: 1, to: 2}, {from: 1, to: 2}]}", "links.1: from 1 to 2 is named twice"),
        ("name: x\nnetwork: {links: [{from: [1, 2], to: [2, 1]}]}", "links.0: a link from vehicle 1 to itself"),
        (
            "name: x\nnetwork: {links: [{from: 1, to: 2, both: true}, {from: 2, to: 1}]}",
            "links.1: from 2 to 1 is named twice: leave out one of them",
        ),
        (
            "name: x\nnetwork: {links: [{from: 1, to: 9}]}",
            "network.links.0.to names vehicle 9, which is not on the roster",
        ),
        (
            "name: x\nnetwork: {links: [{from: 9, to: 1}]}",
            "network.links.0.from names vehicle 9, which is not on the roster",
        ),
        (
            "name: x\nnetwork: {receivers: {9: {loss: 0.1}}}",
            "vehicle 9, which is not on the roster: use one of 1, 2, 3, 4, 5",
        ),
        ("name: x\ntimeline: [{at_s: 1, partition: [[1], [9]]}]", "unknown vehicle 9"),
        ("name: x\ntimeline: [{at_s: 1, partition: [[1], [1, 2]]}]", "vehicle 1 is in an earlier group too"),
        ("name: x\ntimeline: [{at_s: 1, heal: true}, {at_s: 1, loss: 0}]", "two entries"),
        ("name: x\ntimeline: [{at_s: 1, heal: true, loss: 0}]", "exactly one of"),
        ("name: x\ntimeline: [{at_s: 9999, heal: true}]", "after the mission's end at 1200 s"),
        ("name: x\nagents: 0", "number of agents 1..1000"),
        ("name: x\nagents: [1, 1]", "names 1 twice"),
        ("name: x\nagents: [1, 70000]", "70000 is not an agent ID"),
        ("name: x\nspeedup: 0", "`speedup` is 0: it should be greater than 0"),
        ("name: x\nsettings: {vote: 1}", "vote is unknown: use one of vote_timeout_s"),
        ("name: x\nsettings: {vote_timeout_s: -1}", "vote_timeout_s must be more than 0"),
        ("name: x\nquirks: {ignore_commit: 2}", "probability 0..1"),
        ("name: x\nquirks: {hide_commits: 1}", "hide_commits must be true or false, not 1"),
        ("name: x\nquirks: {hide_commit: true}", "unknown quirk 'hide_commit': of the"),
        ("name: x\nquirks: {5: true}", "unknown quirk '5'"),
        (
            "name: x\nquirks: {crash_on_tie: {agents: [9]}}",
            "quirks.crash_on_tie.agents names vehicle 9, which is not on the roster",
        ),
        ("name: x\nquirks: {crash_on_tie: {agents: []}}", "at least 1 item"),
        ("name: x\nquirks: {crash_on_tie: {agents: [1], value: 1}}", "crash_on_tie must be true or false, not 1"),
        ("name: x\nquirks: {ignore_commit: {agents: [1]}}", "ignore_commit must be a probability 0..1, not True"),
        (
            "name: x\nquirks: {crash_on_tie: {agents: [1], valu: false}}",
            "`quirks.crash_on_tie.valu` is unknown: use one of agents, value",
        ),
        (
            "name: x\nagent_command: ./mine",
            "`agent_command` is './mine': it must be a program and its arguments, as a",
        ),
        ("name: x\nagent_command: []", "or a mapping of agent IDs to such lists"),
        ("name: x\nagent_command: {2: ./mine}", "agent 2 needs a list of a program and its arguments"),
        ("name: x\nagent_command: {two: [./mine]}", "'two' is not an agent ID: use 1..65535"),
        (
            "name: x\nagent_command: {9: [./mine]}",
            "agent_command names vehicle 9, which is not on the roster: use one of 1, 2",
        ),
        ('name: x\nagent_command: ["./mine\\0"]', "a program and its arguments, as a list"),
        ("name: x\nvehicles: {kind: boat}", "it should be 'ardupilot', 'embedded' or 'none'"),
        ("name: x\nvehicles: {home: [100, 0, 0, 0]}", "latitude -90..90"),
        ("name: [x", "not YAML at line"),
        ("name: x\ntimeline: [{at: 3, kill: [2]}]", "`timeline.0.at` is unknown: use one of"),
        ('name: x\nlateness: {1: "0+1;2+3"}', 'it should be numbers and seconds, as in "3+0.25 8+1"'),
        (
            'name: x\nfates: [{block: "1-1", drop: true}]',
            'must be an agent and the number of its block, such as "4.11"',
        ),
        ("name: x\nduration_s: 0x" + "f" * 5000, "not YAML at line 2: a number of hundreds of digits"),
        ('name: x\n"foo\\nbar": 1', r"`'foo\nbar'` is unknown"),
        (
            "name: x\nnetwork: {loss: 0.1}\nagents: 3\nnetwork: {loss: 0.2}",
            "not YAML at line 4: network is repeated",
        ),
        ("name: x\nnetwork: {loss: 0.1, loss: 0.2}", "not YAML at line 2: loss is repeated"),
        ("- 1", "a YAML mapping"),
        ("!!python/object/apply:os.system ['true']", "not YAML"),
    ],
)
def test_error_names_the_key_its_value_and_the_allowed_values(tmp_path: Path, text: str, sentence: str) -> None:
    path = write(tmp_path, text)
    with pytest.raises(ScenarioError) as caught:
        load_scenario(path)
    message = str(caught.value)
    assert sentence in message
    assert message.startswith(str(path))
    assert "\n" not in message


def test_alias_bomb_is_refused_with_a_short_error(tmp_path: Path) -> None:
    lines = ["x0: &x0 [lol, lol]"] + [f"x{n}: &x{n} [{', '.join([f'*x{n - 1}'] * 9)}]" for n in range(1, 40)]
    bomb = write(tmp_path, "\n".join(lines) + "\nname: *x39")
    with pytest.raises(ScenarioError) as caught:
        load_scenario(bomb)
    assert len(str(caught.value)) < 1000


def test_missing_or_oversized_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match="no such file or scenario; `ucp-harness scenarios` lists"):
        load_scenario(tmp_path / "none.yaml")
    with pytest.raises(ScenarioError, match=r"; did you mean `loss_15`\?"):
        load_scenario(tmp_path / "los_15.yaml")
    with pytest.raises(ScenarioError, match="larger than"):
        load_scenario(write(tmp_path, "#" * 9_000_000))


def test_timeline_lists_the_network_states_in_time_order() -> None:
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
    changes = timeline_of(scenario)
    assert [(change.at_s, change.what, change.detail) for change in changes] == [
        (0, "start", "loss 10 %, loss 50 % to 2"),
        (300, "partition", "loss 10 %, loss 50 % to 2, partition 1 2"),
        (600, "heal", "loss 10 %, loss 50 % to 2"),
        (700, "loss", "loss 0 %, loss 50 % to 2"),
    ]
    assert changes[1].conditions.is_cut(1, 3)
    assert not changes[1].conditions.is_cut(3, 4)  # the vehicles that no group names stay together


def conditions_of(tmp_path: Path, network: str) -> NetworkConditions:
    return load_scenario(write(tmp_path, f"name: x\nnetwork: {network}")).network.conditions()


def test_single_number_replaces_a_mapping(tmp_path: Path) -> None:
    short = conditions_of(tmp_path, "{loss: 0.1, delay: 0.05, duplicate: 0.01, reorder: 0.02}")
    assert short == NetworkConditions(LinkConditions(0.1, Delay(0.05), 0.01, 0.02))
    long = conditions_of(
        tmp_path, "{loss: {p: 0.02, r: 0.3}, delay: {mean_s: 0.05, jitter_s: 0.02, distribution: normal}}"
    )
    assert long == NetworkConditions(LinkConditions(GilbertElliott(0.02, 0.3), Delay(0.05, 0.02, "normal")))


def test_loss_in_the_timeline_spares_receivers_with_their_own_loss() -> None:
    network = {"loss": 0.1, "receivers": {2: {"delay": 1}, 3: {"loss": 0.5}}}
    timeline = [{"at_s": 1, "loss": {"p": 0.02, "r": 0.3}}]
    scenario = Scenario.model_validate({"name": "x", "network": network, "timeline": timeline})
    change = timeline_of(scenario)[1]
    assert isinstance(change, NetworkChange)
    assert change.detail == "loss in bursts (2 % in, 30 % out), delay 1 s to 2, loss 50 % to 3"
    assert change.conditions.link(1, 2) == LinkConditions(GilbertElliott(0.02, 0.3), Delay(1))
    assert change.conditions.link(1, 3) == LinkConditions(0.5)


def test_missing_key_of_a_receiver_or_link_comes_from_the_layer_below(tmp_path: Path) -> None:
    conditions = conditions_of(
        tmp_path,
        "{loss: 0.1, delay: 0.05, receivers: {3: {loss: 0.5}, 4: {delay: 0}},"
        " links: [{from: 1, to: [2, 3], duplicate: 0.2}, {from: [4], to: 5, loss: 0, both: true}]}",
    )
    late = Delay(0.05)
    assert conditions.link(1, 5) == LinkConditions(0.1, late)
    assert conditions.link(2, 3) == LinkConditions(0.5, late)
    assert conditions.link(2, 4) == LinkConditions(0.1)
    assert conditions.link(1, 2) == LinkConditions(0.1, late, 0.2)
    assert conditions.link(2, 1) == LinkConditions(0.1, late)
    assert conditions.link(1, 3) == LinkConditions(0.5, late, 0.2)
    assert conditions.link(4, 5) == LinkConditions(0, late)
    assert conditions.link(5, 4) == LinkConditions(0)


def test_receiver_may_remove_the_rate_of_the_network(tmp_path: Path) -> None:
    network = "{corrupt: 0.1, rate: 1e5, limit: 50, receivers: {2: {rate: none, limit: none}, 3: {rate: 9600}}}"
    conditions = conditions_of(tmp_path, network)
    assert conditions.default == LinkConditions(corrupt=0.1, rate=100_000, limit=50)
    assert conditions.link(1, 2) == LinkConditions(corrupt=0.1)
    assert conditions.link(1, 3) == LinkConditions(corrupt=0.1, rate=9600, limit=50)
    assert describe(conditions) == (
        "loss 0 %, corrupt 10 %, rate 100 kbit/s, limit 50 packets, no rate to 2, no limit to 2, rate 9.6 kbit/s to 3"
    )


def test_resolved_scenario_survives_writing_and_reading(tmp_path: Path) -> None:
    text = (
        "{loss: {p: 0.1, r: 0.2}, rate: 9600, receivers: {3: {delay: 1, rate: none}},"
        " links: [{from: 1, to: 3, loss: 0.9, both: true}]}"
    )
    scenario = load_scenario(write(tmp_path, f"name: x\nnetwork: {text}"))
    for document in (scenario.model_dump(), scenario.model_dump(mode="json", by_alias=True)):
        again = Scenario.model_validate(document)
        assert again == scenario
        assert again.network.conditions() == scenario.network.conditions()


def test_conditions_have_a_description_in_words() -> None:
    late = Delay(0.05, 0.02, "normal")
    bursts = GilbertElliott(0.02, 0.3)
    assert describe(NetworkConditions()) == "loss 0 %"
    assert (
        describe(
            NetworkConditions(
                LinkConditions(0.15, late), links={(1, 2): LinkConditions(0.9, late)}, partition=({1, 2}, {3})
            )
        )
        == "loss 15 %, delay 50 ms ± 20 ms normal, loss 90 % from 1 to 2, partition 1 2 | 3"
    )
    assert (
        describe(
            NetworkConditions(
                LinkConditions(bursts, Delay(2, 0.5), 0.01, 0.02),
                {3: LinkConditions(GilbertElliott(0.02, 0.3, 0.8, 0.01)), 4: LinkConditions(bursts, Delay(2, 0.5))},
            )
        )
        == "loss in bursts (2 % in, 30 % out), delay 2 s ± 500 ms, duplicate 1 %, reorder 2 %, "
        "loss in bursts (2 % in, 30 % out, 80 % inside, 1 % outside) to 3, no delay to 3, duplicate 0 % to 3, "
        "reorder 0 % to 3, duplicate 0 % to 4, reorder 0 % to 4"
    )


def test_description_of_many_links_is_short() -> None:
    pairs = [(sender, receiver) for sender in range(1, 31) for receiver in range(1, 31) if sender != receiver]
    mesh = NetworkConditions(links={pair: LinkConditions(0.9) for pair in pairs if pair[0] <= 3 and pair[1] <= 3})
    assert describe(mesh) == "loss 0 %, loss 90 % from 1 to 2 3, loss 90 % from 2 to 1 3, loss 90 % from 3 to 1 2"
    large = NetworkConditions(links={pair: LinkConditions(0.9) for pair in pairs})
    assert describe(large).endswith(", 22 more differences of links")


def test_change_at_mission_second_0_is_the_first_network_state() -> None:
    scenario = Scenario.model_validate({"name": "x", "timeline": [{"at_s": 0, "partition": [[1], [2]]}]})
    (change,) = timeline_of(scenario)
    assert change.what == "partition"


@pytest.mark.parametrize(("frame", "advice"), [("hexacopter", "hexa"), ("xfoo", "X")])
def test_unknown_frame_is_refused_with_the_nearest_one(frame: str, advice: str) -> None:
    with pytest.raises(ScenarioError, match=f"a copter has no frame '{frame}': did you mean {advice}[?]"):
        parse(parse_yaml(f"name: x\nvehicles: {{each: {{2: {{frame: {frame}}}}}}}\n"))
