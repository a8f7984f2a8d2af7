"""Record complete missions in virtual time. Together these missions take every branch of the 20 algorithms. Each
function runs one mission. The name of the function is the name of the transcript, and its docstring is the description.
"""

from collections.abc import Callable

from ucp.block import Block, next_chain_hash
from ucp.contract.vectors._mission_story import AGENT_ID, RecordedMission, chain_of, others_block
from ucp.contract.vectors.drop_vectors import datagram
from ucp.messages import (
    BlockAddRequest,
    BlockAddResponse,
    BlockResponse,
    ChainContainQuery,
    ChainContainResponse,
    ChainHashSuccessorQuery,
    CommitBlock,
    NextInSequenceResponse,
    RequestForBlock,
)

A, B, C = 1, 28, 300
"""The IDs of the other agents on the roster."""
STRANGE = bytes(range(32))
"""The hash of no block and no chain."""


def alone() -> RecordedMission:
    """An agent without neighbours builds two blocks. It proposes and approves one after the other."""
    story = RecordedMission(roster=(AGENT_ID,), epoch_us=1_795_258_278_064_591)
    story.complete_a_block()
    story.complete_a_block()
    story.log(32)
    story.wait()
    story.command("status")
    story.wait(late_s=0.25)
    story.wait_until(story.now + 100.0)
    story.command("status")
    story.command("export")
    return story


def follow() -> RecordedMission:
    """The agent votes on proposals of other agents, follows their commits, and answers their queries."""
    story = RecordedMission()
    first, second, third = others_block(A, 1, at_s=1), others_block(B, 2, at_s=2), others_block(C, 3, at_s=3)
    chain = chain_of()
    inception = chain.top_chain_hash
    story.hear(A, BlockAddRequest(first.block_hash, chain.top_chain_hash))
    story.hear(A, BlockAddRequest(first.block_hash, STRANGE))
    story.hear(B, ChainHashSuccessorQuery(chain.top_chain_hash))
    chain.append(first)
    story.hear(A, CommitBlock(first, chain.top_chain_hash))
    story.hear(A, CommitBlock(first, chain.top_chain_hash))
    story.hear(B, CommitBlock(second, chain.top_chain_hash))
    chain.append(second)
    story.hear(B, CommitBlock(second, chain.top_chain_hash))
    story.hear(C, CommitBlock(third, STRANGE))
    story.hear(A, ChainContainQuery(inception))
    story.hear(A, ChainContainQuery(chain.top_chain_hash))
    story.hear(A, ChainContainQuery(STRANGE))
    story.hear(B, ChainHashSuccessorQuery(inception))
    story.hear(B, ChainHashSuccessorQuery(chain.top_chain_hash))
    story.hear(C, RequestForBlock(first.block_hash))
    story.hear(C, RequestForBlock(second.block_hash))
    story.hear(C, RequestForBlock(STRANGE))
    story.hear(C, RequestForBlock(third.block_hash))
    story.hear(A, CommitBlock(first, chain_of(first, second, first_again(first)).top_chain_hash))
    story.command("export")
    return story


def first_again(block: Block) -> Block:
    """Return a block that differs from this block only by its timestamp, and therefore has another hash."""
    return Block(block.agent_id, block.timestamp_us + 1, block.event_data)


def vote() -> RecordedMission:
    """Votes count once, and only for the candidate. A majority commits the block, and late votes do not count."""
    story = RecordedMission()
    story.hear(A, BlockAddResponse(STRANGE, True))
    story.complete_a_block()
    story.vote((A, True), (A, True), (A, False))
    story.hear(B, BlockAddResponse(STRANGE, True))
    story.hear(B, BlockAddResponse(story.proposed(), False, STRANGE))
    story.vote((C, True))
    story.wait()
    story.vote((C, True))
    story.command("status")
    return story


