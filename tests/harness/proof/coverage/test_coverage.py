"""Test that simulated runs, recorded runs and `prove` identify the states that they reach in the same way."""

import json
from pathlib import Path
from random import Random
from typing import Any

import pytest

from harness.archive.archive import RunArchive
from harness.checker import gather
from harness.proof import Bounds
from harness.proof.coverage import ReachedStates, existing, in_words, reached_in, to_json
from harness.proof.coverage._share import CoverageShare
from harness.proof.coverage.reached import BRANCHES
from harness.proof.model._shape import LEFT_OUT
from harness.proof.model._snapshot import LEFT_OUT as OF_SNAPSHOTS
from harness.run.simulate import simulate
from harness.scenario import Scenario
from tests.harness.command import harness, sentences
from ucp.agent import Agent

ONE_EVENT_ONE_BLOCK = {"max_block_bytes": 267}
SHAPED = {
    "chain",
    "blocks_to_be_committed",
    "reconcile_stack",
    "reconcile_in_progress",
    "candidate_block",
    "top_chain_hash_at_initiation",
    "vote_count",
    "reconcile_vote_count",
    "reconcile_response_dictionary",
    "majority_response_block_hash",
}
TIMERS = {"voting_timer", "phase_one_timer", "phase_two_timer", "phase_three_timer", "finalize_timer"}
BETWEEN_STEPS = {"triggered", "_held_aside"}


def scenario(agents: int, script: list[dict[str, Any]], **keys: Any) -> Scenario:
    events = {"source": "scripted", "script": script}
    settings = ONE_EVENT_ONE_BLOCK | keys.pop("settings", {})
    return Scenario.model_validate(
        {"name": "test", "agents": agents, "duration_s": 60, "settings": settings, "events": events, **keys}
    )


def by_chance(agents: int, blocks: int, seed: int) -> Scenario:
    lots = Random(seed)
    script = [{"at_s": round(40 * lots.random(), 2), "agent": lots.randint(1, agents)} for _ in range(blocks)]
    return scenario(agents, script, network={"loss": round(0.6 * lots.random(), 2)})


def reached(asked: Scenario, seed: int = 1, **options: Any) -> ReachedStates:
    return reached_in(simulate(asked, seed, tracing=True, deliver_all=True, **options).evidence)


@pytest.mark.parametrize(
    ("reached", "percent"), [(0, "0 %"), (1, "0.1 %"), (3_500, "35 %"), (9_999, "99.9 %"), (10_000, "100 %")]
)
def test_only_exact_shares_are_printed_as_none_or_all(reached: int, percent: str) -> None:
    assert CoverageShare(reached, 10_000, 0).percent == percent


def test_shape_covers_each_attribute_or_omits_it_with_a_reason() -> None:
    there = vars(Agent(1, [1], b"").state).keys() - OF_SNAPSHOTS
    assert there == SHAPED | TIMERS | BETWEEN_STEPS | LEFT_OUT


@pytest.mark.parametrize("bounds", [Bounds(2, 2), Bounds(2, 1, "any"), Bounds(2, 3, "lossless")])
def test_reductions_keep_all_local_states_and_inputs(bounds: Bounds) -> None:
    whole = existing(Bounds(bounds.agents, bounds.blocks, bounds.network, reduced=False))
    there = existing(bounds)
    assert there.states == whole.states
    assert there.pairs == whole.pairs


def test_states_that_a_run_reaches_exist() -> None:
    there, both = existing(Bounds(2, 2, "any")), ReachedStates()
    for seed in range(30):
        both.add(reached(by_chance(2, 2, seed), seed))
    assert both.states <= there.states
    assert both.pairs <= there.pairs
    assert len(both.states) > 10


def test_shape_does_not_depend_on_agents_blocks_and_mission() -> None:
    alike = {"network": {"delay": 0.02}, "duration_s": 200}

    def made_by(agent: int, at_s: float, initial_data: str) -> Scenario:
        script = [{"at_s": at_s, "agent": agent}, {"at_s": at_s + 0.1, "agent": agent}]
        lost = {"message": "Commit Block", "sender": agent, "count": 1, "drop": True}
        return scenario(2, script, fates=[lost], initial_data=initial_data, **alike)

    first, second = made_by(1, 5, "b25l"), made_by(2, 105, "b3RoZXI=")
    one, other = reached(first), reached(second)
    assert one.states == other.states
    assert one.pairs == other.pairs


def test_larger_run_is_partly_beyond_the_bounds() -> None:
    all_reached, there = reached(by_chance(3, 6, 1)), existing(Bounds(2, 2))
    within = to_json(all_reached, there)["within"]["local_states"]
    assert 0 < within["reached"] < within["exist"] == len(there.states)
    assert within["reached"] + within["beyond"] == len(all_reached.states)


def test_branches_are_those_of_the_contract() -> None:
    nothing_lost = reached(scenario(2, [{"at_s": 5, "agent": 1}]))
    document = to_json(nothing_lost, None)["branches"]
    assert document["exist"] == len(BRANCHES) == document["taken"] + len(document["not_taken"])
    assert ["reconcile_begin", "begun"] in document["not_taken"]
    assert ["vote_timer_expiration", "approved"] not in document["not_taken"]
    assert any("reconcile_begin: already in progress, begun" in line for line in in_words(nothing_lost, None))


def test_recorded_run_has_the_coverage_of_the_played_run(tmp_path: Path) -> None:
    asked = by_chance(3, 3, 4)
    path = tmp_path / "scenario.yaml"
    path.write_text(json.dumps(asked.model_dump(mode="json", exclude_defaults=True)))
    assert harness("run", path, "--backend", "sim", "--seed", 4, "--out", tmp_path / "run").returncode in (0, 1)
    recorded = reached_in(gather(RunArchive(tmp_path / "run")))
    played = reached_in(simulate(asked, 4, tracing=True).evidence)
    assert recorded.states == played.states
    assert recorded.pairs == played.pairs
    assert recorded.branches == played.branches
    done = harness("coverage", tmp_path / "run", "--agents", 2, "--blocks", 2, "--json")
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert document["local_states"] == len(played.states)
    assert document["within"]["local_states"]["exist"] == len(existing(Bounds(2, 2)).states)


def test_run_without_traces_has_unknown_coverage(tmp_path: Path) -> None:
    asked = by_chance(2, 1, 1)
    path = tmp_path / "scenario.yaml"
    path.write_text(json.dumps(asked.model_dump(mode="json", exclude_defaults=True)))
    harness("run", path, "--backend", "sim", "--seed", 1, "--out", tmp_path / "run")
    for trace in (tmp_path / "run").rglob("*.trace.jsonl"):
        trace.unlink()
    done = harness("coverage", tmp_path / "run")
    assert done.returncode == 2
    assert "has no traces" in sentences(done.stderr)[0]
