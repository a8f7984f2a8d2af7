"""Test swarms in which all receivers get the messages of an action before another agent acts."""

from pathlib import Path
from random import Random
from typing import Any

import pytest

from harness.proof import Bounds, BoundsError, in_words, prove
from harness.proof.examples._example import play
from harness.proof.examples._path_script import PathScript
from tests.harness.proof.test_explore import all_seen, by_chance, explored


@pytest.mark.parametrize(("agents", "blocks", "network"), [(2, 4, "lossless"), (2, 3, "lossy"), (3, 2, "lossy")])
def test_reduced_and_whole_state_spaces_are_equal(agents: int, blocks: int, network: Any) -> None:
    reduced = explored(agents, blocks, network, crossing=False)
    whole = explored(agents, blocks, network, crossing=False, reduced=False)
    assert len(reduced.states) < len(whole.states)
    assert all_seen(reduced) == all_seen(whole)


@pytest.mark.parametrize(("agents", "blocks", "loss"), [(2, 3, 0.4), (3, 2, 0.4), (3, 3, 0.0)])
def test_random_runs_without_latency_are_contained(agents: int, blocks: int, loss: float) -> None:
    seen = all_seen(explored(agents, blocks, "lossy" if loss else "lossless", crossing=False))
    for seed in range(60):
        for there in by_chance(agents, blocks, loss, Random(seed)):
            assert there in seen


@pytest.mark.parametrize(("agents", "blocks", "network"), [(2, 4, "lossless"), (3, 3, "lossless"), (2, 3, "lossy")])
def test_states_without_crossing_are_contained_in_those_with_it(agents: int, blocks: int, network: Any) -> None:
    assert all_seen(explored(agents, blocks, network, crossing=False)) < all_seen(explored(agents, blocks, network))


def test_agents_act_one_by_one() -> None:
    graph = explored(3, 3, "lossy", crossing=False)
    numbers = {state: number for number, state in enumerate(graph.states)}
    at_once = 0
    for number, state in enumerate(graph.states):
        assert all(len(actions) == 1 for actions in graph.swarm.actions(state))
        for (_, tied), following in zip(graph.swarm.alternatives(state), graph.quiet[number], strict=True):
            if len(tied) > 1:  # any of them may be the first
                at_once += 1
                for action in tied:
                    for after in graph.swarm.after(state, (action,), lossy=False):
                        assert numbers[after] in following
    assert at_once > 0


def test_no_flaw_exists_without_losses_and_crossing(tmp_path: Path) -> None:
    crossing = prove(Bounds(2, 4, "lossless"), out=tmp_path / "crossing.yaml")
    assert crossing.livelocks
    for bounds in (
        Bounds(2, 4, "lossless", crossing=False),
        Bounds(5, 5, "lossless", crossing=False, clocks_any=True),
    ):
        proof = prove(bounds, out=tmp_path / f"{bounds.agents}.yaml")
        assert proof.exit_status == 0
        assert proof.liveness is not None
        assert (proof.liveness.forks, proof.liveness.astray) == (0, [0])
        assert next(in_words(proof)).endswith("complete")
        assert "nothing crosses" in next(in_words(proof))
        assert proof.to_json()["crossing"] is False


def test_livelock_of_three_with_losses_needs_no_crossing(tmp_path: Path) -> None:
    proof = prove(Bounds(3, 3, "lossy", crossing=False), out=tmp_path / "three.yaml")
    [livelock] = proof.livelocks
    assert livelock.losses == 3


def test_paths_played_as_scenarios_give_equal_numbers_of_chains() -> None:
    graph = explored(3, 2, "lossy", crossing=False)
    forked = 0
    for number, state in enumerate(graph.states):
        if number and not graph.quiet[number] and graph.swarm.is_idle(state):
            chains = len(graph.swarm.chains(state))
            assert play(PathScript(graph, graph.path(number)).document("rest")).chains == chains
            forked += chains > 1
    assert forked > 1


def test_network_any_allows_crossing() -> None:
    with pytest.raises(BoundsError, match=r"--no-crossing does not apply to --network any"):
        Bounds(2, 2, "any", crossing=False)


def test_proof_refuses_a_spread_of_answers() -> None:
    with pytest.raises(BoundsError, match="answer_spread_s has no meaning here"):
        Bounds(2, 1, settings={"answer_spread_s": 0.5})
