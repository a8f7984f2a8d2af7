"""Test network changes in a timeline. They change any key, for all links, receivers or single links, for some time or
permanently.
"""

import json
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from harness.errors import ScenarioError
from harness.play.process.process_preflight import network_needs
from harness.run.simulate import simulate
from harness.scenario import Scenario, load_scenario
from harness.scenario.changes import NetworkChange, timeline_of
from harness.sweep.explore._scenario_document import cut_after, document_of, keep_agents, move_times, with_script
from netem.conditions import Delay, LinkConditions
from tests.harness.command import harness, write_scenario
from tests.harness.virtual import scenario

ONE_WAY = {"links": [{"from": 1, "to": 2, "loss": 0.9}]}


def network_states(*timeline: dict[str, Any], **keys: Any) -> list[tuple[float, str, str]]:
    """Return the mission second, the name and the description of each state of the network."""
    changes = timeline_of(scenario(timeline=list(timeline), **keys))
    return [(change.at_s, change.what, change.detail) for change in changes if isinstance(change, NetworkChange)]


def test_timeline_entry_changes_any_key_of_the_network() -> None:
    standing = {"loss": 0.1, "rate": 9600, "receivers": {2: {"loss": 0.5}}, "links": [{"from": 3, "to": 2, "limit": 5}]}
    layer = {
        "delay": {"mean_s": 0.5, "jitter_s": 0.1},
        "receivers": {2: {"corrupt": 0.2}, 4: {"rate": "none"}},
        "links": [{"from": 3, "to": 2, "duplicate": 0.3}, {"from": 1, "to": [4, 5], "loss": 1}],
    }
    *_, change = timeline_of(scenario(network=standing, timeline=[{"at_s": 9, "network": layer}]))
    assert isinstance(change, NetworkChange)
    late = Delay(0.5, 0.1)
    assert change.conditions.link(1, 3) == LinkConditions(0.1, late, rate=9600)
    assert change.conditions.link(1, 2) == LinkConditions(0.5, late, corrupt=0.2, rate=9600)
    assert change.conditions.link(3, 2) == LinkConditions(0.5, late, 0.3, corrupt=0.2, rate=9600, limit=5)
    assert change.conditions.link(2, 4) == LinkConditions(0.1, late)
    assert change.conditions.link(1, 4) == LinkConditions(1.0, late)


def test_temporary_change_ends_and_lasting_changes_stay() -> None:
    seen = network_states(
        {"at_s": 300, "network": ONE_WAY, "for_s": 60},
        {"at_s": 330, "loss": 0.2},
        {"at_s": 340, "partition": [[1, 2]], "for_s": 100},
    )
    assert seen == [
        (0, "start", "loss 0 %"),
        (300, "network", "loss 0 %, loss 90 % from 1 to 2"),
        (330, "loss", "loss 20 %, loss 90 % from 1 to 2"),
        (340, "partition", "loss 20 %, loss 90 % from 1 to 2, partition 1 2"),
        (360, "undone", "loss 20 %, partition 1 2"),
        (440, "undone", "loss 20 %"),
    ]


def test_outer_change_applies_again_after_an_inner_change() -> None:
    seen = network_states(
        {"at_s": 100, "loss": 0.5, "for_s": 100},
        {"at_s": 120, "network": {"loss": 1}, "for_s": 10},
        {"at_s": 150, "partition": [[1]], "for_s": 100},
        {"at_s": 160, "partition": [[2]], "for_s": 90},
        {"at_s": 200, "loss": 0.1},
    )
    assert [(at_s, detail) for at_s, _, detail in seen[1:]] == [
        (100, "loss 50 %"),
        (120, "loss 100 %"),
        (130, "loss 50 %"),
        (150, "loss 50 %, partition 1"),
        (160, "loss 50 %, partition 2"),
        (200, "loss 10 %, partition 2"),
        (250, "loss 10 %"),
    ]
    assert seen[-2][1] == "loss, undone"


