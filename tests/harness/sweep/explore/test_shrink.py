"""Test the reduction of scenarios: no part of the result can be removed, whatever the number of processes."""

import pytest

from harness.scenario import Scenario
from harness.sweep.explore._scenario_document import Document, document_of, keep_agents, move_times, script, with_key
from harness.sweep.explore._smaller import BudgetSpentError, Shrinker
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


def test_the_number_of_runs_is_bounded_and_the_best_so_far_stays() -> None:
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
