"""Test the reduction of scenarios: no part of the result can be removed, whatever the number of processes.

Test that the script of a recorded run gives the same run again.
"""

from typing import Any

import pytest

from harness.run.simulate import simulate
from harness.scenario import Scenario
from harness.sweep.explore._recording import record
from harness.sweep.explore._scenario_document import Document, document_of, keep_agents, move_times, script, with_key
from harness.sweep.explore._smaller import BudgetSpentError, Shrinker, replays, scenario_of
from tests.harness.virtual import scenario

START: Document = {
    "name": "test",
    "events": {"source": "scripted", "script": [{"at_s": float(n), "agent": 1 + n % 5} for n in range(64)]},
}
NEEDED = {3.0, 17.0, 44.0}


def violates(scenario: Scenario) -> bool:
    return {event.at_s for event in scenario.events.script} >= NEEDED


def shrinker(jobs: int = 1, max_runs: int = 1000) -> Shrinker:
    return Shrinker(START, violates, jobs=jobs, max_runs=max_runs, adopted=lambda it: None)


def shrink(it: Shrinker) -> list[Document]:
    it.fewest(script(START), lambda kept: with_key(START, "events.script", list(kept)))
    return script(it.best)


def test_only_necessary_parts_are_left() -> None:
    assert {event["at_s"] for event in shrink(shrinker())} == NEEDED


def test_more_processes_find_the_same_in_as_many_runs() -> None:
    alone, together = shrinker(jobs=1), shrinker(jobs=2)
    assert shrink(alone) == shrink(together)
    assert alone.runs == together.runs


def test_invalid_scenarios_are_not_tried() -> None:
    it = shrinker()
    assert it.first([{**START, "agents": []}, {**START, "duration_s": -1}]) is None
    assert it.runs == 0


def test_nothing_is_tried_twice() -> None:
    it = shrinker()
    empty = with_key(START, "events.script", [])
    for _ in range(2):
        assert it.first([empty, empty, START]) is None
    assert it.runs == 1


def test_limit_of_runs_ends_the_search_and_keeps_the_best_scenario() -> None:
    it = shrinker(max_runs=9)
    with pytest.raises(BudgetSpentError):
        shrink(it)
    assert it.runs == 9
    assert violates(Scenario.model_validate(it.best))


def test_recorded_flight_is_shrunk_without_irrelevant_recorded_parts() -> None:
    flight = {
        "agents": [1, 2],
        "duration_s": 60,
        "initial_data": "AAAA",
        "events": {"source": "scripted", "script": [{"at_s": 10, "agent": 1, "data": "AQ==", "event_id": 7}]},
        "settings": {"max_block_bytes": 267},
        "fates": [{"sender": 1, "receiver": 2, "arrivals": "0@10.5"}],
        "lateness": {1: "0+0.25", 2: "0+0.5"},
        "datagrams": [{"source": 2, "datagram": "AAAA", "reaches": {"1": 20}}],
    }
    document = document_of(scenario(**flight, expect={"seeds": [1]}))
    assert "expect" not in document
    alone = keep_agents(document, {1})
    assert alone["lateness"] == {"1": "0+0.25"}
    assert "datagrams" not in alone
    assert "fates" not in alone
    later = move_times(document, lambda at_s: at_s + 100)
    assert later["fates"][0]["arrivals"] == "0@110.5"
    assert later["datagrams"][0]["reaches"] == {"1": 120}


