"""To whom a message can matter.

Everything is broadcast, so N agents hear N times what each of them says, and nearly all of it changes nothing: an
answer is for the agents that asked, and whoever reconciles answers nobody. This tells so from an agent's state, without
running a handler. A driver in virtual time need not deliver what does not matter. Radios deliver it all the same, and
the handlers then do nothing, as Algorithms 1-20 say.
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
"""What an agent wants to hear: answers of this type about this block or chain, or both.

It can have two questions at a time: one about its vote (of type Block Add Response), and one of its reconcile."""

ONLY_COUNTED = frozenset((BlockAddResponse, ChainContainResponse, NextInSequenceResponse))
"""Answers whose handlers only tally (Algorithms 4, 10 and 14): they send nothing and touch no timer."""

ASKED: dict[type[Message], Callable[[Any, Settings], Question]] = {
    BlockAddRequest: lambda message, settings: (
        BlockAddResponse,
        message.block_hash + message.chain_hash if settings.vote_names_chain else message.block_hash,
    ),
    ChainContainQuery: lambda message, settings: (ChainContainResponse, message.chain_hash),
    ChainHashSuccessorQuery: lambda message, settings: (NextInSequenceResponse, message.chain_hash),
    RequestForBlock: lambda message, settings: (BlockResponse, message.block_hash),
}
"""Message -> what its sender wants to hear from now on; other messages ask nothing."""

ANSWERED: dict[type[Message], Callable[[Any], Question]] = {
    BlockAddResponse: lambda message: (
        BlockAddResponse,
        message.block_hash if message.chain_hash is None else message.block_hash + message.chain_hash,
    ),
    ChainContainResponse: lambda message: (ChainContainResponse, message.chain_hash),
    NextInSequenceResponse: lambda message: (NextInSequenceResponse, message.chain_hash),
    BlockResponse: lambda message: (BlockResponse, message.block.block_hash),
}
"""Message -> the question that it answers, so that it is nothing to those who have not asked it."""

STILL_ASKED: dict[type[Message], Callable[[AgentState], bool]] = {
    BlockAddResponse: lambda state: state.voting_timer.active,
    ChainContainResponse: lambda state: state.phase_one_timer.active,
    NextInSequenceResponse: lambda state: state.phase_two_timer.active,
    BlockResponse: lambda state: state.phase_three_timer.active,
}
"""Answer -> whether the agent still waits for any of its type."""

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
"""(state of an agent, sender, message) -> whether the handler could change the agent, or make it send anything."""
