"""Reconcile a chain with those of the neighbours: Algorithms 7-20 (Section 3.6.3).

Phase 1 pops blocks onto the reconcile stack until the chains of the majority of the answering agents contain all
remaining blocks. Phases 2 and 3 ask for the successors in the majority's chain, block by block, and commit them.
Finalize commits the rest of the stack again, and broadcasts each block. While `reconcile_in_progress` is set, the agent
answers no message.
"""

from collections.abc import Mapping, Sequence

from ucp.core import Core
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

IS_TOP_OF_CHAIN = b""
"""The candidate of phase 2 that stands for the reserved answer "Is Top Of Chain". It sorts before every block hash."""


@event_handler(7, "already in progress", "begun", triggers=("Reconcile Phase 1",))
def reconcile_begin(core: Core) -> str:
    """Algorithm 7, Reconcile Begin: start a reconcile, unless one is already in progress."""
    if core.reconcile_in_progress:
        return "already in progress"
    core.reconcile_in_progress = True
    if core.settings.asks_after_commit:
        core.finalize_timer.stop()  # phase 2 asks the same
    core.reconciles += 1
    core.trigger("Reconcile Phase 1")
    return "begun"


@event_handler(8, "asked", sends=(ChainContainQuery,), starts=("phase one",), tally="reconcile_vote_count")
def reconcile_phase_1(core: Core) -> str:
    """Algorithm 8, Reconcile Phase 1: ask which neighbours' chains contain this agent's top chain hash."""
    core.reconcile_vote_count = {"yes": 0, "no": 0}
    core.reconcile_responders.clear()
    core.send(ChainContainQuery(core.chain.top_chain_hash))
    core.start(core.phase_one_timer, core.settings.phase1_timeout_s)
    return "asked"


@event_handler(9, "reconcile in progress", "yes", "no", sends=(ChainContainResponse,))
def receive_request_chain_contain(core: Core, sender: int, message: ChainContainQuery) -> str:
    """Algorithm 9, Receive Request Chain Contain: answer a query. The thesis calls the algorithm 10 in the text before
    it (Figure 3.13).
    """
    if core.reconcile_in_progress:
        return "reconcile in progress"
    contained = core.chain.contains_chain_hash(message.chain_hash)
    core.send(ChainContainResponse(message.chain_hash, contained))
    return "yes" if contained else "no"


@event_handler(10, "not in phase 1", "another chain", "counted already", "yes", "no", tally="reconcile_vote_count")
def receive_phase_1_response(core: Core, sender: int, message: ChainContainResponse) -> str:
    """Algorithm 10, Receive Phase 1 Response: count an answer, once per agent and query (Section 4.1)."""
    if not core.phase_one_timer.active:
        return "not in phase 1"
    if message.chain_hash != core.chain.top_chain_hash:
        return "another chain"
    if sender in core.reconcile_responders:
        return "counted already"
    core.reconcile_responders.add(sender)
    vote = "yes" if message.contained else "no"
    core.reconcile_vote_count[vote] += 1
    return vote


@event_handler(
    11,
    "no response",
    "not contained",
    "at inception",
    "contained",
    triggers=("Reconcile Phase 1", "Reconcile Phase 2", "Reconcile Finalize"),
)
def reconcile_phase_1_timer_expiration(core: Core) -> str:
    """Algorithm 11, Reconcile Phase 1 Timer Expiration: pop a block, or go on to phase 2.

    A tie continues with phase 2, as in the printed pseudo-code (`<`), unless the setting `phase1_tie` is "pop".
    """
    yes, no = core.reconcile_vote_count["yes"], core.reconcile_vote_count["no"]
    if yes + no == 0:
        core.trigger("Reconcile Finalize")
        return "no response"
    if yes < no or (yes == no and core.settings.phase1_tie == "pop"):
        if not len(core.chain):
            core.trigger("Reconcile Finalize")  # all agents have the inception block: a "no" is invalid
            return "at inception"
        core.pop_to_stack()
        core.trigger("Reconcile Phase 1")
        return "not contained"
    core.trigger("Reconcile Phase 2")
    return "contained"


@event_handler(
    12, "asked", sends=(ChainHashSuccessorQuery,), starts=("phase two",), tally="reconcile_response_dictionary"
)
def reconcile_phase_2(core: Core) -> str:
    """Algorithm 12, Reconcile Phase 2: ask which block follows the top block of this agent's shortened chain."""
    core.reconcile_response_dictionary.clear()
    core.reconcile_responders.clear()
    core.start(core.phase_two_timer, core.settings.phase2_timeout_s)
    core.send(ChainHashSuccessorQuery(core.chain.top_chain_hash))
    return "asked"


