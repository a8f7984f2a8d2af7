"""List all inputs of the generated tests: the relevant variants of the nine messages, events, timers and commands.

An input is a function of the reference's state. For example, "vote no of an agent that has voted" is possible only if
an agent has voted. The function returns an action, or None if the input is impossible in this state. The peers are
interchangeable, so agent 2 always answers first, then agent 3, then agent 4.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from harness.checker.reference.algorithms import IS_TOP_OF_CHAIN
from harness.conformance._reference_model import (
    AGENT,
    OLD_US,
    PEERS,
    YOUNG_US,
    Action,
    ControlCommand,
    ReferenceModel,
    TimerExpiry,
)
from ucp.block import Block, next_chain_hash
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

UNKNOWN = bytes.fromhex("de" * 32)
"""A value in the form of a hash that is the hash of no block and of no chain."""

Tally = Literal["voting", "phase one", "phase two", "timer"]


@dataclass(frozen=True)
class AgentInput:
    """A kind of input for the agent under test. `name` describes the input."""

    name: str
    make: Callable[[ReferenceModel], Action | None]
    tally: Tally | None = None
    """The activity whose counted answers decide the effect of the input. "timer" means the activity that ends with the
    running timer. None if counted answers never change the effect of the input.
    """
    counted_twin: str | None = None
    """Name of a similar answer that the agent must count. Only inputs that are answers which the agent must ignore have
    a twin. None for all other inputs.
    """
    preceding: str | None = None
    """Name of an answer that the agent must ignore. The test sends this answer directly before the timer expiry,
    because the expiry shows whether the agent counted the answer. None if the input is no timer expiry.
    """


INPUTS: dict[str, AgentInput] = {}
TIMER, LOG = "the next timer ends", "an event fills a block"


def _input(
    name: str, tally: Tally | None = None, counted_twin: str | None = None
) -> Callable[[Callable[[ReferenceModel], Action | None]], None]:
    def declare(make: Callable[[ReferenceModel], Action | None]) -> None:
        assert name not in INPUTS
        INPUTS[name] = AgentInput(name, make, tally, counted_twin)

    return declare


def _message(
    name: str,
    message: Callable[[ReferenceModel], Message | None],
    sender: Callable[[ReferenceModel], int | None] = lambda _: PEERS[0],
    tally: Tally | None = None,
    counted_twin: str | None = None,
) -> None:
    def make(model: ReferenceModel) -> Action | None:
        peer = sender(model)
        if peer is None:
            return None
        content = message(model)
        return None if content is None else model.datagram(peer, content)

    _input(name, tally, counted_twin)(make)


# The sender of a message: a peer that has not answered yet, or one that has


def _first_silent_peer(responders: Callable[[ReferenceModel], set[int]]) -> Callable[[ReferenceModel], int | None]:
    return lambda model: next((peer for peer in PEERS if peer not in responders(model)), None)


def _last_responder(responders: Callable[[ReferenceModel], set[int]]) -> Callable[[ReferenceModel], int | None]:
    return lambda model: max(responders(model), default=None)


def _voters(model: ReferenceModel) -> set[int]:
    """Return the agents that have voted in the current vote. The set is empty during a reconcile, because votes do not
    count then.
    """
    state = model.state
    return state.voters if state.voting_timer.active and not state.reconcile_in_progress else set()


def _responders_of_phase_1(model: ReferenceModel) -> set[int]:
    return model.state.reconcile_responders if model.state.phase_one_timer.active else set()


def _responders_of_phase_2(model: ReferenceModel) -> set[int]:
    return model.state.reconcile_responders if model.state.phase_two_timer.active else set()


# The chain or the block that a message is about


def _top(model: ReferenceModel) -> bytes:
    return model.state.chain.top_chain_hash


def _chain_hashes(model: ReferenceModel) -> list[bytes]:
    hashes = [model.state.chain.inception.chain_hash]
    for block in model.state.chain:
        hashes.append(next_chain_hash(hashes[-1], block.block_hash))
    return hashes


def _chain_below_top(model: ReferenceModel) -> bytes | None:
    """Return the chain hash of the chain without its newest block. Return None if the chain contains no block."""
    hashes = _chain_hashes(model)
    return hashes[-2] if len(hashes) > 1 else None


def _top_block(model: ReferenceModel) -> Block | None:
    *_, top = (None, *model.state.chain)
    return top


def _chain_with_popped_block(model: ReferenceModel) -> bytes | None:
    """Return the hash of the chain that results when the most recently popped block is appended again. Return None if
    no block was popped.
    """
    stack = model.state.reconcile_stack
    return next_chain_hash(_top(model), stack[-1].block_hash) if stack else None


def _candidate(model: ReferenceModel) -> Block | None:
    state = model.state
    return state.candidate_block if state.voting_timer.active else None


def _chain_hash_of_vote(model: ReferenceModel) -> bytes | None:
    state = model.state
    return state.top_chain_hash_at_initiation if state.settings.vote_names_chain else None


@_input(LOG)
def _log(model: ReferenceModel) -> Action | None:
    return model.event()


@_input(TIMER, "timer")
def _expire(model: ReferenceModel) -> Action | None:
    return None if model.agent.next_timer() is None else TimerExpiry()


@_input("operator reconciles")
def _reconcile(model: ReferenceModel) -> Action | None:
    return ControlCommand("reconcile")


# Block Add Request

_message("Block Add Request on the agent's chain", lambda model: BlockAddRequest(UNKNOWN, _top(model)))
_message("Block Add Request on an unknown chain", lambda model: BlockAddRequest(UNKNOWN, UNKNOWN))
_message(
    "Block Add Request on the chain below the top",
    lambda model: BlockAddRequest(UNKNOWN, below) if (below := _chain_below_top(model)) else None,
)
_message(
    "Block Add Request for the agent's own candidate",
    lambda model: BlockAddRequest(block.block_hash, _top(model)) if (block := _candidate(model)) else None,
)
_message(
    "Block Add Request on the chain with the popped block",
    lambda model: BlockAddRequest(UNKNOWN, popped) if (popped := _chain_with_popped_block(model)) else None,
)

# Block Add Response


def _vote(approve: bool) -> Callable[[ReferenceModel], Message | None]:
    return lambda model: (
        BlockAddResponse(block.block_hash, approve, _chain_hash_of_vote(model))
        if (block := _candidate(model))
        else None
    )


for _approve, _answer in ((True, "yes"), (False, "no")):
    _message(f"vote {_answer}", _vote(_approve), _first_silent_peer(_voters), "voting")
    _message(
        f"vote {_answer} of an agent that has voted",
        _vote(_approve),
        _last_responder(_voters),
        "voting",
        f"vote {_answer}",
    )
    _message(
        f"vote {_answer} for an unknown block",
        lambda model, approve=_approve: BlockAddResponse(UNKNOWN, approve, _chain_hash_of_vote(model)),  # type: ignore[misc]
        _first_silent_peer(_voters),
        "voting",
        f"vote {_answer}",
    )
    _message(
        f"vote {_answer} for the block on top of the chain",
        lambda model, approve=_approve: (  # type: ignore[misc]
            BlockAddResponse(top.block_hash, approve, _chain_hash_of_vote(model))
            if (top := _top_block(model))
            else None
        ),
        _first_silent_peer(_voters),
        "voting",
        f"vote {_answer}",
    )
    _message(
        f"vote {_answer} for the block that waits behind",
        lambda model, approve=_approve: (  # type: ignore[misc]
            BlockAddResponse(model.state.blocks_to_be_committed[1].block_hash, approve, _chain_hash_of_vote(model))
            if len(model.state.blocks_to_be_committed) > 1
            else None
        ),
        _first_silent_peer(_voters),
        "voting",
        f"vote {_answer}",
    )
    _message(
        f"vote {_answer} that names another chain",
        lambda model, approve=_approve: (  # type: ignore[misc]
            BlockAddResponse(block.block_hash, approve, UNKNOWN) if (block := _candidate(model)) else None
        ),
        _first_silent_peer(_voters),
        "voting",
        f"vote {_answer}",
    )
_message(
    "vote no that names no chain",
    lambda model: (
        BlockAddResponse(block.block_hash, False)
        if model.state.settings.vote_names_chain and (block := _candidate(model))
        else None
    ),
    _first_silent_peer(_voters),
    "voting",
    "vote no",
)

# Commit Block


def _succeeding(model: ReferenceModel, block: Block) -> CommitBlock:
    return CommitBlock(block, next_chain_hash(_top(model), block.block_hash))


for _young, _age in ((False, "old"), (True, "young")):
    _message(
        f"Commit Block of a new {_age} block that succeeds the top",
        lambda model, young=_young: _succeeding(model, model.new_block(PEERS[0], young=young)),  # type: ignore[misc]
    )
_message(
    "Commit Block of a third agent's block that succeeds the top",
    lambda model: _succeeding(model, model.new_block(PEERS[2], young=False)),
)
_message(
    "Commit Block of a block in the agent's name that succeeds the top",
    lambda model: _succeeding(model, model.new_block(AGENT, young=False)),
)
_message("Commit Block on an unknown chain", lambda model: CommitBlock(model.new_block(PEERS[0], young=False), UNKNOWN))
_message(
    "Commit Block that names the chain before it",
    lambda model: CommitBlock(model.new_block(PEERS[0], young=False), _top(model)),
)
_message(
    "Commit Block with both hashes swapped",
    lambda model: CommitBlock(
        block := model.new_block(PEERS[0], young=False), next_chain_hash(block.block_hash, _top(model))
    ),
)
_message(
    "Commit Block that succeeds the chain below the top",
    lambda model: (
        CommitBlock(block := model.new_block(PEERS[0], young=False), next_chain_hash(below, block.block_hash))
        if (below := _chain_below_top(model))
        else None
    ),
)
_message(
    "Commit Block of the top block, again",
    lambda model: CommitBlock(top, _top(model)) if (top := _top_block(model)) else None,
)
_message(
    "Commit Block of the top block, as its own successor",
    lambda model: _succeeding(model, top) if (top := _top_block(model)) else None,
)
_message(
    "Commit Block of the agent's own candidate",
    lambda model: _succeeding(model, block) if (block := _candidate(model)) else None,
)
_message(
    "Commit Block of the popped block",
    lambda model: _succeeding(model, model.state.reconcile_stack[-1]) if model.state.reconcile_stack else None,
)

# Chain Contain Query and Chain Hash Successor Query

for _query in (ChainContainQuery, ChainHashSuccessorQuery):
    _message(f"{_query.NAME} about the top", lambda model, query=_query: query(_top(model)))  # type: ignore[misc]
    _message(
        f"{_query.NAME} about the inception block",
        lambda model, query=_query: (  # type: ignore[misc]
            query(_chain_hashes(model)[0]) if len(model.state.chain) else None
        ),
    )
    _message(
        f"{_query.NAME} about the chain below the top",
        lambda model, query=_query: (  # type: ignore[misc]
            query(below) if len(model.state.chain) > 1 and (below := _chain_below_top(model)) else None
        ),
    )
    _message(f"{_query.NAME} about an unknown chain", lambda model, query=_query: query(UNKNOWN))  # type: ignore[misc]
    _message(
        f"{_query.NAME} about the chain with the popped block",
        lambda model, query=_query: query(popped) if (popped := _chain_with_popped_block(model)) else None,  # type: ignore[misc]
    )
_message(
    "Chain Contain Query that names a block's hash",
    lambda model: ChainContainQuery(top.block_hash) if (top := _top_block(model)) else None,
)

# Chain Contain Response

for _contained, _answer in ((True, "yes"), (False, "no")):
    for _suffix, _sender in (
        ("", _first_silent_peer(_responders_of_phase_1)),
        (" of an agent that has answered", _last_responder(_responders_of_phase_1)),
    ):
        _message(
            f"Chain Contain Response {_answer}{_suffix}",
            lambda model, contained=_contained: ChainContainResponse(_top(model), contained),  # type: ignore[misc]
            _sender,
            "phase one",
            f"Chain Contain Response {_answer}" if _suffix else None,
        )
    _message(
        f"Chain Contain Response {_answer} about an unknown chain",
        lambda model, contained=_contained: ChainContainResponse(UNKNOWN, contained),  # type: ignore[misc]
        _first_silent_peer(_responders_of_phase_1),
        "phase one",
        f"Chain Contain Response {_answer}",
    )
    _message(
        f"Chain Contain Response {_answer} about the chain with the popped block",
        lambda model, contained=_contained: (  # type: ignore[misc]
            ChainContainResponse(popped, contained) if (popped := _chain_with_popped_block(model)) else None
        ),
        _first_silent_peer(_responders_of_phase_1),
        "phase one",
        f"Chain Contain Response {_answer}",
    )

# Next in Sequence Response


def _phase_two(model: ReferenceModel) -> bool:
    return model.state.phase_two_timer.active


def _next_new(*, young: bool) -> Callable[[ReferenceModel], Message | None]:
    def make(model: ReferenceModel) -> Message:
        block = model.new_block(PEERS[1], young=young)
        return NextInSequenceResponse(_top(model), block.block_hash, block.timestamp_us)

    return make


def _next(candidate: Callable[[ReferenceModel], Block | None]) -> Callable[[ReferenceModel], Message | None]:
    def make(model: ReferenceModel) -> Message | None:
        block = candidate(model)
        return None if block is None else NextInSequenceResponse(_top(model), block.block_hash, block.timestamp_us)

    return make


def _named_block(model: ReferenceModel) -> Block | None:
    """Return the first block that an answer of reconcile phase 2 named. Return None if no answer named a block."""
    named = [candidate for candidate in model.state.reconcile_response_dictionary if candidate != IS_TOP_OF_CHAIN]
    return model.blocks.get(named[0]) if _phase_two(model) and named else None


def _block_of_stack(place: int) -> Callable[[ReferenceModel], Block | None]:
    """Return a function that returns the block at this position of the reconcile stack. Position 1 is the top."""
    return lambda model: model.state.reconcile_stack[-place] if len(model.state.reconcile_stack) >= place else None


def _first_of_deque(model: ReferenceModel) -> Block | None:
    return model.state.blocks_to_be_committed[0] if model.state.blocks_to_be_committed else None


for _name, _make_message in {
    "Is Top Of Chain, old": lambda model: NextInSequenceResponse(_top(model), None, OLD_US),
    "Is Top Of Chain, young": lambda model: NextInSequenceResponse(_top(model), None, YOUNG_US),
    "an old new block": _next_new(young=False),
    "a young new block": _next_new(young=True),
    "the block that was named first": _next(_named_block),
    "the block on top of the stack": _next(_block_of_stack(1)),
    "the second block of the stack": _next(_block_of_stack(2)),
    "the top block itself": _next(_top_block),
    "a block of the agent's deque": _next(_first_of_deque),
}.items():
    _message(
        f"Next in Sequence Response: {_name}", _make_message, _first_silent_peer(_responders_of_phase_2), "phase two"
    )
_COUNTED_TWINS = {
    "Is Top Of Chain": "Next in Sequence Response: Is Top Of Chain, old",
    "an old new block": "Next in Sequence Response: an old new block",
    "the block that was named first": "Next in Sequence Response: the block that was named first",
}
for _name, _make_message in {
    "Is Top Of Chain": lambda model: NextInSequenceResponse(_top(model), None, OLD_US),
    "an old new block": _next_new(young=False),
    "the block that was named first": _next(_named_block),
}.items():
    _message(
        f"Next in Sequence Response of an agent that has answered: {_name}",
        _make_message,
        _last_responder(_responders_of_phase_2),
        "phase two",
        _COUNTED_TWINS[_name],
    )
_message(
    "Next in Sequence Response about an unknown chain",
    lambda model: NextInSequenceResponse(
        UNKNOWN, (block := model.new_block(PEERS[1], young=False)).block_hash, block.timestamp_us
    ),
    _first_silent_peer(_responders_of_phase_2),
    "phase two",
    "Next in Sequence Response: an old new block",
)
_message(
    "Next in Sequence Response about the chain with the popped block",
    lambda model: NextInSequenceResponse(popped, None, OLD_US) if (popped := _chain_with_popped_block(model)) else None,
    _first_silent_peer(_responders_of_phase_2),
    "phase two",
    "Next in Sequence Response: Is Top Of Chain, old",
)

# Request for Block, Block Response

_message(
    "Request for Block: the top block",
    lambda model: RequestForBlock(top.block_hash) if (top := _top_block(model)) else None,
)
_message(
    "Request for Block: the first block",
    lambda model: RequestForBlock(next(iter(model.state.chain)).block_hash) if len(model.state.chain) > 1 else None,
)
_message("Request for Block: an unknown block", lambda model: RequestForBlock(UNKNOWN))
_message(
    "Request for Block: a block of the agent's deque",
    lambda model: RequestForBlock(block.block_hash) if (block := _first_of_deque(model)) else None,
)
_message(
    "Request for Block: the inception block",
    lambda model: RequestForBlock(model.state.chain.inception.block_hash),
)


def _requested_block(model: ReferenceModel) -> Message | None:
    wanted = model.state.majority_response_block_hash
    return BlockResponse(model.blocks[wanted]) if model.state.phase_three_timer.active and wanted else None


_message("Block Response: the block asked for", _requested_block)
_message("Block Response: another block", lambda model: BlockResponse(model.new_block(PEERS[1], young=False)))
_message(
    "Block Response: the top block",
    lambda model: BlockResponse(top) if (top := _top_block(model)) else None,
)


def _with_timer(given: AgentInput) -> AgentInput:
    return AgentInput(f"{given.name}, and the timer ends", given.make, "timer", given.counted_twin, given.name)


INPUTS |= {
    then.name: then for then in [_with_timer(given) for given in INPUTS.values() if given.counted_twin is not None]
}
