"""Deliberate errors in building and committing blocks (Algorithms 1 to 6)."""

from collections.abc import Callable
from dataclasses import replace

from ucp.block import Block, next_chain_hash
from ucp.chain import Chain
from ucp.core import Core
from ucp.handler import LocalEvent
from ucp.messages import BlockAddRequest, BlockAddResponse, CommitBlock, Message
from ucp.quirks._quirk import Handler, Helper, quirk
from ucp.timers import Timer


@quirk(1, helper=Core.complete)
def oldest_event_timestamp(good: Helper, core: Core, block: Block) -> None:
    """A block has the timestamp of its oldest event, not of its newest event."""
    oldest_us = int.from_bytes(block.event_data[:8], "big")
    good(core, Block(block.agent_id, max(oldest_us, core.newest_block_timestamp_us + 1), block.event_data))


@quirk(1, helper=Core.push_onto_deque)
def lose_completed_block(good: Helper, core: Core, block: Block) -> None:
    """A completed block is not pushed onto the deque."""


@quirk(1, helper=Core.trigger)
def complete_and_wait(good: Helper, core: Core, event: LocalEvent) -> None:
    """A completed block triggers no proposal. The block waits until another event processes the deque."""


@quirk(2)
def propose_during_vote(good: Handler, core: Core) -> str:
    """The agent proposes again while its vote runs."""
    deadline = core.voting_timer.deadline
    core.voting_timer.stop()
    branch = good(core)
    if branch != "proposed":
        core.voting_timer.deadline = deadline
    return branch


@quirk(2)
def propose_while_reconciling(good: Handler, core: Core) -> str:
    """The agent proposes while it reconciles."""
    return run_as_if_not_reconciling(good, core)


@quirk(2)
def propose_back_of_deque(good: Handler, core: Core) -> str:
    """The agent proposes the block at the back of the deque, and then commits the block at the front."""
    core.blocks_to_be_committed.rotate(1)
    branch = good(core)
    core.blocks_to_be_committed.rotate(-1)
    return branch


@quirk(2, helper=Core.send)
def propose_earlier_top(good: Helper, core: Core, message: BlockAddRequest) -> None:
    """A proposal names the chain hash of the block below the top block."""
    chain_hashes = [core.chain.inception.chain_hash, *(chain_hash for _, chain_hash in core.chain.with_chain_hashes())]
    good(core, replace(message, chain_hash=chain_hashes[-2:][0]))


@quirk(2)
def forget_own_vote(good: Handler, core: Core) -> str:
    """The agent does not count its own approval."""
    branch = good(core)
    if branch == "proposed":
        core.vote_count["yes"] -= 1
    return branch


@quirk(2)
def keep_old_votes(good: Handler, core: Core) -> str:
    """A new vote starts with the counts of the previous vote."""
    before = core.vote_count
    branch = good(core)
    if branch == "proposed":
        core.vote_count = {vote: core.vote_count[vote] + count for vote, count in before.items()}
    return branch


@quirk(2, helper=Core.start)
def hasty_vote(good: Helper, core: Core, timer: Timer, duration_s: float) -> None:
    """The voting timer expires after a thousandth of its duration."""
    good(core, timer, duration_s / 1000)


@quirk(3, helper=Core.send)
def approve_everything(good: Helper, core: Core, message: BlockAddResponse) -> None:
    """The agent approves every block."""
    good(core, replace(message, approve=True))


@quirk(3, helper=Core.send)
def disapprove_everything(good: Helper, core: Core, message: BlockAddResponse) -> None:
    """The agent disapproves of every block."""
    good(core, replace(message, approve=False))


@quirk(3)
def vote_while_reconciling(good: Handler, core: Core, sender: int, message: BlockAddRequest) -> str:
    """The agent votes while it reconciles."""
    return run_as_if_not_reconciling(good, core, sender, message)


@quirk(4)
def count_votes_twice(good: Handler, core: Core, sender: int, message: BlockAddResponse) -> str:
    """If a vote arrives twice, both copies count."""
    core.voters.discard(sender)
    return good(core, sender, message)


@quirk(4)
def count_votes_for_others(good: Handler, core: Core, sender: int, message: BlockAddResponse) -> str:
    """The agent counts votes on blocks of other agents as votes on its own block."""
    if core.candidate_block is not None:
        message = replace(message, block_hash=core.candidate_block.block_hash)
    return good(core, sender, message)


@quirk(4)
def count_no_votes(good: Handler, core: Core, sender: int, message: BlockAddResponse) -> str:
    """The agent counts only its own vote."""
    return "no vote running"


@quirk(5)
def tie_is_majority(good: Handler, core: Core) -> str:
    """An equal number of approvals and disapprovals is a majority (>= instead of >)."""
    if core.vote_count["yes"] == core.vote_count["no"]:
        core.vote_count["yes"] += 1
    return good(core)