def tied_vote() -> RecordedMission:
    """A tied vote is not approved. The agent reconciles. All answers contain its chain, and it proposes the block
    again.
    """
    story = RecordedMission()
    story.complete_a_block()
    story.vote((A, False))
    story.wait()
    story.contain((A, True), (A, True), (B, False))
    story.hear(C, ChainContainResponse(STRANGE, False))
    story.wait()
    story.contain((C, False))
    story.name((A, None), (B, None), (B, None))
    story.hear(C, NextInSequenceResponse(STRANGE, STRANGE, 1))
    story.wait()
    story.name((C, None))
    story.hear(C, BlockResponse(others_block(C, 1)))
    story.vote((A, True))
    story.wait()
    story.command("export")
    return story


def chain_changed() -> RecordedMission:
    """A commit changes the chain during a vote.

    The agent votes again without a majority, and reconciles without answers.
    """
    story = RecordedMission()
    first, second = others_block(A, 1), others_block(B, 2)
    chain = chain_of(first)
    story.complete_a_block()
    story.hear(A, CommitBlock(first, chain.top_chain_hash))
    story.vote((B, True))
    story.wait()
    chain.append(second)
    story.vote((A, False))
    story.hear(B, CommitBlock(second, chain.top_chain_hash))
    story.wait()
    story.wait()
    story.wait()
    story.command("status")
    return story


def held_already() -> RecordedMission:
    """Another agent commits the agent's own block on top of its chain.

    No correct agent does this. The agent does not append the block a second time.
    """
    story = RecordedMission()
    story.complete_a_block()
    story.wait()
    own = story.sent[0]
    assert isinstance(own, CommitBlock)
    chain = chain_of(own.block)
    story.hear(A, CommitBlock(own.block, chain_hash_on(chain.top_chain_hash, own.block)))
    story.command("status")
    return story


def chain_hash_on(chain_hash: bytes, block: Block) -> bytes:
    """Return the chain hash of `block` on top of this chain."""
    return next_chain_hash(chain_hash, block.block_hash)


def diverged() -> RecordedMission:
    """A query during a vote shows that the agent's chain has diverged.

    The agent answers no message until it has reconciled.
    """
    story = RecordedMission(vote_timeout_s=10.0, phase1_timeout_s=7.5)
    mine, other = others_block(A, 1), others_block(B, 2)
    story.hear(A, CommitBlock(mine, chain_of(mine).top_chain_hash))
    story.complete_a_block()
    story.hear(B, ChainHashSuccessorQuery(chain_of(other).top_chain_hash), after_s=4.0)
    story.hear(B, ChainHashSuccessorQuery(chain_of(other).top_chain_hash))
    story.hear(B, BlockAddRequest(other.block_hash, chain_of(mine).top_chain_hash))
    story.hear(B, CommitBlock(other, chain_of(mine, other).top_chain_hash))
    story.hear(B, ChainContainQuery(chain_of(mine).top_chain_hash))
    story.hear(B, RequestForBlock(mine.block_hash))
    story.vote((C, True))
    story.command("reconcile")
    story.complete_a_block()
    story.contain((A, True), (C, True))
    story.wait()
    story.wait()
    story.wait()
    story.vote((A, True))
    story.wait()
    story.wait()
    story.command("export")
    return story