@event_handler(
    13,
    "reconcile in progress",
    "top of chain",
    "successor",
    "diverged",
    sends=(NextInSequenceResponse,),
    triggers=("Reconcile Begin",),
)
def receive_request_next_in_sequence(core: Core, sender: int, message: ChainHashSuccessorQuery) -> str:
    """Algorithm 13, Receive Request Next in Sequence: name the next block, or detect that the chain has diverged.

    The reconcile may begin while the agent's own vote is in progress. The voting timer continues, and Algorithm 5 does
    nothing when it expires.
    """
    if core.reconcile_in_progress:
        return "reconcile in progress"
    if not core.chain.contains_chain_hash(message.chain_hash):
        core.trigger("Reconcile Begin")
        return "diverged"
    next_block = core.chain.successor(message.chain_hash)
    if next_block is None:
        core.send(NextInSequenceResponse(message.chain_hash, None, core.chain.top_timestamp_us))
        return "top of chain"
    core.send(NextInSequenceResponse(message.chain_hash, next_block.block_hash, next_block.timestamp_us))
    return "successor"


@event_handler(
    14,
    "not in phase 2",
    "another chain",
    "counted already",
    "new candidate",
    "counted",
    tally="reconcile_response_dictionary",
)
def receive_response_next_in_sequence(core: Core, sender: int, message: NextInSequenceResponse) -> str:
    """Algorithm 14, Receive Response Next in Sequence: count an answer that names the next block."""
    if not core.phase_two_timer.active:
        return "not in phase 2"
    if message.chain_hash != core.chain.top_chain_hash:
        return "another chain"
    if sender in core.reconcile_responders:
        return "counted already"
    core.reconcile_responders.add(sender)
    candidate = IS_TOP_OF_CHAIN if message.block_hash is None else message.block_hash
    counter_record = core.reconcile_response_dictionary.get(candidate)
    if counter_record is None:
        core.reconcile_response_dictionary[candidate] = [1, message.timestamp_us]
        return "new candidate"
    counter_record[0] += 1
    return "counted"


def most_named(candidates: Mapping[bytes, Sequence[int]]) -> list[bytes]:
    """Return the candidates of phase 2 with the most votes. The result contains several candidates after a tie, and no
    candidate after a phase without answers.
    """
    most = max((count for count, _ in candidates.values()), default=0)
    return [candidate for candidate, (count, _) in candidates.items() if count == most]


def without_minority_top(candidates: Mapping[bytes, Sequence[int]]) -> Mapping[bytes, Sequence[int]]:
    """Return the candidates of phase 2. Omit "Is Top Of Chain" unless this agent and the agents that named it together
    are a majority. Without this majority, the agents that named a block would disapprove the next proposal of this
    agent (Algorithms 3 and 5).
    """
    with_us = 1 + candidates.get(IS_TOP_OF_CHAIN, (0,))[0]
    blocks = {candidate: counted for candidate, counted in candidates.items() if candidate != IS_TOP_OF_CHAIN}
    return candidates if with_us > sum(count for count, _ in blocks.values()) else blocks


@event_handler(
    15,
    "no response",
    "top of chain",
    "block",
    "tie: top of chain",
    "tie: block",
    triggers=("Reconcile Phase 3", "Reconcile Finalize"),
    tally="majority_response_block_hash",
)
def reconcile_phase_2_timer_expiration(core: Core) -> str:
    """Algorithm 15, Reconcile Phase 2 Timer Expiration: choose the block that most answers named.

    In a tie the oldest timestamp decides, and with equal timestamps the lowest hash. With the setting `phase2_tie`
    "block", a tie never ends the search if one of the candidates is a block. With `top_needs_majority`, "Is Top Of
    Chain" ends the search only with the majority of a vote. Without this setting, an agent whose proposal was
    disapproved may receive the answer that no block follows, propose again, and be disapproved again without end.
    """
    candidates: Mapping[bytes, Sequence[int]] = core.reconcile_response_dictionary
    if not candidates:
        core.trigger("Reconcile Finalize")
        return "no response"
    if core.settings.top_needs_majority:
        candidates = without_minority_top(candidates)
    tied = most_named(candidates)
    tie = "tie: " if len(tied) > 1 else ""
    if tie and core.settings.phase2_tie == "block":
        tied = [candidate for candidate in tied if candidate != IS_TOP_OF_CHAIN]
    majority_response = min(tied, key=lambda candidate: (candidates[candidate][1], candidate))
    if majority_response == IS_TOP_OF_CHAIN:
        core.trigger("Reconcile Finalize")
        return tie + "top of chain"
    core.majority_response_block_hash = majority_response
    core.trigger("Reconcile Phase 3")
    return tie + "block"


