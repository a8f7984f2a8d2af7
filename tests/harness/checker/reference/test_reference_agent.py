"""Test how the reference implementation calls its handlers, with one agent and with a swarm."""

import random
from hashlib import sha256
from typing import Any

import pytest

from harness.checker.reference.algorithms import HANDLERS
from harness.checker.reference.state import ReferenceState, Settings
from tests.harness.checker.reference.driver import (
    OTHER_HASH,
    ROSTER,
    Agent,
    block_of,
    complete,
    messages,
    new_agent,
    top,
    trace,
)
from ucp.events import LoggableEvent
from ucp.messages import BlockResponse, ChainContainQuery, CommitBlock, Message

# Driver


@pytest.mark.parametrize(
    ("sender", "message"),
    [
        (1, ChainContainQuery(OTHER_HASH)),
        (9, ChainContainQuery(OTHER_HASH)),
        (2, CommitBlock(block_of(9, 10), OTHER_HASH)),
        (2, BlockResponse(block_of(9, 10))),
    ],
    ids=["own message", "foreign sender", "foreign block to commit", "foreign block in a response"],
)
def test_agent_ignores_input_from_outside_the_mission(sender: int, message: Message) -> None:
    assert new_agent().receive(sender, message, 0.0) == []


def test_stopped_timer_does_not_expire() -> None:
    assert new_agent().expire("voting", 10.0) == []


def test_sequence_numbers_count_all_messages_of_an_agent() -> None:
    agent = new_agent()
    complete(agent)
    steps = agent.expire("voting", 10.0) + agent.begin_reconcile(11.0)
    assert [sequence for step in steps for sequence, _ in step.sent] == [1, 2]
    assert agent.state.sequence == 3


def test_local_event_names_the_handler_that_triggered_it() -> None:
    state = new_agent().state
    state.running = HANDLERS["build_data_block"]
    HANDLERS["build_data_block"].run(state, LoggableEvent(1, 1, bytes(800)))
    assert list(state.triggered) == [("Process Next Deque Block", "build_data_block")]
    assert not state.idle


def test_boot_restores_the_blocks_and_finalizes_a_reconcile() -> None:
    in_chain, in_deque, on_stack = block_of(1, 10), block_of(1, 30), block_of(2, 90)
    lost = block_of(1, 50)
    agent = new_agent(vote_timeout_s=4.0)
    completed = [in_chain.block_hash, in_deque.block_hash, lost.block_hash]
    steps = agent.boot(completed, [in_chain], [in_deque], [on_stack], 7.0)
    assert trace(steps) == [("reconcile_finalize", "done"), ("process_next_deque_block", "proposed")]
    assert steps[0].changes == [
        *(("complete", block_hash.hex()) for block_hash in completed),
        ("chain+", in_chain.block_hash.hex()),
        ("deque+", in_deque.block_hash.hex()),
        ("stack+", on_stack.block_hash.hex()),
        ("stack-", on_stack.block_hash.hex()),
        ("chain+", on_stack.block_hash.hex()),
    ]
    assert list(agent.state.chain) == [in_chain, on_stack]
    assert agent.state.completed == completed
    assert agent.state.newest_block_timestamp_us == 30
    assert agent.state.voting_timer.deadline == 11.0
    assert not agent.state.reconcile_in_progress


def test_restored_agent_is_in_a_reconcile() -> None:
    state = ReferenceState(1, b"mission", Settings())
    state.restore([], [], [], [])
    assert state.reconcile_in_progress
    assert state.newest_block_timestamp_us == -1


# Whole swarms


def run_swarm(seed: int, loss: float, **settings: Any) -> list[Agent]:
    """Run five agents with delays of 2 to 50 ms until all are idle. Check invariants after each input."""
    rng = random.Random(seed)
    agents = {agent_id: new_agent(agent_id, **settings) for agent_id in ROSTER}
    inputs: list[tuple[float, int, int, int, Message | LoggableEvent]] = []
    for order in range(60):
        now = rng.uniform(0, 400)
        inputs.append((now, -order, rng.choice(ROSTER), 0, LoggableEvent(int(now * 1e6), 1, bytes(256))))
    serial = 0
    for _ in range(100_000):
        timers = [
            (timer.deadline, agent_id, timer)
            for agent_id, agent in agents.items()
            for timer in agent.state.timers
            if timer.deadline is not None
        ]
        next_timer = min(timers, key=lambda each: each[:2], default=None)
        next_input = min(inputs, key=lambda each: each[:2], default=None)
        if next_input is not None and (next_timer is None or next_input[0] <= next_timer[0]):
            inputs.remove(next_input)
            now, _, receiver, sender, content = next_input
            agent = agents[receiver]
            if isinstance(content, LoggableEvent):
                steps = agent.log(content, now)
            else:
                steps = agent.receive(sender, content, now)
        elif next_timer is not None:
            now, receiver, timer = next_timer
            agent = agents[receiver]
            steps = agent.expire(timer, now)
        else:
            return list(agents.values())
        for message in messages(steps):
            for other in agents:
                if other != receiver and rng.random() >= loss:
                    serial += 1
                    inputs.append((now + rng.uniform(0.002, 0.05), serial, other, receiver, message))
        check_invariants(agent)
    raise AssertionError("the swarm did not become idle")


def check_invariants(agent: Agent) -> None:
    state = agent.state
    held = [block.block_hash for block in (*state.chain, *state.blocks_to_be_committed, *state.reconcile_stack)]
    assert len(held) == len(set(held))  # characteristic 3
    assert set(state.completed) <= set(held)
    assert all(state.holds(block_hash) for block_hash in held)
    if state.idle:
        assert not state.blocks_to_be_committed  # characteristic 2
        assert not state.reconcile_stack
    chain_hash = state.chain.inception.chain_hash
    for block in state.chain:
        chain_hash = sha256(chain_hash + block.block_hash).digest()
    assert chain_hash == state.chain.top_chain_hash


@pytest.mark.parametrize("seed", range(5))
def test_swarm_keeps_characteristics_2_and_3_at_any_loss(seed: int) -> None:
    run_swarm(seed, loss=(0.0, 0.15, 0.3, 0.5, 0.75)[seed])


def test_swarm_with_every_setting_changed_becomes_idle() -> None:
    settings: dict[str, Any] = {
        "vote_names_chain": True,
        "changed_before_tally": True,
        "phase1_tie": "pop",
        "phase2_tie": "block",
        "asks_after_commit": True,
        "top_needs_majority": True,
    }
    run_swarm(8, loss=0.2, **settings)


def test_agents_cut_off_from_each_other_commit_only_their_own_blocks() -> None:
    for agent in run_swarm(3, loss=1.0):
        assert [block.block_hash for block in agent.state.chain] == agent.state.completed
        assert not agent.state.reconcile_in_progress


def test_swarm_without_loss_holds_all_blocks_in_every_chain() -> None:
    agents = run_swarm(1, loss=0.0)
    completed = {block_hash for agent in agents for block_hash in agent.state.completed}
    assert completed
    assert len({top(agent) for agent in agents}) == 1
    assert all({block.block_hash for block in agent.state.chain} == completed for agent in agents)