@pytest.mark.parametrize(
    ("timeline", "sentence"),
    [
        (
            [{"at_s": 10, "loss": 0.5, "for_s": 20}, {"at_s": 20, "loss": 0.1, "for_s": 20}],
            r"timeline.1 changes loss until 40 s, but timeline.0 changes it until 30 s: "
            r"let timeline.1 begin at that time, or end before it",
        ),
        (
            [{"at_s": 20, "loss": 0.1}, {"at_s": 10, "network": {"loss": 0.5}, "for_s": 20}],
            r"timeline.0 changes loss for good, but timeline.1 changes it until 30 s",
        ),
        (
            [
                {"at_s": 10, "network": {"links": [{"from": [1, 3], "to": 2, "loss": 0.5}]}, "for_s": 20},
                {"at_s": 20, "network": ONE_WAY, "for_s": 20},
            ],
            r"timeline.1 changes loss from 1 to 2 until 40 s",
        ),
        (
            [{"at_s": 10, "partition": [[1]], "for_s": 20}, {"at_s": 20, "heal": True}],
            r"timeline.1 changes the partition for good, but timeline.0 changes it until 30 s",
        ),
        ([{"at_s": 10, "heal": True, "for_s": 20}], "`for_s` belongs to `loss`, `partition` and `network`"),
        ([{"at_s": 10, "kill": [1], "for_s": 20}], "`for_s` belongs to `loss`, `partition` and `network`"),
        ([{"at_s": 10, "loss": 0.1, "for_s": 0}], "greater than 0"),
        (
            [{"at_s": 1190, "network": {"loss": 0.1}, "for_s": 20}],
            "timeline.0.network would last until 1210 s, after the mission's end at 1200 s",
        ),
        ([{"at_s": 10, "network": {}}], "needs at least one of `loss`, `delay`, .*`links`"),
        ([{"at_s": 10, "network": {"loss": 0.1}, "loss": 0.1}], "are the same setting: leave out one of them"),
        ([{"at_s": 10, "network": {"delay": 0.1}, "loss": 0.1}], "needs exactly one of `loss`, `partition`"),
        (
            [{"at_s": 10, "network": {"links": [{"from": 1, "to": 9}]}}],
            r"timeline.0.network.links.0.to names vehicle 9, which is not on the roster",
        ),
        (
            [{"at_s": 10, "network": {"links": [{"from": 1, "to": 2}, {"from": 1, "to": 2}]}}],
            r"links.1: from 1 to 2 is named twice",
        ),
        ([{"at_s": 10, "network": {"reorder": 0.1}}], "timeline.0.network, at 10 s: reorder: 0.1 needs a delay"),
        (
            [{"at_s": 10, "network": {"delay": 1}, "for_s": 20}, {"at_s": 20, "network": {"reorder": 0.1}}],
            "the end of timeline.0, at 30 s: reorder: 0.1 needs a delay",
        ),
    ],
)
def test_invalid_or_ambiguous_timeline_is_refused(timeline: list[dict[str, Any]], sentence: str) -> None:
    with pytest.raises(ValidationError, match=sentence):
        scenario(timeline=timeline)


@pytest.mark.parametrize(
    ("entry", "sentence"),
    [
        ("{at_s: 1, network: {lost: 1}}", "`timeline.0.network.lost` is unknown: use one of loss, delay, duplicate"),
        ("{at_s: 1, network: {radio: {log_distance: {}}}}", "`timeline.0.network.radio` is unknown: use one of loss"),
        ("{at_s: 1, network: {delay: -1}}", "`timeline.0.network.delay` is -1: it should be greater than or equal"),
        (
            "{at_s: 1, delay: 0.5}",
            "`timeline.0.delay` is 0.5: it is an action of a rogue node; `network: {delay: 0.5}`",
        ),
    ],
)
def test_error_names_the_key_and_the_allowed_values(tmp_path: Path, entry: str, sentence: str) -> None:
    path = tmp_path / "scenario.yaml"
    path.write_text(f"name: x\ntimeline: [{entry}]")
    with pytest.raises(ScenarioError) as caught:
        load_scenario(path)
    assert sentence in str(caught.value)