@event_handler(
    16,
    "from the stack",
    "held already",
    "asked",
    sends=(RequestForBlock,),
    starts=("phase three",),
    triggers=("Reconcile Phase 2", "Reconcile Finalize"),
)
def reconcile_phase_3(core: Core) -> str:
    """Algorithm 16, Reconcile Phase 3: take the chosen block from the reconcile stack, or request it.

    The pseudo-code stops after it takes a block from the stack, and the reconcile would never end. This handler
    continues with phase 2, as step 4 of Section 3.5.3 does.
    """
    block_hash = core.majority_response_block_hash
    assert block_hash is not None, "phase 3 is triggered with a majority response"
    block = core.remove_from_stack(block_hash)
    if block is not None:
        core.commit(block)
        core.majority_response_block_hash = None
        core.trigger("Reconcile Phase 2")
        return "from the stack"
    if core.holds(block_hash):
        core.majority_response_block_hash = None
        core.trigger("Reconcile Finalize")  # no correct agent offers it: a second copy is never committed
        return "held already"
    core.start(core.phase_three_timer, core.settings.phase3_timeout_s)
    core.send(RequestForBlock(block_hash))
    return "asked"


@event_handler(17, "reconcile in progress", "sent", "not held", sends=(BlockResponse,))
def receive_request_block_for_hash(core: Core, sender: int, message: RequestForBlock) -> str:
    """Algorithm 17, Receive Request Block for Hash: send the block if the chain contains it."""
    if core.reconcile_in_progress:
        return "reconcile in progress"
    block = core.chain.get(message.block_hash)
    if block is None:
        return "not held"
    core.send(BlockResponse(block))
    return "sent"


@event_handler(18, "not in phase 3", "another block", "committed", triggers=("Reconcile Phase 2",))
def receive_response_block_for_hash(core: Core, sender: int, message: BlockResponse) -> str:
    """Algorithm 18, Receive Response Block for Hash: commit the requested block.

    The thesis pauses the phase 3 timer during the test of the block. A handler is atomic here, so the pause has no
    effect. `Core.commit` updates the top chain hash. The agents of the field test did not do this (quirk
    `stale_chain_hash`).
    """
    if not core.phase_three_timer.active:
        return "not in phase 3"
    core.phase_three_timer.pause(core.now)
    if message.block.block_hash != core.majority_response_block_hash:
        core.phase_three_timer.resume(core.now)
        return "another block"
    core.phase_three_timer.stop()
    core.commit(message.block)
    core.majority_response_block_hash = None
    core.trigger("Reconcile Phase 2")
    return "committed"


@event_handler(19, "gave up", triggers=("Reconcile Finalize",))
def reconcile_phase_3_timer_expiration(core: Core) -> str:
    """Algorithm 19, Reconcile Phase 3 Timer Expiration: end the reconcile, because the block did not arrive."""
    core.majority_response_block_hash = None
    core.trigger("Reconcile Finalize")
    return "gave up"


@event_handler(
    20,
    "asked who follows",
    "recommitted, more to come",
    "done",
    sends=(CommitBlock, ChainHashSuccessorQuery),
    starts=("finalize gap",),
    triggers=("Process Next Deque Block",),
)
def reconcile_finalize(core: Core) -> str:
    """Algorithm 20, Reconcile Finalize: commit the reconcile stack again, and broadcast each block.

    Section 4.2 requires a pause between commits, so that other agents can follow. After each commit, the handler
    therefore waits for `finalize_gap_s` and runs again. The flag `reconcile_in_progress` stays set until the stack is
    empty. With the setting `asks_after_commit`, the handler also runs a gap after a commit of Algorithm 5. The stack is
    empty then, and the handler only asks for the successor of the chain. An agent without this chain detects by this
    query that it has diverged (Algorithm 13).
    """
    if core.settings.asks_after_commit and not core.reconcile_in_progress:
        core.send(ChainHashSuccessorQuery(core.chain.top_chain_hash))
        return "asked who follows"
    while core.reconcile_stack:
        block = core.pop_from_stack()
        core.commit(block)
        core.send(CommitBlock(block, core.chain.top_chain_hash))
        if core.reconcile_stack and core.settings.finalize_gap_s > 0:
            core.start(core.finalize_timer, core.settings.finalize_gap_s)
            return "recommitted, more to come"
    core.reconcile_in_progress = False
    core.trigger("Process Next Deque Block")
    return "done"
