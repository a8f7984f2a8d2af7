"""Build and commit blocks: Algorithms 1-6 (Sections 3.6.1 and 3.6.2).

A full block waits in the deque. The agent proposes it to the vehicles in range, and commits it if more agents approve
than disapprove. Otherwise the chains have diverged, and the agent starts a reconcile.
"""

from ucp.block import LATEST_US, Block, next_chain_hash
from ucp.core import Core
from ucp.events import LoggableEvent
from ucp.handler import event_handler
from ucp.messages import BlockAddRequest, BlockAddResponse, CommitBlock


@event_handler(1, "building", "full", triggers=("Process Next Deque Block",))
def build_data_block(core: Core, event: LoggableEvent) -> str:
    """Algorithm 1, Build Data Block: add an event of the vehicle to the block under construction."""
    core.current_block += event.encode()
    if len(core.current_block) + core.settings.max_event_bytes < core.settings.max_block_bytes:
        return "building"
    # The newest event's timestamp (Section 4.2). A clock that stands still must not make two equal blocks
    # (Section 3.4.2), so a block is at least a microsecond younger than the agent's last, as long as there is time.
    timestamp_us = min(max(event.timestamp_us, core.newest_block_timestamp_us + 1), LATEST_US)
    core.complete(Block(core.agent_id, timestamp_us, core.event_data(timestamp_us)))
    core.current_block.clear()
    core.trigger("Process Next Deque Block")
    return "full"


@event_handler(
    2,
    "reconcile in progress",
    "vote running",
    "deque empty",
    "proposed",
    sends=(BlockAddRequest,),
    starts=("voting",),
    tally="vote_count",
)
def process_next_deque_block(core: Core) -> str:
    """Algorithm 2, Process Next Deque Block: propose the front block of the deque to the neighbours."""
    if core.reconcile_in_progress:
        return "reconcile in progress"
    if core.voting_timer.active:
        return "vote running"
    if not core.blocks_to_be_committed:
        return "deque empty"
    core.vote_count = {"yes": 1, "no": 0}
    core.voters.clear()
    core.top_chain_hash_at_initiation = core.chain.top_chain_hash
    core.candidate_block = core.blocks_to_be_committed[0]
    core.start(core.voting_timer, core.settings.vote_timeout_s)
    core.send(BlockAddRequest(core.candidate_block.block_hash, core.chain.top_chain_hash))
    return "proposed"


@event_handler(3, "reconcile in progress", "approve", "disapprove", sends=(BlockAddResponse,))
def receive_request_add_block(core: Core, sender: int, message: BlockAddRequest) -> str:
    """Algorithm 3, Receive Request Add Block: approve a block if its sender has the same chain as this agent."""
    if core.reconcile_in_progress:
        return "reconcile in progress"
    approve = message.chain_hash == core.chain.top_chain_hash
    named_chain = message.chain_hash if core.settings.vote_names_chain else None
    core.send(BlockAddResponse(message.block_hash, approve, named_chain))
    return "approve" if approve else "disapprove"


@event_handler(
    4, "no vote running", "another block", "another round", "counted already", "yes", "no", tally="vote_count"
)
def receive_vote_add_block(core: Core, sender: int, message: BlockAddResponse) -> str:
    """Algorithm 4, Receive Vote Add Block: count a vote, once per voter and round (Section 4.1)."""
    if not core.voting_timer.active or core.candidate_block is None:
        return "no vote running"
    if message.block_hash != core.candidate_block.block_hash:
        return "another block"
    if core.settings.vote_names_chain and message.chain_hash != core.top_chain_hash_at_initiation:
        return "another round"
    if sender in core.voters:
        return "counted already"
    core.voters.add(sender)
    vote = "yes" if message.approve else "no"
    core.vote_count[vote] += 1
    return vote


@event_handler(
    5,
    "reconcile in progress",
    "chain changed",
    "approved",
    "not approved",
    sends=(CommitBlock,),
    starts=("finalize gap",),
    triggers=("Process Next Deque Block", "Reconcile Begin"),
)
def vote_timer_expiration(core: Core) -> str:
    """Algorithm 5, Vote Timer Expiration: commit the proposed block, vote again, or reconcile.

    The pseudo-code does nothing if the chain changed during an approved vote. According to the text and to Section 4.3,
    the agent votes again. Otherwise it would become idle with a block in its deque. A tied vote is no majority, so the
    agent starts a reconcile. With the setting `asks_after_commit`, Algorithm 20 sends a query some time after the
    commit, to find agents that did not follow it.
    """
    if core.reconcile_in_progress:
        return "reconcile in progress"
    changed = core.chain.top_chain_hash != core.top_chain_hash_at_initiation
    approved = core.vote_count["yes"] > core.vote_count["no"]
    if changed and (approved or core.settings.changed_before_tally):
        core.trigger("Process Next Deque Block")
        return "chain changed"
    if not approved:
        core.trigger("Reconcile Begin")
        return "not approved"
    approved_block = core.take_from_deque()
    core.commit(approved_block)
    core.send(CommitBlock(approved_block, core.chain.top_chain_hash))
    if core.settings.asks_after_commit:
        core.start(core.finalize_timer, core.settings.finalize_gap_s)
    core.trigger("Process Next Deque Block")
    return "approved"


@event_handler(6, "reconcile in progress", "does not succeed", "held already", "committed")
def receive_commit_block(core: Core, sender: int, message: CommitBlock) -> str:
    """Algorithm 6, Receive Commit Block: append another agent's block if it follows this agent's top block.

    In Figure 3.9 a local event also triggers this handler. In this implementation only a message triggers it. An agent
    commits its own blocks directly, because the first test of this handler would refuse them during Reconcile Finalize.
    """
    if core.reconcile_in_progress:
        return "reconcile in progress"
    if message.chain_hash != next_chain_hash(core.chain.top_chain_hash, message.block.block_hash):
        return "does not succeed"
    if core.holds(message.block.block_hash):
        return "held already"  # no correct agent sends this; a second copy would violate characteristic 3
    core.commit(message.block)
    return "committed"
