"""The reference implementation: a literal transcription of Algorithms 1-20 (Chapter 3 of the thesis).

This module judges recorded runs of other implementations, so it follows the order and the words of the pseudo-code,
even if shorter code were possible. The author of the module did not see `ucp`. The author worked from the thesis and
from interpretations of its ambiguous passages ("readings"). "Reading 4" in a docstring means number 4 of
docs/reference/readings.md.

Each algorithm is one function. It reads and changes a `ReferenceState` and returns the name of the branch that it took.
An input is a message, an expired timer, a logged event or a command. A handler is atomic: it runs to its end, then the
local events that it triggered run in order, then the next input follows. The locks of the thesis are therefore not
needed (reading 15). The functions do no I/O and read no clock. They append messages to `ReferenceState.outbox`. Each
input contains the current time.
"""

from collections.abc import Callable
from typing import TypeVar

from harness.checker.reference.state import Handler, ReferenceState
from ucp.block import LATEST_US, Block, next_chain_hash
from ucp.events import LoggableEvent
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

IS_TOP_OF_CHAIN = b""
"""The reserved candidate "Is Top Of Chain" in the dictionary of phase 2 (reading 9)."""

Tally = dict[str, int | list[int]]


# Which handler runs when. Each algorithm below registers itself.

HANDLERS: dict[str, Handler] = {}
ON_MESSAGE: dict[type[Message], Handler] = {}
ON_TIMER: dict[str, Handler] = {}
ON_LOCAL_EVENT: dict[str, Handler] = {}

_Run = TypeVar("_Run", bound=Callable[..., str])


def _algorithm(
    number: int,
    *,
    message: type[Message] | None = None,
    timer: str = "",
    local_event: str = "",
    tally: str | None = None,
) -> Callable[[_Run], _Run]:
    """Return a decorator that registers a function as the handler of a message, an expired timer or a local event."""

    def register(run: _Run) -> _Run:
        handler = Handler(run.__name__, number, run, tally)
        HANDLERS[handler.name] = handler
        if message is not None:
            ON_MESSAGE[message] = handler
        if timer:
            ON_TIMER[timer] = handler
        if local_event:
            ON_LOCAL_EVENT[local_event] = handler
        return run

    return register


# Section 3.6.1: incorporation of event data into blocks


@_algorithm(1, local_event="Build Data Block")
def build_data_block(state: ReferenceState, event: LoggableEvent) -> str:
    """Algorithm 1, Build Data Block (Section 3.6.1): add an event to the current block (reading 1)."""
    state.current_block += event.encode()
    if len(state.current_block) + state.settings.max_event_bytes >= state.settings.max_block_bytes:
        timestamp_us = min(max(event.timestamp_us, state.newest_block_timestamp_us + 1), LATEST_US)
        block = Block(state.agent_id, timestamp_us, state.event_data(timestamp_us))
        state.newest_block_timestamp_us = timestamp_us
        state.current_block = bytearray()
        state.completed.append(block.block_hash)
        state.changed("complete", block)
        state.push_deque(block)
        state.trigger("Process Next Deque Block")
        return "full"
    return "building"


# Section 3.6.2: the commit process


@_algorithm(2, local_event="Process Next Deque Block", tally="vote_count")
def process_next_deque_block(state: ReferenceState) -> str:
    """Algorithm 2, Process Next Deque Block (Section 3.6.2): propose the front block of the deque (reading 2)."""
    if state.reconcile_in_progress:
        return "reconcile in progress"
    if state.voting_timer.active:
        return "vote running"
    if not state.blocks_to_be_committed:
        return "deque empty"
    state.vote_count = {"yes": 1, "no": 0}
    state.voters = set()
    state.top_chain_hash_at_initiation = state.chain.top_chain_hash
    state.candidate_block = state.blocks_to_be_committed[0]
    state.start(state.voting_timer, state.settings.vote_timeout_s)
    state.send(BlockAddRequest(state.candidate_block.block_hash, state.chain.top_chain_hash))
    return "proposed"


@_algorithm(3, message=BlockAddRequest)
def receive_request_add_block(state: ReferenceState, sender: int, message: BlockAddRequest) -> str:
    """Algorithm 3, Receive Request Add Block (Section 3.6.2): vote on another agent's proposal (reading 3)."""
    if state.reconcile_in_progress:
        return "reconcile in progress"
    approve = state.chain.top_chain_hash == message.chain_hash
    chain_hash = message.chain_hash if state.settings.vote_names_chain else None
    state.send(BlockAddResponse(message.block_hash, approve, chain_hash))
    return "approve" if approve else "disapprove"