def outvoted() -> RecordedMission:
    """Three blocks are popped in a reconcile.

    Phase 3 requests one block of the majority's chain, and takes one from the stack. Finalize commits the rest of the
    stack.
    """
    story = RecordedMission()
    mutual, theirs, last = others_block(A, 1), others_block(B, 2), others_block(C, 3)
    chain = chain_of(mutual)
    story.hear(A, CommitBlock(mutual, chain.top_chain_hash))
    own: list[Block] = []
    for _ in range(3):
        story.complete_a_block()
        story.wait()
        committed = story.sent[0]
        assert isinstance(committed, CommitBlock)
        own.append(committed.block)
    story.command("reconcile")
    for _ in range(3):
        story.contain((A, False), (B, False), (C, True))
        story.wait()
    story.contain((A, True), (B, True))
    story.wait()
    story.name((A, theirs), (B, theirs), (C, own[1]))
    story.wait()
    story.hear(A, BlockResponse(last))
    story.hear(B, BlockResponse(theirs))
    story.hear(A, BlockResponse(theirs))
    story.name((A, own[1]), (B, own[1]), (C, last))
    story.wait()
    story.name((A, None), (B, None))
    story.wait()
    story.command("status", after_s=0.0625)
    story.hear(A, ChainContainQuery(chain.top_chain_hash), after_s=0.015625)
    story.wait()
    story.command("export")
    return story


def no_gap() -> RecordedMission:
    """Without a finalize gap, finalize commits the whole stack in one handler run."""
    story = RecordedMission(finalize_gap_s=0)
    for ordinal in range(1, 4):
        blocks = [others_block(A, number) for number in range(1, ordinal + 1)]
        story.hear(A, CommitBlock(blocks[-1], chain_of(*blocks).top_chain_hash))
    story.command("reconcile")
    for _ in range(3):
        story.contain((B, False))
        story.wait()
    story.wait()
    story.command("status")
    return story


def nobody() -> RecordedMission:
    """No agent answers in phase 1. In later reconciles, no agent answers in phase 2, and then in phase 3."""
    story = RecordedMission()
    theirs = others_block(B, 2)
    story.command("reconcile")
    story.wait()
    for answers in ((), ((A, theirs),)):
        story.command("reconcile")
        story.contain((A, True))
        story.wait()
        story.name(*answers)
        story.wait()
    story.wait()
    story.hear(A, BlockResponse(theirs))
    story.command("status")
    return story


def at_inception() -> RecordedMission:
    """All agents answer that their chains do not contain the inception block. The agent never pops it."""
    story = RecordedMission()
    story.command("reconcile")
    story.contain((A, False), (B, False))
    story.wait()
    story.command("status")
    return story


def ties() -> RecordedMission:
    """After a tie in phase 1, phase 2 follows. After a tie in phase 2, the agent selects the oldest block, and among
    equally old blocks the one with the lowest hash."""
    story = RecordedMission()
    old, young, top = others_block(B, 1, at_s=10), others_block(C, 2, at_s=20), others_block(A, 3, at_s=15)
    story.hear(A, CommitBlock(top, chain_of(top).top_chain_hash))
    story.command("reconcile")
    story.contain((A, True), (B, False))
    story.wait()
    story.name((A, young), (B, old))
    story.wait()
    story.hear(B, BlockResponse(old))
    story.name((A, young), (B, None), top_us=10_000_001)
    story.wait()
    same = [Block(C, 30_000_000, bytes([number])) for number in range(4)]
    lowest = min(same, key=lambda block: block.block_hash)
    story.command("reconcile", after_s=5.0)
    story.contain((A, True))
    story.wait()
    story.name(*zip((A, B, C), same, strict=False))
    story.wait()
    story.hear(A, BlockResponse(min(same[:3], key=lambda block: block.block_hash)))
    story.name((A, lowest), (B, None), top_us=30_000_000)
    story.wait()
    story.command("export")
    return story


def ties_read_otherwise() -> RecordedMission:
    """The missions use the settings `phase1_tie` pop and `phase2_tie` block."""
    story = RecordedMission(phase1_tie="pop", phase2_tie="block")
    first, second = others_block(A, 1, at_s=1), others_block(B, 2, at_s=2)
    story.hear(A, CommitBlock(first, chain_of(first).top_chain_hash))
    story.command("reconcile")
    story.contain((A, True), (B, False))
    story.wait()
    story.contain((A, True), (B, False), (C, True))
    story.wait()
    story.name((A, None), (B, second))
    story.wait()
    story.hear(B, BlockResponse(second))
    story.name((A, None), (B, first), (C, None))
    story.wait()
    story.command("export")
    return story