APART = [
    {"vehicles": [1, 2], "plan": [{"take_off": 20}, {"go_to": [300, 0]}]},
    {"vehicles": [3, 4], "plan": [{"take_off": 20}, {"go_to": [-300, 0]}, {"go_to": [0, 0]}]},
]
LOSS: list[dict[str, Any]] = [
    {"network": {"loss": 0.3}},
    {"network": {"loss": {"p": 0.1, "r": 0.3}}},
    {"network": {"loss": 0.2, "delay": {"mean_s": 1, "jitter_s": 0.9, "distribution": "normal"}}},
    {"network": {"delay": {"mean_s": 1, "jitter_s": 0.9}, "duplicate": 0.3, "reorder": 0.2}},
    {"network": {"receivers": {3: {"loss": 0.9}}, "links": [{"from": 1, "to": 2, "loss": 0.5, "both": True}]}},
    {"timeline": [{"at_s": 100, "loss": 0.5}, {"at_s": 200, "partition": [[1, 2]]}, {"at_s": 400, "heal": True}]},
    {"network": {"loss": 0.2}, "timeline": [{"at_s": 100, "pause": [1]}, {"at_s": 300, "resume": [1]}]},
    {"network": {"loss": 0.2}, "timeline": [{"at_s": 100, "kill": [1]}, {"at_s": 300, "restart": [1]}]},
    {"network": {"loss": 0.2}, "quirks": {"ignore_commit": 0.3}},
    {"network": {"loss": 0.2}, "clocks": {2: {"offset_s": 500, "drift": 0.01}}},
    {"network": {"loss": 0.2}, "fates": [{"message": "Commit Block", "sender": 1, "delay_s": 3.0}]},
    {"network": {"radio": {"log_distance": {}}}, "vehicles": {"types": {2: "copter"}}, "flight": APART},
]


@pytest.mark.parametrize("keys", LOSS)
def test_script_of_a_run_reproduces_the_run(keys: dict[str, Any]) -> None:
    asked = scenario(agents=4, duration_s=600, final_reconcile=True, **keys)
    original = simulate(asked, 5, tracing=True)
    faithful = scenario_of(next(replays(document_of(asked), record(asked, 5))))
    # Agents with deliberate errors receive all messages.
    again = simulate(faithful, 5, tracing=True, deliver_all="quirks" in keys)
    uncounted = {"bytes"}  # events have other data, and blocks other hashes
    assert again.result.figures.items() - uncounted == original.result.figures.items() - uncounted
    for agent_id, trace in original.evidence.traces.items():
        steps = [(run.t, run.handler, run.branch) for run in trace.runs if run.branch != "ignored by quirk"]
        same = again.evidence.traces[agent_id].runs
        assert [(run.t, run.handler, run.branch) for run in same] == steps
    assert not again.played.unmatched_fates
    assert faithful.network.radio is None and not faithful.flight, "nothing is left to distance"


def test_removed_agents_have_no_vehicles() -> None:
    asked = scenario(agents=4, network={"radio": {"hard_range": {}}}, vehicles={"types": {2: "copter"}}, flight=APART)
    fewer = scenario_of(keep_agents(document_of(asked), [1, 3]))
    assert [flight.vehicles for flight in fewer.flight] == [[1], [3]]
    assert fewer.vehicles.types == {}
    assert scenario_of(keep_agents(document_of(asked), [1])).flight_of(3) is None


def test_removed_agents_have_no_quirks() -> None:
    asked = scenario(agents=4, quirks={"crash_on_tie": {"agents": [2, 3]}, "hide_commits": True})
    fewer = scenario_of(keep_agents(document_of(asked), [1, 3]))
    assert fewer.quirks_of(3) == {"crash_on_tie": True, "hide_commits": True}
    assert fewer.quirks_of(1) == {"hide_commits": True}
    assert "crash_on_tie" not in scenario_of(keep_agents(document_of(asked), [1, 4])).quirks


def test_recording_names_lost_messages() -> None:
    asked = scenario(
        agents=[1, 2],
        events={"source": "scripted", "script": [{"at_s": 1, "agent": 1}]},
        settings={"max_block_bytes": 267},
        fates=[{"message": "Commit Block", "drop": True}],
    )
    (lost,) = record(asked, 0).lost
    assert (lost.message, lost.sender, lost.receiver, lost.count, lost.block) == ("Commit Block", 1, 2, 1, "1.1")
