"""Test schedules of network changes: ramps, repeated changes and random changes. They are computed before the run."""

from typing import Any

import pytest
from pydantic import ValidationError

from harness.run.simulate import simulate
from harness.scenario import Scenario
from harness.scenario.changes import NetworkChange, timeline_of
from tests.harness.virtual import scenario

NEMESES = ("halves", "isolate", "majorities ring", "bridge", "flapping")


def states(one: Scenario) -> list[NetworkChange]:
    return [change for change in timeline_of(one) if isinstance(change, NetworkChange)]


def heard(state: NetworkChange, roster: tuple[int, ...]) -> dict[int, set[int]]:
    """Return, for each vehicle, the vehicles that it can receive. Each vehicle can receive itself."""
    conditions = state.conditions
    return {
        receiver: {
            sender
            for sender in roster
            if sender == receiver
            or not (conditions.is_cut(sender, receiver) or conditions.link(sender, receiver).loss == 1.0)
        }
        for receiver in roster
    }


def scheduled(*schedule: dict[str, Any], **keys: Any) -> Scenario:
    return scenario(schedule=list(schedule), **{"duration_s": 300, **keys})


def test_ramp_changes_in_equal_steps_and_keeps_its_last_value() -> None:
    one = scheduled({"ramp": {"loss": [0, 0.4], "delay": [0, 2]}, "from_s": 100, "until_s": 140})
    seen = [(state.at_s, state.conditions.default.loss) for state in states(one)]
    assert seen == [(0, 0), *((100 + 10 * step, pytest.approx(0.1 * step)) for step in range(5))]
    last = states(one)[-1].conditions.default.delay
    assert last is not None
    assert last.mean_s == 2


def test_repeated_change_is_undone_each_time() -> None:
    one = scheduled({"repeat": {"partition": [[1, 2]], "loss": 0.5}, "every_s": 100, "for_s": 30, "from_s": 50})
    assert [(state.at_s, state.what, state.detail) for state in states(one)] == [
        (0, "start", "loss 0 %"),
        (50, "repeat", "loss 50 %, partition 1 2"),
        (80, "undone", "loss 0 %"),
        (150, "repeat", "loss 50 %, partition 1 2"),
        (180, "undone", "loss 0 %"),
        (250, "repeat", "loss 50 %, partition 1 2"),
        (280, "undone", "loss 0 %"),
    ]


@pytest.mark.parametrize("nemesis", NEMESES)
@pytest.mark.parametrize("agents", [4, 5, 6, 7, 10])
def test_nemesis_cuts_the_links_that_its_name_promises(nemesis: str, agents: int) -> None:
    one = scheduled({"nemesis": nemesis, "every_s": 20, "for_s": 10}, agents=agents)
    roster = set(one.roster)
    changes = [heard(state, one.roster) for state in states(one) if state.what == nemesis]
    assert len(changes) == 15
    assert len({str(senders) for senders in changes}) >= 3  # each change draws other vehicles
    for senders in changes:
        assert all((a in senders[b]) == (b in senders[a]) for a in roster for b in roster)
        groups = {frozenset(heard_by_one) for heard_by_one in senders.values()}
        match nemesis:
            case "halves":
                assert sorted(map(len, groups)) == [agents // 2, agents - agents // 2]
            case "isolate":
                assert sorted(map(len, groups)) == [1, agents - 1]
            case "majorities ring":
                assert all(len(heard_by_one) > agents / 2 for heard_by_one in senders.values())
                assert len(groups) == agents
            case "bridge":
                assert sum(heard_by_one == roster for heard_by_one in senders.values()) == 1
            case "flapping":
                assert sum(len(roster - heard_by_one) for heard_by_one in senders.values()) == 2
    assert all(state.conditions.fully_connected for state in states(one) if state.what == "undone")


def test_nemesis_depends_on_its_seed_alone() -> None:
    def details(seed: int) -> list[str]:
        return [
            state.detail for state in states(scheduled({"nemesis": "halves", "every_s": 20, "for_s": 5, "seed": seed}))
        ]

    assert details(1) == details(1) != details(2)


def test_schedules_compose_with_each_other_and_with_the_timeline() -> None:
    one = scheduled(
        {"repeat": {"partition": [[1, 2, 3]]}, "every_s": 200, "for_s": 100},
        {"repeat": {"partition": [[1], [2, 3, 4, 5]]}, "every_s": 200, "for_s": 100, "from_s": 50},
        {"ramp": {"loss": [0.5, 0.5]}, "from_s": 60, "until_s": 70},
        network={"loss": 0.1},
        timeline=[{"at_s": 50, "loss": 0.2}, {"at_s": 55, "kill": [5]}],
    )
    seen = {state.at_s: (state.what, state.detail) for state in states(one)}
    assert seen[0] == ("repeat", "loss 10 %, partition 1 2 3")
    assert seen[50] == ("loss, repeat", "loss 20 %, partition 1 | 2 3 | 4 5")
    assert seen[60] == ("ramp", "loss 50 %, partition 1 | 2 3 | 4 5")
    assert seen[100] == ("undone", "loss 50 %, partition 1 | 2 3 4 5")
    assert seen[150] == ("undone", "loss 50 %")
    assert [change.at_s for change in timeline_of(one)] == sorted(change.at_s for change in timeline_of(one))


@pytest.mark.parametrize("nemesis", NEMESES)
def test_agents_reach_one_chain_after_every_nemesis(nemesis: str) -> None:
    one = scheduled({"nemesis": nemesis, "every_s": 60, "for_s": 40}, duration_s=600, final_reconcile=True)
    simulated = simulate(one, 1, tracing=True)
    assert {one.verdict for one in simulated.result.characteristics.values()} == {"holds"}


@pytest.mark.parametrize(
    ("schedule", "sentence"),
    [
        ({"every_s": 1, "for_s": 0.5}, "needs exactly one of `ramp`, `repeat` or `nemesis`"),
        ({"nemesis": "halves"}, "needs `every_s` and `for_s`"),
        ({"nemesis": "halves", "every_s": 5, "for_s": 5}, "for_s 5 is not less than every_s 5"),
        ({"nemesis": "earthquake", "every_s": 5, "for_s": 1}, "'halves', 'isolate'"),
        ({"ramp": {}}, "needs `loss`, `delay` or `network`"),
        ({"ramp": {"loss": [0, 2]}}, "less than or equal to 1"),
        ({"ramp": {"loss": [0, 1]}, "from_s": 5, "until_s": 5}, "until_s 5 is not after from_s 5"),
        ({"ramp": {"loss": [0, 1]}, "until_s": 500}, "schedule.0.until_s 500 is after the mission's end at 300 s"),
        ({"ramp": {"loss": [0, 1]}, "every_s": 0.001}, "more than 10000 steps"),
        (
            {"repeat": {"partition": [[1], [1]]}, "every_s": 5, "for_s": 1},
            "schedule.0: .*vehicle 1 is in an earlier group",
        ),
        ({"repeat": {"partition": [[9]]}, "every_s": 5, "for_s": 1}, "unknown vehicle 9"),
        ({"nemesis": "majorities ring", "every_s": 5, "for_s": 1}, "'majorities ring' needs 4 vehicles"),
    ],
)
def test_invalid_schedule_is_refused(schedule: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValidationError, match=sentence):
        scheduled(schedule, agents=3)
