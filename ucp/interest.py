"""Decide which messages can have an effect on an agent, so that a simulation need not deliver the others.

All messages are broadcast, so each of N agents receives the messages of all others. Most of them have no effect: an
answer matters only to agents that asked, and an agent that reconciles answers no message. This module decides it from
the state of an agent, without a handler run. A driver in virtual time may withhold messages without effect. Radios
deliver them, and the handlers then do nothing, as Algorithms 1-20 define.
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
"""A question of an agent: the type of the answers, and their block or chain.

An agent can have two questions at a time: one about its vote (type Block Add Response), and one of its reconcile."""

ONLY_COUNTED = frozenset((BlockAddResponse, ChainContainResponse, NextInSequenceResponse))
"""Answers whose handlers only count (Algorithms 4, 10 and 14). They send no message and change no timer."""

ASKED: dict[type[Message], Callable[[Any, Settings], Question]] = {
    BlockAddRequest: lambda message, settings: (
        BlockAddResponse,
        message.block_hash + message.chain_hash if settings.vote_names_chain else message.block_hash,
    ),
    ChainContainQuery: lambda message, settings: (ChainContainResponse, message.chain_hash),
    ChainHashSuccessorQuery: lambda message, settings: (NextInSequenceResponse, message.chain_hash),
    RequestForBlock: lambda message, settings: (BlockResponse, message.block_hash),
}
"""Message -> the question of its sender from now on. Other messages are no questions."""

ANSWERED: dict[type[Message], Callable[[Any], Question]] = {
    BlockAddResponse: lambda message: (
        BlockAddResponse,
        message.block_hash if message.chain_hash is None else message.block_hash + message.chain_hash,
    ),
    ChainContainResponse: lambda message: (ChainContainResponse, message.chain_hash),
    NextInSequenceResponse: lambda message: (NextInSequenceResponse, message.chain_hash),
    BlockResponse: lambda message: (BlockResponse, message.block.block_hash),
}
"""Message -> the question that it answers. It has no effect on agents without this question."""

STILL_ASKED: dict[type[Message], Callable[[AgentState], bool]] = {
    BlockAddResponse: lambda state: state.voting_timer.active,
    ChainContainResponse: lambda state: state.phase_one_timer.active,
    NextInSequenceResponse: lambda state: state.phase_two_timer.active,
    BlockResponse: lambda state: state.phase_three_timer.active,
}
"""Answer -> function that returns true if the agent still waits for answers of this type."""

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
"""Message -> function of (state, sender, message) that returns true if the message can have an effect."""
