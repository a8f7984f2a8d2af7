"""Decide which messages can have an effect on an agent. A simulation need not deliver the other messages.

All messages are broadcast, so each of N agents receives the messages of all others. Most of them have no effect: an
answer matters only to agents that sent the query, and an agent that reconciles answers no message. This module decides
from the state of an agent whether a message has an effect, without running a handler. A driver in virtual time may
withhold messages without effect. Real networks deliver them, and the handlers then do nothing, as Algorithms 1-20
define.
"""

from collections.abc import Callable
from typing import Any

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
from ucp.settings import Settings
from ucp.state import AgentState

Question = tuple[type[Message], bytes]
"""An open query of an agent: the type of the expected answers, and the hash of the block or chain that the query
concerns.

An agent can have two open queries: one of its vote (type Block Add Response), and one of its reconcile.
"""

ONLY_COUNTED = frozenset((BlockAddResponse, ChainContainResponse, NextInSequenceResponse))
"""Types of answers that only change a counter (Algorithms 4, 10 and 14). Their handlers send no message and change no
timer.
"""

ASKED: dict[type[Message], Callable[[Any, Settings], Question]] = {
    BlockAddRequest: lambda message, settings: (
        BlockAddResponse,
        message.block_hash + message.chain_hash if settings.vote_names_chain else message.block_hash,
    ),
    ChainContainQuery: lambda message, settings: (ChainContainResponse, message.chain_hash),
    ChainHashSuccessorQuery: lambda message, settings: (NextInSequenceResponse, message.chain_hash),
    RequestForBlock: lambda message, settings: (BlockResponse, message.block_hash),
}
"""Type of a query -> function that returns the query as a `Question`. The sender of the query then waits for answers to
this `Question`. Messages of other types are no queries.
"""

ANSWERED: dict[type[Message], Callable[[Any], Question]] = {
    BlockAddResponse: lambda message: (
        BlockAddResponse,
        message.block_hash if message.chain_hash is None else message.block_hash + message.chain_hash,
    ),
    ChainContainResponse: lambda message: (ChainContainResponse, message.chain_hash),
    NextInSequenceResponse: lambda message: (NextInSequenceResponse, message.chain_hash),
    BlockResponse: lambda message: (BlockResponse, message.block.block_hash),
}
"""Type of an answer -> function that returns the query to which the answer belongs. The answer has no effect on agents
that do not wait for answers to this query.
"""

STILL_ASKED: dict[type[Message], Callable[[AgentState], bool]] = {
    BlockAddResponse: lambda state: state.voting_timer.active,
    ChainContainResponse: lambda state: state.phase_one_timer.active,
    NextInSequenceResponse: lambda state: state.phase_two_timer.active,
    BlockResponse: lambda state: state.phase_three_timer.active,
}
"""Type of an answer -> function that returns true if the agent still waits for answers of this type."""

MATTERS: dict[type[Message], Callable[[AgentState, int, Any], bool]] = {
    BlockAddRequest: lambda state, sender, message: not state.reconcile_in_progress,
    BlockAddResponse: lambda state, sender, message: (
        state.voting_timer.active
        and sender not in state.voters
        and state.candidate_block is not None
        and state.candidate_block.block_hash == message.block_hash
        and (not state.settings.vote_names_chain or state.top_chain_hash_at_initiation == message.chain_hash)
    ),
    CommitBlock: lambda state, sender, message: not state.reconcile_in_progress,
    ChainContainQuery: lambda state, sender, message: not state.reconcile_in_progress,
    ChainContainResponse: lambda state, sender, message: (
        state.phase_one_timer.active
        and sender not in state.reconcile_responders
        and message.chain_hash == state.chain.top_chain_hash
    ),
    ChainHashSuccessorQuery: lambda state, sender, message: not state.reconcile_in_progress,
    NextInSequenceResponse: lambda state, sender, message: (
        state.phase_two_timer.active
        and sender not in state.reconcile_responders
        and message.chain_hash == state.chain.top_chain_hash
    ),
    RequestForBlock: lambda state, sender, message: (
        not state.reconcile_in_progress and message.block_hash in state.chain
    ),
    BlockResponse: lambda state, sender, message: (
        state.phase_three_timer.active and message.block.block_hash == state.majority_response_block_hash
    ),
}
"""Type of a message -> function of (state, sender, message) that returns true if the message can have an effect."""