def asks_after_commit() -> RecordedMission:
    """The mission uses the setting `asks_after_commit`. After a commit and a gap, the agent sends a query unless it
    reconciles.
    """
    story = RecordedMission(asks_after_commit=True)
    story.complete_a_block()
    story.vote((A, True))
    story.wait()
    story.wait()
    story.complete_a_block()
    story.vote((A, True))
    story.wait()
    story.hear(B, ChainHashSuccessorQuery(STRANGE))
    story.wait()
    return story


def answer_spread() -> RecordedMission:
    """The mission uses the setting `answer_spread_s`. Each answer waits for its own time. All other messages are sent
    immediately.
    """
    story = RecordedMission(answer_spread_s=2.0)
    block = others_block(A, 1, at_s=1)
    chain = chain_of(block)
    story.hear(A, BlockAddRequest(block.block_hash, chain_of().top_chain_hash))
    story.hear(B, ChainHashSuccessorQuery(chain_of().top_chain_hash))
    story.hear(A, CommitBlock(block, chain.top_chain_hash))
    story.hear(C, RequestForBlock(block.block_hash))
    story.hear(B, ChainContainQuery(chain.top_chain_hash))
    while story.timer is not None:
        story.wait()
    story.hear(B, ChainContainQuery(STRANGE))
    story.complete_a_block()
    story.vote((A, True))
    story.wait()
    story.command("export")
    return story


def top_needs_majority() -> RecordedMission:
    """The mission uses the setting `top_needs_majority`. "Is Top Of Chain" ends the search only if a vote would be
    approved.
    """
    story = RecordedMission(top_needs_majority=True)
    old, young = others_block(B, 1, at_s=10), others_block(C, 2, at_s=20)
    story.command("reconcile")
    story.contain((A, True))
    story.wait()
    story.name((A, None), (B, old), (C, young))
    story.wait()
    story.hear(B, BlockResponse(old))
    story.name((A, None), (B, None), (C, young), top_us=10_000_000)
    story.wait()
    story.command("export")
    return story


def votes_name_chains() -> RecordedMission:
    """The mission uses the settings `vote_names_chain` and `changed_before_tally`."""
    story = RecordedMission(vote_names_chain=True, changed_before_tally=True)
    first = others_block(A, 1)
    inception = chain_of().top_chain_hash
    story.hear(A, BlockAddRequest(first.block_hash, inception))
    story.hear(A, BlockAddRequest(first.block_hash, STRANGE))
    story.complete_a_block()
    proposed = story.proposed()
    story.hear(A, BlockAddResponse(proposed, True))
    story.hear(A, BlockAddResponse(proposed, True, STRANGE))
    story.hear(A, BlockAddResponse(proposed, False, inception))
    story.hear(B, BlockAddResponse(proposed, False, inception))
    story.hear(A, CommitBlock(first, chain_of(first).top_chain_hash))
    story.wait()
    story.hear(C, BlockAddResponse(proposed, True, inception))
    story.hear(C, BlockAddResponse(proposed, True, chain_of(first).top_chain_hash))
    story.wait()
    return story


def offered_what_it_holds() -> RecordedMission:
    """The majority names a block that is in the agent's deque, and later a block that is in its chain."""
    story = RecordedMission()
    first = others_block(A, 1)
    story.hear(A, CommitBlock(first, chain_of(first).top_chain_hash))
    story.complete_a_block()
    proposed = story.proposed()
    story.vote((A, False))
    story.wait()
    for block_hash in (proposed, first.block_hash):
        if block_hash == first.block_hash:
            story.wait()
            story.command("reconcile")
        story.contain((A, True))
        story.wait()
        chain_hash = next(message for message in story.sent if isinstance(message, ChainHashSuccessorQuery)).chain_hash
        story.hear(A, NextInSequenceResponse(chain_hash, block_hash, 1))
        story.wait()
    story.command("status")
    return story


