"""Building and committing blocks: Algorithms 1-6 (Sections 3.6.1 and 3.6.2).

A full block waits in the deque, is proposed to the local UVS, and is committed if more agents approve than disapprove.
Anything else means that chains have parted, and starts a reconcile.
"""

from typing import TYPE_CHECKING

from ucp import reconcile
from ucp.block import Block, next_chain_hash
from ucp.events import LoggableEvent
from ucp.handler import event_handler
from ucp.messages import BlockAddRequest, BlockAddResponse, CommitBlock

if TYPE_CHECKING:
    from ucp.agent import Agent


@event_handler(1, "building", "full")
def build_data_block(agent: "Agent", event: LoggableEvent) -> str:
    """Algorithm 1, Build Data Block: the vehicle logged an event."""
    agent.current_block += event.encode()
    if len(agent.current_block) + agent.settings.max_event_bytes < agent.settings.max_block_bytes:
        return "building"
    # The newest event's timestamp (Section 4.2). A clock that stands still must not make two equal blocks
    # (Section 3.4.2), so a block is at least a microsecond younger than the agent's last.
    timestamp_us = max(event.timestamp_us, agent.newest_block_timestamp_us + 1)
    agent.complete(Block(agent.agent_id, timestamp_us, bytes(agent.current_block)))
    agent.current_block.clear()
    agent.trigger(process_next_deque_block)
    return "full"


@event_handler(2, "reconcile in progress", "vote running", "deque empty", "proposed")
def process_next_deque_block(agent: "Agent") -> str:
    """Algorithm 2, Process Next Deque Block: propose the front of the deque to the local UVS."""
    if agent.reconcile_in_progress:
        return "reconcile in progress"
    if agent.voting_timer.active:
        return "vote running"
    if not agent.blocks_to_be_committed:
        return "deque empty"
    agent.vote_count = {"yes": 1, "no": 0}
    agent.voters.clear()
    agent.top_chain_hash_at_initiation = agent.chain.top_chain_hash
    agent.candidate_block = agent.blocks_to_be_committed[0]
    agent.voting_timer.start(agent.now, agent.settings.vote_timeout_s)
    agent.send(BlockAddRequest(agent.candidate_block.block_hash, agent.chain.top_chain_hash))
    return "proposed"


@event_handler(3, "reconcile in progress", "approve", "disapprove")
def receive_request_add_block(agent: "Agent", sender: int, message: BlockAddRequest) -> str:
    """Algorithm 3, Receive Request Add Block: approve a block that goes on top of the same chain as ours."""
    if agent.reconcile_in_progress:
        return "reconcile in progress"
    approve = message.chain_hash == agent.chain.top_chain_hash
    named_chain = message.chain_hash if agent.settings.vote_names_chain else None
    agent.send(BlockAddResponse(message.block_hash, approve, named_chain))
    return "approve" if approve else "disapprove"


@event_handler(4, "no vote running", "another block", "another round", "counted already", "yes", "no")
def receive_vote_add_block(agent: "Agent", sender: int, message: BlockAddResponse) -> str:
    """Algorithm 4, Receive Vote Add Block: tally a vote, once per responder and round (Section 4.1)."""
    if not agent.voting_timer.active or agent.candidate_block is None:
        return "no vote running"
    if message.block_hash != agent.candidate_block.block_hash:
        return "another block"
    if agent.settings.vote_names_chain and message.chain_hash != agent.top_chain_hash_at_initiation:
        return "another round"
    if sender in agent.voters:
        return "counted already"
    agent.voters.add(sender)
    vote = "yes" if message.approve else "no"
    agent.vote_count[vote] += 1
    return vote


@event_handler(5, "reconcile in progress", "chain changed", "approved", "not approved")
def vote_timer_expiration(agent: "Agent") -> str:
    """Algorithm 5, Vote Timer Expiration: commit the candidate, vote again, or reconcile.

    The pseudo-code does nothing when the chain changed during an approved vote; the prose and Section 4.3 vote again,
    without which an agent would go idle with a block in its deque. A tie is not a majority: reconcile.
    """
    if agent.reconcile_in_progress:
        return "reconcile in progress"
    changed = agent.chain.top_chain_hash != agent.top_chain_hash_at_initiation
    approved = agent.vote_count["yes"] > agent.vote_count["no"]
    if changed and (approved or agent.settings.changed_before_tally):
        agent.trigger(process_next_deque_block)
        return "chain changed"
    if not approved:
        agent.trigger(reconcile.reconcile_begin)
        return "not approved"
    approved_block = agent.take_from_deque()
    agent.commit(approved_block)
    agent.send(CommitBlock(approved_block, agent.chain.top_chain_hash))
    agent.trigger(process_next_deque_block)
    return "approved"


@event_handler(6, "reconcile in progress", "ignored by quirk", "does not succeed", "held already", "committed")
def receive_commit_block(agent: "Agent", sender: int, message: CommitBlock) -> str:
    """Algorithm 6, Receive Commit Block: another agent committed a block; follow if it succeeds our top.

    Figure 3.9 says that this handler is also triggered locally. It is not: local commits happen in line, because
    during Reconcile Finalize its own first test would refuse them.
    """
    if agent.reconcile_in_progress:
        return "reconcile in progress"
    if agent.quirk_strikes(agent.quirks.ignore_commit):
        return "ignored by quirk"
    if message.chain_hash != next_chain_hash(agent.chain.top_chain_hash, message.block.block_hash):
        return "does not succeed"
    if agent.holds(message.block.block_hash):
        return "held already"  # no agent in good faith sends this; a second copy would break characteristic 3
    agent.commit(message.block)
    return "committed"
