"""Test missions of the thesis (Section 4.3) in virtual time. Five agents run for 20 minutes."""

from random import Random

import pytest

from harness.checker.uniform_chain import common_prefix
from tests.ucp.air import Air, uniform_latency


def mission(loss: float, seed: int) -> Air:
    air = Air(range(1, 6), uniform_latency(Random(seed), loss=loss))
    air.generate_events(seed)
    air.run_until(1200)
    air.stop_events()
    air.settle()
    return air


@pytest.mark.parametrize("seed", range(5))
def test_without_loss_one_uniform_chain_emerges(seed: int) -> None:
    air = mission(0.0, seed)
    completed = {block_hash for agent in air.agents.values() for block_hash in agent.state.completed}
    assert len(completed) > 20
    assert len(set(air.chains())) == 1
    assert set(air.chains()[0]) == completed


@pytest.mark.parametrize("seed", range(5))
def test_disconnected_agents_hold_their_own_blocks_only(seed: int) -> None:
    air = mission(1.0, seed)
    for agent in air.agents.values():
        assert [block.block_hash for block in agent.state.chain] == agent.state.completed
        assert agent.state.reconciles == 0


@pytest.mark.parametrize("seed", range(5))
def test_final_reconcile_makes_one_chain_after_15_percent_loss(seed: int) -> None:
    air = mission(0.15, seed)
    completed = {block_hash for agent in air.agents.values() for block_hash in agent.state.completed}
    assert completed <= {block_hash for chain in air.chains() for block_hash in chain}
    air.fate = uniform_latency(Random(seed))
    for _ in range(3):
        for agent_id in air.agents:
            air.reconcile(agent_id)
    assert len(set(air.chains())) == 1
    assert set(air.chains()[0]) == completed


def mutual_share(loss: float, seeds: range = range(5)) -> float:
    """Return the number of blocks that all chains have in common, divided by the number of completed blocks.

    The result is the mean over a few missions.
    """
    shares = []
    for seed in seeds:
        air = mission(loss, seed)
        blocks = sum(len(agent.state.completed) for agent in air.agents.values())
        shares.append(common_prefix(air.chains()) / blocks)
    return sum(shares) / len(shares)


def test_chains_diverge_as_in_section_4_3() -> None:
    """Up to a loss of 0.15, the chains of all agents are nearly equal.

    From a loss of 0.30, the chains diverge. From 0.50, they have hardly a block in common.
    """
    assert mutual_share(0.15) > 0.85
    assert 0.3 < mutual_share(0.30) < 0.9
    assert mutual_share(0.50) < 0.15