def test_network_needs_include_conditions_of_later_changes() -> None:
    late = {"links": [{"from": 1, "to": 2, "delay": 0.5}]}
    assert network_needs(scenario(timeline=[{"at_s": 9, "network": late, "for_s": 1}])) == ["links 1>2 delay"]
    assert network_needs(scenario(schedule=[{"repeat": {"network": late}, "every_s": 9, "for_s": 1}]))
    assert not network_needs(scenario(timeline=[{"at_s": 9, "network": ONE_WAY, "for_s": 1}]))


def test_schedule_may_change_the_same_keys_as_the_timeline() -> None:
    repeat = {"repeat": {"network": ONE_WAY}, "every_s": 100, "for_s": 30, "from_s": 50}
    ends = [{"links": [{"from": 1, "to": 2, "loss": loss}]} for loss in (0, 0.4)]
    ramp = {"ramp": {"network": ends, "delay": [0, 1]}, "from_s": 210, "until_s": 230}
    seen = network_states(network={"loss": 0.1}, schedule=[repeat, ramp], duration_s=240)
    assert seen == [
        (0, "start", "loss 10 %"),
        (50, "repeat", "loss 10 %, loss 90 % from 1 to 2"),
        (80, "undone", "loss 10 %"),
        (150, "repeat", "loss 10 %, loss 90 % from 1 to 2"),
        (180, "undone", "loss 10 %"),
        (210, "ramp", "loss 10 %, loss 0 % from 1 to 2"),
        (220, "ramp", "loss 10 %, delay 500 ms, loss 20 % from 1 to 2"),
        (230, "ramp", "loss 10 %, delay 1 s, loss 40 % from 1 to 2"),
    ]


@pytest.mark.parametrize(
    ("schedule", "sentence"),
    [
        ({"ramp": {"network": [{"loss": 0}, {"delay": 1}]}}, "is in one `network` of the ramp only: give it in both"),
        ({"ramp": {"network": [{"rate": "none"}, {"rate": 9}]}}, "rate is 'none': a ramp needs two numbers"),
        ({"ramp": {"network": [{"loss": 0}, {"loss": 1}], "loss": [0, 1]}}, "are the same setting"),
        ({"ramp": {"network": [ONE_WAY, {"links": [{"from": 1, "to": 9, "loss": 1}]}]}}, "loss from 1 to . is in one"),
        (
            {"repeat": {"network": {"receivers": {9: {"loss": 1}}}}, "every_s": 9, "for_s": 1},
            "schedule.0.repeat.network.receivers names vehicle 9, which is not on the roster",
        ),
        ({"repeat": {"network": {"limit": 9}}, "every_s": 9, "for_s": 1}, "schedule.0, at 0 s: limit: 9 needs a delay"),
    ],
)
def test_schedule_with_an_invalid_network_is_refused(schedule: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValidationError, match=sentence):
        scenario(schedule=[schedule])


def test_link_with_full_loss_is_silent_in_virtual_time() -> None:
    dead = {"links": [{"from": 1, "to": 2, "loss": 1}]}
    one = scenario(
        agents=3,
        duration_s=300,
        events={"source": "random", "mean_s": 5},
        timeline=[{"at_s": 100, "network": dead, "for_s": 100}],
        final_reconcile=True,
    )
    simulated = simulate(one, 1, tracing=True)
    datagram = [run.t for run in simulated.evidence.traces[2].runs if run.trigger.to_json().get("from") == 1]
    assert not [at_s for at_s in datagram if 100.1 < at_s < 200]
    assert [at_s for at_s in datagram if at_s < 100]
    assert [at_s for at_s in datagram if 200 < at_s < 300]
    assert {one.verdict for one in simulated.result.characteristics.values()} == {"holds"}


