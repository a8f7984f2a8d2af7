"""Test that the network depends on the positions of vehicles: radio losses are added to the conditions in the
timeline.
"""

from pathlib import Path

import pytest

from harness.errors import ScenarioError
from harness.play._radio_range import RadioRange, tracks_of
from harness.play.mission import RunOutcome
from harness.run.simulate import simulate
from harness.scenario import Scenario, load_scenario
from harness.scenario.changes import RANGE, NetworkChange, final_reconcile
from netem.conditions import LinkConditions, NetworkConditions
from netem.radio import Place

SCENARIOS = Path(__file__).parents[3] / "scenarios"


def scenario(**keys: object) -> Scenario:
    document = {"name": "Range", "agents": 3, "network": {"radio": {"hard_range": {"range_m": 100}}}, **keys}
    return Scenario.model_validate(document)


def at(*north_m: float) -> dict[int, Place]:
    return {vehicle: Place(metres, 0.0, 0.0) for vehicle, metres in enumerate(north_m, 1)}


def change_to(conditions: NetworkConditions) -> NetworkChange:
    return NetworkChange(5.0, "loss", "", conditions)


def test_vehicle_out_of_range_is_cut_off_and_reconnected() -> None:
    reach = RadioRange(scenario())
    assert reach.move(1.0, at(0, 50, 90)) is None, "all vehicles are still in range"
    apart = reach.move(2.0, at(0, 50, 200))
    assert apart is not None and (apart.at_s, apart.what, apart.detail) == (2.0, RANGE, "1 2 | 3")
    assert apart.losses == {"1-3": 1.0, "2-3": 1.0}
    assert apart.conditions.link(3, 1) == LinkConditions(1.0) and apart.conditions.link(1, 2) == LinkConditions()
    assert reach.move(3.0, at(0, 50, 300)) is None, "a lost link stays lost at a larger distance"
    relayed = reach.move(4.0, at(0, 50, 140))
    assert relayed is not None and relayed.detail == "1 2 3" and relayed.losses == {"2-3": 0.0}
    together = reach.move(5.0, at(0, 50, 90))
    assert together is not None and together.conditions == NetworkConditions() and together.losses == {"1-3": 0.0}


def test_timeline_and_radio_range_apply_together() -> None:
    reach = RadioRange(scenario())
    reach.move(1.0, at(0, 50, 200))
    asked = reach.change_timeline(change_to(NetworkConditions(LinkConditions(0.2), partition=(frozenset({1}),))))
    assert asked.conditions.link(1, 2) == LinkConditions(0.2) and asked.conditions.link(1, 3).loss == 1.0
    assert asked.conditions.is_cut(1, 2) and asked.detail == ""
    moved = reach.move(2.0, at(0, 50, 90))
    assert moved is not None and moved.detail == "2 3 | 1", "the partition still stands"


def test_final_reconcile_ignores_distances() -> None:
    reach = RadioRange(scenario())
    reach.move(1.0, at(0, 50, 200))
    cleared = reach.change_timeline(final_reconcile(9.0))
    assert cleared.conditions == NetworkConditions() and cleared.losses == {"1-3": 0.0, "2-3": 0.0}
    assert reach.move(10.0, at(0, 500, 2000)) is None


def test_distance_has_no_effect_without_a_radio() -> None:
    assert RadioRange(scenario(network={})).move(1.0, at(0, 1e6, 2e6)) is None


def test_record_has_changes_of_connected_groups_only() -> None:
    played = RunOutcome()
    change = {"at_s": 1.0, "what": RANGE, "detail": "1 2 | 3", "fully_connected": False}
    for record in (
        change,
        {**change, "at_s": 2.0},
        {**change, "at_s": 3.0, "detail": "1 2 3"},
        {**change, "at_s": 4.0, "detail": "1 2 3", "fully_connected": True},
    ):
        played.record(record)
    assert [state.at_s for state in played.network] == [1.0, 3.0, 4.0]