def reboot() -> RecordedMission:
    """A power failure interrupts a reconcile.

    After the reboot, the agent commits the stack again and proposes the front of the deque again.
    """
    story = RecordedMission()
    blocks = [others_block(A, ordinal) for ordinal in range(1, 4)]
    for ordinal in range(1, 4):
        story.hear(A, CommitBlock(blocks[ordinal - 1], chain_of(*blocks[:ordinal]).top_chain_hash))
    story.complete_a_block()
    story.wait()
    story.complete_a_block()
    story.log(64)
    story.vote((A, False))
    story.wait()
    for _ in range(3):
        story.contain((A, False))
        story.wait()
    story.reboot()
    story.command("status", after_s=0.03125)
    story.wait()
    story.wait()
    story.vote((A, True))
    story.wait()
    story.complete_a_block()
    story.command("export")
    story.reboot()
    story.command("status")
    return story


def late_timers() -> RecordedMission:
    """The clock begins below 0. Two timers expire before the agent runs again. Datagrams are dropped in between."""
    story = RecordedMission(at_s=-3.5)
    story.hear_datagram(b"", after_s=0.0)
    story.log(256, after_s=4.0)
    story.log()
    story.log()
    story.hear_datagram(datagram(1, STRANGE * 2, sender=AGENT_ID))
    story.hear_datagram(datagram(1, STRANGE * 2, sender=5))
    story.hear_datagram(datagram(2, b"\x02" + STRANGE))
    story.hear(A, ChainHashSuccessorQuery(STRANGE))
    story.wait_until(story.now)
    story.wait_until(story.now + 25.0)
    story.wait_until(story.now + 25.0)
    story.command("stop_events")
    story.log()
    story.command("export")
    return story


def secured() -> RecordedMission:
    """The mission has keys and seals events. Replayed datagrams and a revoked sender are dropped. The agent reboots.

    After the reboot, the agent accepts no datagrams of other agents until they answer its challenge.
    """
    from ucp.contract.vectors._secured_story import SecuredStory  # needs the extra `secure`

    story = SecuredStory()
    first = others_block(A, 1, at_s=1)
    chain = story.chain()
    story.hear(A, BlockAddRequest(first.block_hash, chain.top_chain_hash))
    story.hear_again()
    chain.append(first)
    story.hear(A, CommitBlock(first, chain.top_chain_hash))
    story.complete_a_block()
    story.vote((A, True), (B, True))
    story.wait()
    story.hear(B, ChainHashSuccessorQuery(chain.top_chain_hash))
    story.revoke(C)
    story.hear(C, ChainContainQuery(chain.top_chain_hash))
    story.hear(A, ChainContainQuery(chain.top_chain_hash))
    story.hear_datagram(b"UC\1 in plain")
    story.command("status")
    story.command("export")
    story.complete_a_block()
    story.reboot(down_s=900.0)
    story.echo(A, B)
    story.hear(C, ChainContainQuery(chain.top_chain_hash))
    story.hear(B, RequestForBlock(first.block_hash))
    story.wait_until(story.now + 2.0)
    story.hear(B, RequestForBlock(first.block_hash))
    story.wait()
    story.command("export")
    return story


MISSIONS: dict[str, Callable[[], RecordedMission]] = {
    mission.__name__: mission
    for mission in (
        alone,
        follow,
        vote,
        tied_vote,
        chain_changed,
        held_already,
        diverged,
        outvoted,
        no_gap,
        nobody,
        at_inception,
        ties,
        ties_read_otherwise,
        asks_after_commit,
        answer_spread,
        top_needs_majority,
        votes_name_chains,
        offered_what_it_holds,
        reboot,
        late_timers,
        secured,
    )
}
"""Name of a transcript -> function that plays its mission."""