def test_resolved_scenario_survives_writing_and_reading() -> None:
    one = scenario(
        timeline=[{"at_s": 9, "network": {**ONE_WAY, "receivers": {3: {"rate": "none"}}}, "for_s": 5}],
        schedule=[{"ramp": {"network": [{"loss": 0}, {"loss": 1}]}}],
    )
    for document in (one.model_dump(), one.model_dump(mode="json", by_alias=True)):
        assert Scenario.model_validate(document) == one


def test_explore_shrinks_changes_of_the_network() -> None:
    links = {"loss": 0.5, "links": [{"from": [1, 4], "to": 2, "loss": 0.9}], "receivers": {4: {"loss": 1}}}
    only_4 = {"receivers": {4: {"loss": 1}}}
    document = document_of(
        scenario(
            timeline=[
                {"at_s": 10, "network": links, "for_s": 20},
                {"at_s": 50, "network": only_4},
            ],
            schedule=[
                {"repeat": {"network": only_4}, "every_s": 50, "for_s": 1},
                {"ramp": {"network": [{"loss": 0}, {"loss": 1}]}, "from_s": 60},
            ],
        )
    )
    fewer = keep_agents(document, [1, 2])
    assert fewer["timeline"] == [
        {"at_s": 10, "for_s": 20, "network": {"loss": 0.5, "links": [{"from": [1], "to": [2], "loss": 0.9}]}}
    ]
    assert [*fewer["schedule"][0]] == ["ramp", "from_s"]
    assert "for_s" not in cut_after(document, 25)["timeline"][0]
    later = move_times(document, lambda at_s: at_s if at_s < 20 else at_s + 5)
    assert (later["timeline"][0]["at_s"], later["timeline"][0]["for_s"]) == (10, 25)
    silent = Scenario.model_validate(with_script(document, [], []))
    changes = [change for change in timeline_of(silent) if isinstance(change, NetworkChange)]
    assert all(change.conditions.fully_connected for change in changes)


@pytest.mark.lab
@pytest.mark.any_user
def test_link_with_full_loss_is_silent_between_processes(tmp_path: Path) -> None:
    path = write_scenario(
        tmp_path,
        agents=3,
        duration_s=120,
        speedup=20,
        vehicles={"kind": "none"},
        events={"source": "random", "mean_s": 5},
        timeline=[{"at_s": 40, "network": {"links": [{"from": 1, "to": 2, "loss": 1}]}, "for_s": 40}],
        final_reconcile=True,
    )
    done = harness("run", path, "--seed", 1, "--out", tmp_path / "run")
    assert done.returncode == 0, done.stdout + done.stderr
    lines = [json.loads(line) for line in (tmp_path / "run" / "network.jsonl").read_text().splitlines()]
    assert [(line["what"], line.get("detail")) for line in lines[:3]] == [
        ("start", "loss 0 %"),
        ("network", "loss 0 %, loss 100 % from 1 to 2"),
        ("undone", "loss 0 %"),
    ]
    assert lines[1]["asked"]["links"]["1>2"]["loss"] == 1
    applied_s, undone_s = (line["at_s"] for line in lines[1:3])
    assert applied_s >= 40
    assert undone_s >= 80
    traces = tmp_path / "run" / "agents"
    sender, receiver = (
        [json.loads(line) for line in (traces / f"{agent}.trace.jsonl").read_text().splitlines()[1:]]
        for agent in (1, 2)
    )
    sent_s = {message["seq"]: run["t"] for run in sender for message in run.get("sent", ())}
    triggers = [(run["t"], run["trigger"]) for run in receiver if run.get("trigger", {}).get("from") == 1]
    datagram = [(at_s, sent_s[trigger["seq"]]) for at_s, trigger in triggers]
    assert not [at_s for at_s, since_s in datagram if since_s > applied_s and at_s < 80], (
        "a message arrived although all messages were lost"
    )
    assert [at_s for at_s, _ in datagram if at_s < 40]
    assert [at_s for at_s, _ in datagram if at_s > undone_s]