def test_virtual_time_has_tracks_only_if_positions_are_needed() -> None:
    assert tracks_of(scenario(network={})) == {}
    standing = tracks_of(scenario(vehicles={"type": "rover", "spacing_m": 30}))
    assert standing[2].in_field(600.0) == pytest.approx(standing[2].in_field(0.0))
    plan = [{"take_off": 20}, {"go_to": [400, 0]}]
    flown = tracks_of(scenario(flight=[{"vehicles": [2], "plan": plan}]))
    north_m, _, up_m = flown[2].at(600.0)
    assert (north_m, up_m) == pytest.approx((400.0, 20.0), abs=1.0)


def test_subswarms_split_the_network_and_reconcile_after_the_rejoin() -> None:
    split_rejoin = load_scenario(SCENARIOS / "split_rejoin.yaml")
    simulated = simulate(split_rejoin, 1)
    connected = [(state.at_s, state.detail) for state in simulated.played.network if state.what == RANGE]
    assert [detail for _, detail in connected] == ["1 2 3 4 5", "3 4 5 | 1 2", "1 2 3 4 5"]
    (_, _), (apart_s, _), (again_s, _) = connected
    assert apart_s < 300 and again_s > apart_s + 300
    assert not simulated.result.bad
    assert simulated.result.figures["distinct_chains"] == 1
    assert simulated.result.figures["reconciles"] > 0


@pytest.mark.parametrize(
    ("radio", "word"),
    [
        ({}, "network.radio. is .*needs one of `hard_range` and `log_distance`"),
        ({"hard_range": {}, "log_distance": {}}, "needs one of"),
        ({"hard_range": {"range_m": 0}}, r"radio\.range_m: 0\.0 is not above 0"),
        ({"log_distance": {"exponent": "steep"}}, r"network\.radio\.log_distance\.exponent"),
        ({"log_distance": {"range_m": 5}}, r"network\.radio\.log_distance\.range_m. is unknown: use one of exponent"),
        ({"hard_range": {}, "update_s": 0}, r"network\.radio\.update_s"),
    ],
)
def test_invalid_radio_causes_one_sentence(radio: dict[str, object], word: str, tmp_path: Path) -> None:
    path = tmp_path / "scenario.yaml"
    path.write_text(f"name: Range\nnetwork: {{radio: {radio}}}\n")
    with pytest.raises(ScenarioError, match=word):
        load_scenario(path)


def test_radio_needs_vehicles() -> None:
    with pytest.raises(ValueError, match=r"`network.radio` needs vehicles, but `vehicles.kind` is none"):
        scenario(vehicles={"kind": "none"})


def test_cut_off_vehicle_stays_away_whatever_the_timeline_does() -> None:
    reach = RadioRange(scenario(network={"loss": 0.2}))
    reach.change_timeline(change_to(NetworkConditions(LinkConditions(0.2))))
    away = reach.cut_off(1.0, frozenset({3}))
    assert (away.what, away.detail, away.losses) == (RANGE, "1 2 | 3", {"1-3": 1.0, "2-3": 1.0})
    assert away.conditions.link(3, 1).loss == 1.0 and away.conditions.link(1, 2).loss == 0.2
    cleared = reach.change_timeline(final_reconcile(9.0))
    assert cleared.conditions.link(3, 1).loss == 1.0 and cleared.conditions.link(1, 2).loss == 0.0
    back = reach.cut_off(10.0, frozenset())
    assert back.conditions == NetworkConditions() and back.losses == {"1-3": 0.0, "2-3": 0.0}


def test_cut_off_vehicle_returns_to_the_losses_of_the_radio() -> None:
    reach = RadioRange(scenario())
    reach.move(1.0, at(0, 50, 200))
    reach.cut_off(2.0, frozenset({2}))
    assert reach.move(3.0, at(0, 50, 200)) is None, "the radio has not changed"
    reach.cut_off(4.0, frozenset())
    moved = reach.move(5.0, at(0, 50, 200))
    assert moved is None or moved.detail == "1 2 | 3"