@_algorithm(4, message=BlockAddResponse, tally="vote_count")
def receive_vote_add_block(state: ReferenceState, sender: int, message: BlockAddResponse) -> str:
    """Algorithm 4, Receive Vote Add Block (Section 3.6.2): count a vote on the agent's own proposal (reading 3)."""
    if not state.voting_timer.active:
        return "no vote running"
    if state.candidate_block is None or message.block_hash != state.candidate_block.block_hash:
        return "another block"
    if state.settings.vote_names_chain and message.chain_hash != state.top_chain_hash_at_initiation:
        return "another round"
    if sender in state.voters:
        return "counted already"
    state.voters.add(sender)
    vote = "yes" if message.approve else "no"
    state.vote_count[vote] += 1
    return vote


@_algorithm(5, timer="voting")
def vote_timer_expiration(state: ReferenceState) -> str:
    """Algorithm 5, Vote Timer Expiration (Section 3.6.2): commit the proposed block, vote again or reconcile.

    According to reading 4, the agent votes again if its chain changed during an approved vote. According to reading 5,
    the agent tests the result of the vote before the change of the chain, and a tied vote is not approved. According to
    reading 10, the handler does nothing during a reconcile. The block leaves the deque before it is committed, because
    the agent contract requires this order of recorded changes. The thesis removes the block last. The setting
    `asks_after_commit` extends the thesis.
    """
    if state.reconcile_in_progress:
        return "reconcile in progress"
    approved = state.vote_count["yes"] > state.vote_count["no"]
    chain_changed = state.chain.top_chain_hash != state.top_chain_hash_at_initiation
    if chain_changed and (approved or state.settings.changed_before_tally):
        state.trigger("Process Next Deque Block")
        return "chain changed"
    if approved:
        approved_block = state.pop_deque()
        state.commit(approved_block)
        state.send(CommitBlock(approved_block, state.chain.top_chain_hash))
        state.trigger("Process Next Deque Block")
        if state.settings.asks_after_commit:
            state.start(state.finalize_timer, state.settings.finalize_gap_s)
        return "approved"
    state.trigger("Reconcile Begin")
    return "not approved"


@_algorithm(6, message=CommitBlock)
def receive_commit_block(state: ReferenceState, sender: int, message: CommitBlock) -> str:
    """Algorithm 6, Receive Commit Block (Section 3.6.2): commit another agent's block (reading 6).

    Because of characteristic 3, the agent ignores a block that it already holds.
    """
    if state.reconcile_in_progress:
        return "reconcile in progress"
    if message.chain_hash != next_chain_hash(state.chain.top_chain_hash, message.block.block_hash):
        return "does not succeed"
    if state.holds(message.block.block_hash):
        return "held already"
    state.commit(message.block)
    return "committed"


# Section 3.6.3: the reconcile process


@_algorithm(7, local_event="Reconcile Begin")
def reconcile_begin(state: ReferenceState) -> str:
    """Algorithm 7, Reconcile Begin (Section 3.6.3). An active voting timer continues (reading 10)."""
    if state.reconcile_in_progress:
        return "already in progress"
    state.reconcile_in_progress = True
    if state.settings.asks_after_commit:
        state.finalize_timer.stop()
    state.trigger("Reconcile Phase 1")
    return "begun"


@_algorithm(8, local_event="Reconcile Phase 1", tally="reconcile_vote_count")
def reconcile_phase_1(state: ReferenceState) -> str:
    """Algorithm 8, Reconcile Phase 1 (Section 3.6.3): ask the neighbours whether their chains contain the agent's own
    top block.
    """
    state.reconcile_vote_count = {"yes": 0, "no": 0}
    state.reconcile_responders = set()
    state.send(ChainContainQuery(state.chain.top_chain_hash))
    state.start(state.phase_one_timer, state.settings.phase1_timeout_s)
    return "asked"


@_algorithm(9, message=ChainContainQuery)
def receive_request_chain_contain(state: ReferenceState, sender: int, message: ChainContainQuery) -> str:
    """Algorithm 9, Receive Request Chain Contain (Section 3.6.3): answer a Chain Contain Query (reading 7)."""
    if state.reconcile_in_progress:
        return "reconcile in progress"
    contained = state.chain.contains_chain_hash(message.chain_hash)
    state.send(ChainContainResponse(message.chain_hash, contained))
    return "yes" if contained else "no"


@_algorithm(10, message=ChainContainResponse, tally="reconcile_vote_count")
def receive_phase_1_response(state: ReferenceState, sender: int, message: ChainContainResponse) -> str:
    """Algorithm 10, Receive Phase 1 Response (Section 3.6.3): count one answer per responder (Section 4.1)."""
    if not state.phase_one_timer.active:
        return "not in phase 1"
    if message.chain_hash != state.chain.top_chain_hash:
        return "another chain"
    if sender in state.reconcile_responders:
        return "counted already"
    state.reconcile_responders.add(sender)
    vote = "yes" if message.contained else "no"
    state.reconcile_vote_count[vote] += 1
    return vote


