"""All that a captor can say to an agent, up to what the agent can tell apart: of each kind one message.

What handlers ask of a message is whether a hash in it is one that they hold, which of two timestamps is the older, and
yes or no. docs/explanation/proof.md says why these messages are enough; a test holds random ones to them.
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


class Asked(NamedTuple):
    """What an agent waits for: votes on a block for a chain, and in a reconcile answers about a chain or a block."""

    vote: tuple[bytes, bytes] | None = None
    contains: bytes | None = None
    successor: bytes | None = None
    block: bytes | None = None


class Material(NamedTuple):
    """Of what a captor can speak: blocks that it can send, hashes of blocks, what others wait for, and times."""

    blocks: frozenset[Block]
    named: frozenset[bytes]
    others: frozenset[Asked]
    times_us: tuple[int, ...]


def asked(state: AgentState) -> Asked:
    """What this agent waits for."""
    candidate, top = state.candidate_block, state.chain.top_chain_hash
    voting = state.voting_timer.active and candidate is not None
    return Asked(
        (candidate.block_hash, state.top_chain_hash_at_initiation) if voting and candidate is not None else None,
        top if state.phase_one_timer.active else None,
        top if state.phase_two_timer.active else None,
        state.majority_response_block_hash if state.phase_three_timer.active else None,
    )


def letters(state: AgentState, captor: int, material: Material) -> Iterator[Message]:
    """What `captor` can say to the agent that makes any difference to it, or to those who hear its answer."""
    yield from _answers(state, captor, material)
    if not state.reconcile_in_progress:
        yield from _commits(state, material.blocks)
        yield ChainHashSuccessorQuery(NOBODYS)
        yield from _questions(state, material.others)


def _answers(state: AgentState, captor: int, material: Material) -> Iterator[Message]:
    """To what the agent itself has asked; nobody is counted twice."""
    waits = asked(state)
    if waits.vote is not None and captor not in state.voters:
        block_hash, chain_hash = waits.vote
        for approve in (False, True):
            yield BlockAddResponse(block_hash, approve, chain_hash if state.settings.vote_names_chain else None)
    if waits.contains is not None and captor not in state.reconcile_responders:
        for contained in (False, True):
            yield ChainContainResponse(waits.contains, contained)
    if waits.successor is not None and captor not in state.reconcile_responders:
        for candidate in (None, *sorted(material.named)):
            known = state.reconcile_response_dictionary.get(candidate or b"")
            for timestamp_us in material.times_us if known is None else known[1:]:
                yield NextInSequenceResponse(waits.successor, candidate, timestamp_us)
    if waits.block is not None:
        for block in material.blocks:
            if block.block_hash == waits.block:
                yield BlockResponse(block)


def _commits(state: AgentState, blocks: Iterable[Block]) -> Iterator[Message]:
    """Of every block that the agent does not hold, on top of its chain."""
    for block in sorted(blocks, key=lambda block: block.block_hash):
        if not state.holds(block.block_hash):
            yield CommitBlock(block, next_chain_hash(state.chain.top_chain_hash, block.block_hash))


def _questions(state: AgentState, others: Iterable[Asked]) -> Iterator[Message]:
    """To which the agent's answer is one for which somebody else waits."""
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
