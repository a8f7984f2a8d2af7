"""Bringing a chain back into agreement with the local UVS: Algorithms 7-20 (Section 3.6.3).

Phase 1 pops blocks onto the reconcile stack until the majority contains what is left. Phases 2 and 3 ask, block by
block, what the majority has on top of that, and commit it. Finalize puts the rest of the stack back on top, telling
everybody. While `reconcile_in_progress` is set the agent answers nobody.
"""

from typing import TYPE_CHECKING

from ucp import commit
from ucp.handler import event_handler
from ucp.messages import (
    BlockResponse,
    ChainContainQuery,
    ChainContainResponse,
    ChainHashSuccessorQuery,
    CommitBlock,
    NextInSequenceResponse,
    RequestForBlock,
)

if TYPE_CHECKING:
    from ucp.agent import Agent

IS_TOP_OF_CHAIN = b""
"""The reserved candidate "Is Top Of Chain" in the dictionary of phase 2; sorts before every block hash."""


@event_handler(7, "already in progress", "begun")
def reconcile_begin(agent: "Agent") -> str:
    """Algorithm 7, Reconcile Begin."""
    if agent.reconcile_in_progress:
        return "already in progress"
    agent.reconcile_in_progress = True
    agent.reconciles += 1
    agent.trigger(reconcile_phase_1)
    return "begun"


@event_handler(8, "asked")
def reconcile_phase_1(agent: "Agent") -> str:
    """Algorithm 8, Reconcile Phase 1: ask who contains our top chain hash."""
    agent.reconcile_vote_count = {"yes": 0, "no": 0}
    agent.reconcile_responders.clear()
    agent.send(ChainContainQuery(agent.chain.top_chain_hash))
    agent.phase_one_timer.start(agent.now, agent.settings.phase1_timeout_s)
    return "asked"


@event_handler(9, "reconcile in progress", "yes", "no")
def receive_request_chain_contain(agent: "Agent", sender: int, message: ChainContainQuery) -> str:
    """Algorithm 9, Receive Request Chain Contain (the text before it calls it Algorithm 10, Figure 3.13)."""
    if agent.reconcile_in_progress:
        return "reconcile in progress"
    contained = agent.chain.contains_chain_hash(message.chain_hash)
    agent.send(ChainContainResponse(message.chain_hash, contained))
    return "yes" if contained else "no"


@event_handler(10, "not in phase 1", "another chain", "counted already", "yes", "no")
def receive_phase_1_response(agent: "Agent", sender: int, message: ChainContainResponse) -> str:
    """Algorithm 10, Receive Phase 1 Response: tally, once per responder and query (Section 4.1)."""
    if not agent.phase_one_timer.active:
        return "not in phase 1"
    if message.chain_hash != agent.chain.top_chain_hash:
        return "another chain"
    if sender in agent.reconcile_responders:
        return "counted already"
    agent.reconcile_responders.add(sender)
    vote = "yes" if message.contained else "no"
    agent.reconcile_vote_count[vote] += 1
    return vote


@event_handler(11, "no response", "not contained", "at inception", "contained")
def reconcile_phase_1_timer_expiration(agent: "Agent") -> str:
    """Algorithm 11, Reconcile Phase 1 Timer Expiration: pop a block, or go on to phase 2.

    A tie goes to phase 2 as printed (`<`), unless the setting `phase1_tie` says "pop".
    """
    yes, no = agent.reconcile_vote_count["yes"], agent.reconcile_vote_count["no"]
    if yes + no == 0:
        agent.trigger(reconcile_finalize)
        return "no response"
    if yes < no or (yes == no and agent.settings.phase1_tie == "pop"):
        if not len(agent.chain):
            agent.trigger(reconcile_finalize)  # everybody has the inception block: a "no" to it is a stranger's
            return "at inception"
        agent.pop_to_stack()
        agent.trigger(reconcile_phase_1)
        return "not contained"
    agent.trigger(reconcile_phase_2)
    return "contained"


@event_handler(12, "asked")
def reconcile_phase_2(agent: "Agent") -> str:
    """Algorithm 12, Reconcile Phase 2: ask which block follows the mutual block."""
    agent.reconcile_response_dictionary.clear()
    agent.reconcile_responders.clear()
    agent.phase_two_timer.start(agent.now, agent.settings.phase2_timeout_s)
    agent.send(ChainHashSuccessorQuery(agent.chain.top_chain_hash))
    return "asked"


@event_handler(13, "reconcile in progress", "top of chain", "successor", "diverged")
def receive_request_next_in_sequence(agent: "Agent", sender: int, message: ChainHashSuccessorQuery) -> str:
    """Algorithm 13, Receive Request Next in Sequence: name our successor, or find that our chain has diverged.

    The reconcile may begin while our own vote runs: the voting timer runs on, and Algorithm 5 then does nothing.
    """
    if agent.reconcile_in_progress:
        return "reconcile in progress"
    if not agent.chain.contains_chain_hash(message.chain_hash):
        agent.trigger(reconcile_begin)
        return "diverged"
    next_block = agent.chain.successor(message.chain_hash)
    if next_block is None:
        agent.send(NextInSequenceResponse(message.chain_hash, None, agent.chain.top_timestamp_us))
        return "top of chain"
    agent.send(NextInSequenceResponse(message.chain_hash, next_block.block_hash, next_block.timestamp_us))
    return "successor"


