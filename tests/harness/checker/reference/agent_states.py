"""Bring an agent of the reference implementation into a state in which a test can call its handlers.

The agent under test has ID 1. Agents 2 to 5 exist only as senders of messages.
"""

from typing import Any

from harness.checker.reference.state import Settings
from tests.harness.checker.reference.driver import Agent, Step
from ucp.block import Block, next_chain_hash
from ucp.events import LoggableEvent
from ucp.messages import (
    BlockAddResponse,
    ChainContainResponse,
    CommitBlock,
    Message,
    NextInSequenceResponse,
)

ROSTER = range(1, 6)
OTHER_HASH = bytes(31) + b"\1"
Trace = list[tuple[str, str]]


def new_agent(agent_id: int = 1, **settings: Any) -> Agent:
    return Agent(agent_id, ROSTER, b"mission", Settings(**settings))


def block_of(agent_id: int, timestamp_us: int) -> Block:
    return Block(agent_id, timestamp_us, b"x")


def trace(steps: list[Step]) -> Trace:
    return [(step.handler.name, step.branch) for step in steps]


def messages(steps: list[Step]) -> list[Message]:
    return [message for step in steps for _, message in step.sent]


def top(agent: Agent) -> bytes:
    return agent.state.chain.top_chain_hash


def complete(agent: Agent, timestamp_us: int = 100, now: float = 0.0) -> list[Step]:
    """Log one event that completes a block, and return the handler runs that this causes."""
    return agent.log(LoggableEvent(timestamp_us, 1, bytes(800)), now)


def receive_commit(agent: Agent, block: Block, now: float = 0.0) -> list[Step]:
    """Deliver a Commit Block message with a block that extends the agent's chain."""
    return agent.receive(2, CommitBlock(block, next_chain_hash(top(agent), block.block_hash)), now)


def agent_with_chain(count: int, **settings: Any) -> Agent:
    """Return an agent whose chain holds blocks of agent 2 with the timestamps 10, 20, 30 and so on."""
    agent = new_agent(**settings)
    for number in range(1, count + 1):
        assert trace(receive_commit(agent, block_of(2, 10 * number))) == [("receive_commit_block", "committed")]
    return agent


def vote(agent: Agent, sender: int, *, approve: bool, chain_hash: bytes | None = None) -> str:
    candidate = agent.state.candidate_block
    assert candidate is not None
    [step] = agent.receive(sender, BlockAddResponse(candidate.block_hash, approve, chain_hash), 1.0)
    return step.branch


def answer_phase_1(agent: Agent, sender: int, *, contained: bool) -> str:
    [step] = agent.receive(sender, ChainContainResponse(top(agent), contained), 1.0)
    return step.branch


def answer_phase_2(agent: Agent, sender: int, block_hash: bytes | None, timestamp_us: int) -> str:
    [step] = agent.receive(sender, NextInSequenceResponse(top(agent), block_hash, timestamp_us), 6.0)
    return step.branch


def agent_in_phase_2(count: int = 0, **settings: Any) -> Agent:
    agent = agent_with_chain(count, **settings)
    agent.begin_reconcile(0.0)
    answer_phase_1(agent, 2, contained=True)
    agent.expire("phase one", 5.0)
    return agent


def agent_in_phase_3(block: Block, **settings: Any) -> Agent:
    agent = agent_in_phase_2(**settings)
    answer_phase_2(agent, 2, block.block_hash, block.timestamp_us)
    agent.expire("phase two", 10.0)
    return agent


def pop_top(agent: Agent, now: float = 0.0) -> list[Step]:
    """Run one round of reconcile phase 1. The only answer in it is "no", so the agent removes its top block."""
    answer_phase_1(agent, 2, contained=False)
    return agent.expire("phase one", now)


def agent_with_stack(chain_count: int, stack_count: int, **settings: Any) -> Agent:
    """Return an agent in reconcile phase 1 that has removed `stack_count` blocks from its chain."""
    agent = agent_with_chain(chain_count + stack_count, **settings)
    agent.begin_reconcile(0.0)
    for _ in range(stack_count):
        pop_top(agent)
    return agent


def agent_in_phase_3_with_stack(stack_count: int, chosen: bytes, **settings: Any) -> tuple[Agent, list[Step]]:
    """Return an agent whose reconcile phase 2 has chosen the block `chosen`, and the last handler runs.

    The agent has removed its whole chain before.
    """
    agent = agent_with_stack(0, stack_count, **settings)
    answer_phase_1(agent, 2, contained=True)
    agent.expire("phase one", 5.0)
    answer_phase_2(agent, 2, chosen, 10)
    return agent, agent.expire("phase two", 10.0)