@_algorithm(11, timer="phase one")
def reconcile_phase_1_timer_expiration(state: ReferenceState) -> str:
    """Algorithm 11, Reconcile Phase 1 Timer Expiration (Section 3.6.3): pop the top block or go to phase 2 (reading 8).

    The inception block is never popped (reading 8).
    """
    yes, no = state.reconcile_vote_count["yes"], state.reconcile_vote_count["no"]
    if yes + no == 0:
        state.trigger("Reconcile Finalize")
        return "no response"
    if yes < no or (yes == no and state.settings.phase1_tie == "pop"):
        if len(state.chain) == 0:
            state.trigger("Reconcile Finalize")
            return "at inception"
        block = state.chain.pop()
        state.changed("chain-", block)
        state.push_stack(block)
        state.trigger("Reconcile Phase 1")
        return "not contained"
    state.trigger("Reconcile Phase 2")
    return "contained"


@_algorithm(12, local_event="Reconcile Phase 2", tally="reconcile_response_dictionary")
def reconcile_phase_2(state: ReferenceState) -> str:
    """Algorithm 12, Reconcile Phase 2 (Section 3.6.3): ask which block follows the top of the agent's own chain
    (reading 9).
    """
    state.reconcile_response_dictionary = {}
    state.reconcile_responders = set()
    state.start(state.phase_two_timer, state.settings.phase2_timeout_s)
    state.send(ChainHashSuccessorQuery(state.chain.top_chain_hash))
    return "asked"


@_algorithm(13, message=ChainHashSuccessorQuery)
def receive_request_next_in_sequence(state: ReferenceState, sender: int, message: ChainHashSuccessorQuery) -> str:
    """Algorithm 13, Receive Request Next in Sequence (Section 3.6.3): name the successor (readings 9 and 10).

    An agent whose chain does not contain the chain hash has diverged and begins a reconcile.
    """
    if state.reconcile_in_progress:
        return "reconcile in progress"
    if not state.chain.contains_chain_hash(message.chain_hash):
        state.trigger("Reconcile Begin")
        return "diverged"
    block = state.chain.successor(message.chain_hash)
    if block is None:
        state.send(NextInSequenceResponse(message.chain_hash, None, state.chain.top_timestamp_us))
        return "top of chain"
    state.send(NextInSequenceResponse(message.chain_hash, block.block_hash, block.timestamp_us))
    return "successor"


@_algorithm(14, message=NextInSequenceResponse, tally="reconcile_response_dictionary")
def receive_response_next_in_sequence(state: ReferenceState, sender: int, message: NextInSequenceResponse) -> str:
    """Algorithm 14, Receive Response Next in Sequence (Section 3.6.3): count a candidate (reading 9, Section 4.1)."""
    if not state.phase_two_timer.active:
        return "not in phase 2"
    if message.chain_hash != state.chain.top_chain_hash:
        return "another chain"
    if sender in state.reconcile_responders:
        return "counted already"
    state.reconcile_responders.add(sender)
    candidate = IS_TOP_OF_CHAIN if message.block_hash is None else message.block_hash
    if candidate not in state.reconcile_response_dictionary:
        state.reconcile_response_dictionary[candidate] = [1, message.timestamp_us]
        return "new candidate"
    state.reconcile_response_dictionary[candidate][0] += 1
    return "counted"


@_algorithm(15, timer="phase two", tally="majority_response_block_hash")
def reconcile_phase_2_timer_expiration(state: ReferenceState) -> str:
    """Algorithm 15, Reconcile Phase 2 Timer Expiration (Section 3.6.3): choose the majority response (reading 9).

    Ties go to the oldest timestamp, then to the lowest hash. "Is Top Of Chain" sorts below every hash. The setting
    `top_needs_majority` extends the thesis.
    """
    candidates = dict(state.reconcile_response_dictionary)
    if not candidates:
        state.trigger("Reconcile Finalize")
        return "no response"
    if state.settings.top_needs_majority and IS_TOP_OF_CHAIN in candidates:
        blocks_count = sum(count for candidate, (count, _) in candidates.items() if candidate != IS_TOP_OF_CHAIN)
        if 1 + candidates[IS_TOP_OF_CHAIN][0] <= blocks_count:
            del candidates[IS_TOP_OF_CHAIN]
    highest = max(count for count, _ in candidates.values())
    majority = [candidate for candidate, (count, _) in candidates.items() if count == highest]
    tie = "tie: " if len(majority) > 1 else ""
    if tie and state.settings.phase2_tie == "block":
        majority = [candidate for candidate in majority if candidate != IS_TOP_OF_CHAIN]
    majority_response = min(majority, key=lambda candidate: (candidates[candidate][1], candidate))
    if majority_response == IS_TOP_OF_CHAIN:
        state.trigger("Reconcile Finalize")
        return tie + "top of chain"
    state.majority_response_block_hash = majority_response
    state.trigger("Reconcile Phase 3")
    return tie + "block"


