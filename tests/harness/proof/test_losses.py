"""Test state spaces with a limited number of lost messages."""

from pathlib import Path
from random import Random

import pytest

from harness.proof import Bounds, in_words, prove
from harness.proof.examples._path_script import PathScript
from harness.proof.model._global_states import LEFT, LOSSES
from tests.harness.proof.test_explore import all_seen, by_chance, explored


def test_zero_losses_equal_the_lossless_network() -> None:
    assert all_seen(explored(3, 3, "lossy", losses=0)) == all_seen(explored(3, 3, "lossless"))


def test_more_losses_give_more_states() -> None:
    bounded = [all_seen(explored(3, 2, "lossy", losses=most)) for most in (0, 1, 2, 9)]
    assert bounded[0] < bounded[1] < bounded[2] < bounded[3] == all_seen(explored(3, 2, "lossy"))


@pytest.mark.parametrize(("agents", "blocks", "losses"), [(2, 3, 2), (3, 2, 1), (3, 2, 3)])
def test_reduced_and_whole_state_spaces_are_equal(agents: int, blocks: int, losses: int) -> None:
    reduced = explored(agents, blocks, "lossy", losses=losses)
    whole = explored(agents, blocks, "lossy", losses=losses, reduced=False)
    assert len(reduced.states) < len(whole.states)
    assert all_seen(reduced) == all_seen(whole)


@pytest.mark.parametrize("losses", [1, 2, 4])
def test_random_runs_with_limited_losses_are_contained(losses: int) -> None:
    seen = all_seen(explored(3, 3, "lossy", losses=losses))
    for seed in range(60):
        for there in by_chance(3, 3, 0.2, Random(seed), most_lost=losses):
            assert there in seen


@pytest.mark.parametrize("faults", [(), ("duplicate",)])
def test_scenario_of_a_path_has_the_counted_losses(faults: tuple[str, ...]) -> None:
    graph = explored(3, 2, "lossy", faults, losses=3)
    lost_most = 0
    for number, state in enumerate(graph.states[1:], 1):
        fates = PathScript(graph, graph.path(number)).document("lossy").get("fates", ())
        lost = sum(1 if "receiver" in fate else graph.swarm.bounds.agents - 1 for fate in fates if fate.get("drop"))
        assert lost == 3 - state[LEFT] // LOSSES
        lost_most = max(lost_most, lost)
    assert lost_most == 3


def test_fork_needs_one_loss_and_livelock_of_three_needs_three(tmp_path: Path) -> None:
    proofs = [prove(Bounds(3, 3, "lossy", losses=most), out=tmp_path / f"{most}.yaml") for most in range(4)]
    assert [[each.losses for each in proof.livelocks] for proof in proofs] == [[], [], [], [3]]
    assert any("; 3 losses lead there: " in line for line in in_words(proofs[3]))
    assert [proof.fork is not None for proof in proofs] == [True] * 4
    apart = prove(Bounds(3, 3, "lossy", losses=0, coincidences=0), out=tmp_path / "apart.yaml")
    assert apart.fork is None