@event_handler(14, "not in phase 2", "another chain", "counted already", "new candidate", "counted")
def receive_response_next_in_sequence(agent: "Agent", sender: int, message: NextInSequenceResponse) -> str:
    """Algorithm 14, Receive Response Next in Sequence: one dictionary of candidate -> [count, timestamp]."""
    if not agent.phase_two_timer.active:
        return "not in phase 2"
    if message.chain_hash != agent.chain.top_chain_hash:
        return "another chain"
    if sender in agent.reconcile_responders:
        return "counted already"
    agent.reconcile_responders.add(sender)
    candidate = IS_TOP_OF_CHAIN if message.block_hash is None else message.block_hash
    counter_record = agent.reconcile_response_dictionary.get(candidate)
    if counter_record is None:
        agent.reconcile_response_dictionary[candidate] = [1, message.timestamp_us]
        return "new candidate"
    counter_record[0] += 1
    return "counted"


@event_handler(
    15,
    "no response",
    "top of chain",
    "block",
    "tie: top of chain",
    "tie: block",
    "tie: crashed by quirk",
)
def reconcile_phase_2_timer_expiration(agent: "Agent") -> str:
    """Algorithm 15, Reconcile Phase 2 Timer Expiration: choose the plurality's answer.

    A tie goes to the oldest timestamp, equal timestamps to the lowest hash. With the setting `phase2_tie` "block", a
    tie never ends the search while a block is on offer.
    """
    candidates = agent.reconcile_response_dictionary
    if not candidates:
        agent.trigger(reconcile_finalize)
        return "no response"
    most = max(count for count, _ in candidates.values())
    tied = [candidate for candidate, (count, _) in candidates.items() if count == most]
    tie = "tie: " if len(tied) > 1 else ""
    if tie and agent.quirks.crash_on_tie:
        return "tie: crashed by quirk"
    if tie and agent.settings.phase2_tie == "block":
        tied = [candidate for candidate in tied if candidate != IS_TOP_OF_CHAIN]
    majority_response = min(tied, key=lambda candidate: (candidates[candidate][1], candidate))
    if majority_response == IS_TOP_OF_CHAIN:
        agent.trigger(reconcile_finalize)
        return tie + "top of chain"
    agent.majority_response_block_hash = majority_response
    agent.trigger(reconcile_phase_3)
    return tie + "block"


@event_handler(16, "from the stack", "held already", "asked")
def reconcile_phase_3(agent: "Agent") -> str:
    """Algorithm 16, Reconcile Phase 3: take the block from the reconcile stack, or ask for it.

    The pseudo-code stops after a block from the stack; Section 3.5.3 step 4 continues with phase 2, without which the
    reconcile would never end.
    """
    block_hash = agent.majority_response_block_hash
    assert block_hash is not None, "phase 3 is triggered with a majority response"
    block = agent.remove_from_stack(block_hash)
    if block is not None:
        agent.commit(block)
        agent.majority_response_block_hash = None
        agent.trigger(reconcile_phase_2)
        return "from the stack"
    if agent.holds(block_hash):
        agent.majority_response_block_hash = None
        agent.trigger(reconcile_finalize)  # no chain in good faith offers it: a second copy is never committed
        return "held already"
    timeout_s = 0.0 if agent.quirks.early_phase3_expiry else agent.settings.phase3_timeout_s
    agent.phase_three_timer.start(agent.now, timeout_s)
    agent.send(RequestForBlock(block_hash))
    return "asked"


@event_handler(17, "reconcile in progress", "sent", "not held")
def receive_request_block_for_hash(agent: "Agent", sender: int, message: RequestForBlock) -> str:
    """Algorithm 17, Receive Request Block for Hash: send the block if our chain has it."""
    if agent.reconcile_in_progress:
        return "reconcile in progress"
    block = agent.chain.get(message.block_hash)
    if block is None:
        return "not held"
    agent.send(BlockResponse(block))
    return "sent"


@event_handler(18, "not in phase 3", "another block", "committed")
def receive_response_block_for_hash(agent: "Agent", sender: int, message: BlockResponse) -> str:
    """Algorithm 18, Receive Response Block for Hash: commit the block that was asked for.

    The thesis pauses the timer while it looks; a handler is atomic here, so the pause costs nothing and changes
    nothing. `Agent.commit` computes the chain hash anew, which the field test forgot, as the quirk does.
    """
    if not agent.phase_three_timer.active:
        return "not in phase 3"
    agent.phase_three_timer.pause(agent.now)
    if message.block.block_hash != agent.majority_response_block_hash:
        agent.phase_three_timer.resume(agent.now)
        return "another block"
    agent.phase_three_timer.stop()
    chain_hash_before = agent.chain.top_chain_hash
    agent.commit(message.block)
    if agent.quirks.stale_chain_hash:
        agent.chain.top_chain_hash = chain_hash_before
    agent.majority_response_block_hash = None
    agent.trigger(reconcile_phase_2)
    return "committed"


@event_handler(19, "gave up")
def reconcile_phase_3_timer_expiration(agent: "Agent") -> str:
    """Algorithm 19, Reconcile Phase 3 Timer Expiration: no block came; keep what was rebuilt."""
    agent.majority_response_block_hash = None
    agent.trigger(reconcile_finalize)
    return "gave up"


@event_handler(20, "recommitted, more to come", "done")
def reconcile_finalize(agent: "Agent") -> str:
    """Algorithm 20, Reconcile Finalize: put the reconcile stack back on top of the chain, telling everybody.

    Section 4.2 pauses between commits so that others can follow: the handler runs once more when `finalize_gap_s` is
    over, and the flag stays set meanwhile.
    """
    while agent.reconcile_stack:
        block = agent.pop_from_stack()
        agent.commit(block)
        agent.send(CommitBlock(block, agent.chain.top_chain_hash))
        if agent.reconcile_stack and agent.settings.finalize_gap_s > 0:
            agent.finalize_timer.start(agent.now, agent.settings.finalize_gap_s)
            return "recommitted, more to come"
    agent.reconcile_in_progress = False
    agent.trigger(commit.process_next_deque_block)
    return "done"