@_algorithm(16, local_event="Reconcile Phase 3")
def reconcile_phase_3(state: ReferenceState) -> str:
    """Algorithm 16, Reconcile Phase 3 (Section 3.6.3): get the chosen block.

    According to reading 11, the agent continues with phase 2 after it takes a block from its own stack. Because of
    characteristic 3, the agent gives up a chosen block that it already holds elsewhere.
    """
    block_hash = state.majority_response_block_hash
    assert block_hash is not None, "Algorithm 15 chooses a block before it triggers phase 3"
    for index, block in enumerate(state.reconcile_stack):
        if block.block_hash == block_hash:
            state.commit(state.pop_stack(index))
            state.majority_response_block_hash = None
            state.trigger("Reconcile Phase 2")
            return "from the stack"
    if state.holds(block_hash):
        state.majority_response_block_hash = None
        state.trigger("Reconcile Finalize")
        return "held already"
    state.start(state.phase_three_timer, state.settings.phase3_timeout_s)
    state.send(RequestForBlock(block_hash))
    return "asked"


@_algorithm(17, message=RequestForBlock)
def receive_request_block_for_hash(state: ReferenceState, sender: int, message: RequestForBlock) -> str:
    """Algorithm 17, Receive Request Block for Hash (Section 3.6.3): send a block of the local chain."""
    if state.reconcile_in_progress:
        return "reconcile in progress"
    block = state.chain.get(message.block_hash)
    if block is None:
        return "not held"
    state.send(BlockResponse(block))
    return "sent"


@_algorithm(18, message=BlockResponse)
def receive_response_block_for_hash(state: ReferenceState, sender: int, message: BlockResponse) -> str:
    """Algorithm 18, Receive Response Block for Hash (Section 3.6.3): commit the requested block (reading 12).

    Pausing the phase 3 timer has no effect, because handlers are atomic (reading 12).
    """
    if not state.phase_three_timer.active:
        return "not in phase 3"
    state.phase_three_timer.pause(state.now)
    if message.block.block_hash != state.majority_response_block_hash:
        state.phase_three_timer.resume(state.now)
        return "another block"
    state.phase_three_timer.stop()
    state.commit(message.block)
    state.majority_response_block_hash = None
    state.trigger("Reconcile Phase 2")
    return "committed"


@_algorithm(19, timer="phase three")
def reconcile_phase_3_timer_expiration(state: ReferenceState) -> str:
    """Algorithm 19, Reconcile Phase 3 Timer Expiration (Section 3.6.3): abandon the chosen block (reading 13)."""
    state.majority_response_block_hash = None
    state.trigger("Reconcile Finalize")
    return "gave up"


@_algorithm(20, timer="finalize gap", local_event="Reconcile Finalize")
def reconcile_finalize(state: ReferenceState) -> str:
    """Algorithm 20, Reconcile Finalize (Section 3.6.3): commit the remaining blocks of the reconcile stack again.

    According to reading 14, the agent pauses between two commits, and the flag `reconcile_in_progress` stays set during
    the pause. The setting `asks_after_commit` is an extension of the thesis.
    """
    if state.settings.asks_after_commit and not state.reconcile_in_progress:
        state.send(ChainHashSuccessorQuery(state.chain.top_chain_hash))
        return "asked who follows"
    while state.reconcile_stack:
        block = state.pop_stack()
        state.commit(block)
        state.send(CommitBlock(block, state.chain.top_chain_hash))
        if state.reconcile_stack and state.settings.finalize_gap_s > 0:
            state.start(state.finalize_timer, state.settings.finalize_gap_s)
            return "recommitted, more to come"
    state.reconcile_in_progress = False
    state.trigger("Process Next Deque Block")
    return "done"


def tally_of(state: ReferenceState, handler: Handler) -> Tally | None:
    """Return a copy of the votes or candidates that a handler counts. If the handler chooses a candidate, return only
    this candidate. Hashes are hexadecimal text. Return None for a handler that counts nothing.
    """
    dictionary = state.reconcile_response_dictionary
    if handler.tally == "majority_response_block_hash":
        chosen = state.majority_response_block_hash
        return {} if chosen is None else {chosen.hex(): dictionary.get(chosen, [0])[0]}
    if handler.tally == "reconcile_response_dictionary":
        return {candidate.hex(): list(record) for candidate, record in dictionary.items()}
    if handler.tally is None:
        return None
    votes: dict[str, int] = getattr(state, handler.tally)
    return dict(votes)
