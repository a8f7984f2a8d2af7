"""List messages that an attacker can send to an agent, with one message for each possible effect on the agent.

The effect of a message depends only on three properties: whether the agent holds a hash, which of two timestamps is
older, and whether the answer is yes or no. docs/explanation/proof.md explains why these messages are enough. A test
compares the effects of these messages with the effects of random messages.
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

from harness.play.rogue.lies import NOBODYS
from ucp.block import Block, next_chain_hash
from ucp.messages import (
    BlockAddRequest,
    BlockAddResponse,
    BlockResponse,
    ChainContainQuery,
    ChainContainResponse,
    ChainHashSuccessorQuery,
    CommitBlock,
    Message,
    NextInSequenceResponse,
    RequestForBlock,
)
from ucp.state import AgentState


class PendingQuestions(NamedTuple):
    """The open queries and requests of an agent, for which it still waits for answers.

    `vote` contains the block hash and the chain hash of the agent's proposal. `contains` and `successor` are the chain
    hashes in its queries of phases 1 and 2. `block` is the block hash in its request of phase 3.
    """

    vote: tuple[bytes, bytes] | None = None
    contains: bytes | None = None
    successor: bytes | None = None
    block: bytes | None = None


class ForgeryMaterial(NamedTuple):
    """The data from which an attacker forms messages: blocks, block hashes, queries of other agents, and timestamps."""

    blocks: frozenset[Block]
    named: frozenset[bytes]
    others: frozenset[PendingQuestions]
    times_us: tuple[int, ...]


def asked(state: AgentState) -> PendingQuestions:
    """Return the open queries and requests of an agent, for which it still waits for answers."""
    candidate, top = state.candidate_block, state.chain.top_chain_hash
    voting = state.voting_timer.active and candidate is not None
    return PendingQuestions(
        (candidate.block_hash, state.top_chain_hash_at_initiation) if voting and candidate is not None else None,
        top if state.phase_one_timer.active else None,
        top if state.phase_two_timer.active else None,
        state.majority_response_block_hash if state.phase_three_timer.active else None,
    )


def forgeries(state: AgentState, captured: int, material: ForgeryMaterial) -> Iterator[Message]:
    """Yield the messages in the name of vehicle `captured` that have an effect.

    A message can affect the agent that receives it, or other agents through its answer.
    """
    yield from _answers(state, captured, material)
    if not state.reconcile_in_progress:
        yield from _commits(state, material.blocks)
        yield ChainHashSuccessorQuery(NOBODYS)
        yield from _questions(state, material.others)


def _answers(state: AgentState, captured: int, material: ForgeryMaterial) -> Iterator[Message]:
    """Yield forged answers to the agent's own queries. An agent counts only one answer of each sender."""
    waits = asked(state)
    if waits.vote is not None and captured not in state.voters:
        block_hash, chain_hash = waits.vote
        for approve in (False, True):
            yield BlockAddResponse(block_hash, approve, chain_hash if state.settings.vote_names_chain else None)
    if waits.contains is not None and captured not in state.reconcile_responders:
        for contained in (False, True):
            yield ChainContainResponse(waits.contains, contained)
    if waits.successor is not None and captured not in state.reconcile_responders:
        for candidate in (None, *sorted(material.named)):
            known = state.reconcile_response_dictionary.get(candidate or b"")
            for timestamp_us in material.times_us if known is None else known[1:]:
                yield NextInSequenceResponse(waits.successor, candidate, timestamp_us)
    if waits.block is not None:
        for block in material.blocks:
            if block.block_hash == waits.block:
                yield BlockResponse(block)


def _commits(state: AgentState, blocks: Iterable[Block]) -> Iterator[Message]:
    """Yield a forged Commit Block message for each block that the agent does not hold."""
    for block in sorted(blocks, key=lambda block: block.block_hash):
        if not state.holds(block.block_hash):
            yield CommitBlock(block, next_chain_hash(state.chain.top_chain_hash, block.block_hash))


def _questions(state: AgentState, others: Iterable[PendingQuestions]) -> Iterator[Message]:
    """Yield forged queries to this agent. The attacker only sends a query if another agent waits for answers to the
    same query.
    """
    chain = state.chain
    for waits in sorted(others, key=repr):
        if waits.vote is not None:
            block_hash, proposed_on = waits.vote
            for chain_hash in dict.fromkeys((chain.top_chain_hash, proposed_on, NOBODYS)):
                yield BlockAddRequest(block_hash, chain_hash)
        if waits.contains is not None:
            yield ChainContainQuery(waits.contains)
        if waits.successor is not None and chain.contains_chain_hash(waits.successor):
            yield ChainHashSuccessorQuery(waits.successor)
        if waits.block is not None and waits.block in chain:
            yield RequestForBlock(waits.block)