@quirk(5)
def commit_whatever_the_vote(good: Handler, core: Core) -> str:
    """The agent commits its candidate regardless of the vote."""
    core.vote_count["yes"] += core.vote_count["no"] + 1
    return good(core)


@quirk(5)
def commit_onto_changed_chain(good: Handler, core: Core) -> str:
    """The agent commits its candidate although its chain has changed since the proposal."""
    core.top_chain_hash_at_initiation = core.chain.top_chain_hash
    return good(core)


@quirk(5)
def change_without_new_vote(good: Handler, core: Core) -> str:
    """If the chain changes during a vote, the agent starts no new vote, as in the printed pseudo-code."""
    branch = good(core)
    if branch == "chain changed":
        core.triggered.pop()
    return branch


@quirk(5, helper=Core.trigger)
def disapproved_and_unmoved(good: Helper, core: Core, event: LocalEvent) -> None:
    """The agent starts no reconcile when its block is not approved."""
    if event != "Reconcile Begin":
        good(core, event)


@quirk(5, helper=Core.send)
def hide_commits(good: Helper, core: Core, message: CommitBlock) -> None:
    """The agent commits its approved block and sends no Commit Block."""


@quirk(5)
def lose_disapproved_block(good: Handler, core: Core) -> str:
    """A block that is not approved is removed from the deque."""
    branch = good(core)
    if branch == "not approved":
        core.take_from_deque()
    return branch


@quirk(5, helper=Core.take_from_deque)
def take_two_blocks(good: Callable[..., Block], core: Core) -> Block:
    """A commit removes two blocks from the deque, and commits one of them."""
    block = good(core)
    if core.blocks_to_be_committed:
        good(core)
    return block


@quirk(5, helper=Core.take_from_deque)
def keep_committed_block(good: Callable[..., Block], core: Core) -> Block:
    """A committed block stays in the deque."""
    return core.blocks_to_be_committed[0]


@quirk(5, helper=Core.commit)
def break_off_commit(good: Helper, core: Core, block: Block) -> None:
    """A commit fails because of a wrong file path. The block has left the deque and is not in the chain."""
    raise FileNotFoundError


@quirk(5, helper=Core.send)
def break_off_broadcast(good: Helper, core: Core, message: CommitBlock) -> None:
    """A commit fails because of a wrong file path. The block is in the chain but not sent. The next block is not
    proposed.
    """
    raise FileNotFoundError


@quirk(6, branches=("ignored by quirk",), chance=True)
def ignore_commit(good: Handler, core: Core, sender: int, message: CommitBlock, occurs: Callable[[], bool]) -> str:
    """The agent ignores a Commit Block at random. The value of the quirk is the probability."""
    if not core.reconcile_in_progress and occurs():
        return "ignored by quirk"
    return good(core, sender, message)


@quirk(6)
def commit_without_succession(good: Handler, core: Core, sender: int, message: CommitBlock) -> str:
    """The agent commits blocks of other agents even if they do not follow its top block."""
    succeeding = next_chain_hash(core.chain.top_chain_hash, message.block.block_hash)
    return good(core, sender, replace(message, chain_hash=succeeding))


@quirk(6)
def commit_while_reconciling(good: Handler, core: Core, sender: int, message: CommitBlock) -> str:
    """The agent commits blocks of other agents while it reconciles."""
    return run_as_if_not_reconciling(good, core, sender, message)


@quirk(6, helper=Core.commit)
def commit_others_twice(good: Helper, core: Core, block: Block) -> None:
    """The agent commits a block of another agent twice."""
    commit_twice(good, core, block)


def run_as_if_not_reconciling(good: Handler, core: Core, *inputs: int | Message) -> str:
    """Run the correct handler `good` as if no reconcile were in progress. Restore the flag `reconcile_in_progress`
    afterwards. This is a deliberate mistake.
    """
    reconciling, core.reconcile_in_progress = core.reconcile_in_progress, False
    try:
        return good(core, *inputs)
    finally:
        core.reconcile_in_progress = reconciling


def commit_twice(commit: Helper, core: Core, block: Block) -> None:
    """Commit a block twice, and bypass the check of the chain for duplicates. This is a deliberate mistake."""
    core.chain.__class__ = UnguardedChain
    commit(core, block)
    commit(core, block)


class UnguardedChain(Chain):
    """A chain that accepts the same block twice. This is a deliberate mistake."""

    def append(self, block: Block) -> None:
        self._block_of_hash.pop(block.block_hash, None)
        super().append(block)

    def pop(self) -> Block:
        for top in self._blocks[-1:]:
            self._block_of_hash[top.block_hash] = top
        return super().pop()
