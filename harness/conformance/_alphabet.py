"""The inputs that there are: each of the nine messages in the variants that matter, events, timers and commands.

An input is a function of the reference's state, as in "a second no of somebody who has voted already". It gives what to
do, or None where there is no such thing. Peers are alike, so whoever answers first is agent 2, then 3, then 4.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from harness.checker.reference.algorithms import IS_TOP_OF_CHAIN
from harness.conformance._reference_model import AGENT, OLD_US, PEERS, YOUNG_US, Action, Command, Expire, Model
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
"""A hash of nothing."""

Tally = Literal["voting", "phase one", "phase two", "timer"]


@dataclass(frozen=True)
class Input:
    """`name` says what it is. `tally` is what its effect depends on besides what the agent holds.

    `as_if`: the input that counts, of one that must not. `first`: the input that comes before the end of a timer, so
    that it is seen whether it was counted.
    """

    name: str
    make: Callable[[Model], Action | None]
    tally: Tally | None = None
    as_if: str | None = None
    first: str | None = None


INPUTS: dict[str, Input] = {}
TIMER, LOG = "the next timer ends", "an event fills a block"


def _input(
    name: str, tally: Tally | None = None, as_if: str | None = None
) -> Callable[[Callable[[Model], Action | None]], None]:
    def declare(make: Callable[[Model], Action | None]) -> None:
        assert name not in INPUTS
        INPUTS[name] = Input(name, make, tally, as_if)

    return declare


def _message(
    name: str,
    message: Callable[[Model], Message | None],
    sender: Callable[[Model], int | None] = lambda _: PEERS[0],
    tally: Tally | None = None,
    as_if: str | None = None,
) -> None:
    def make(model: Model) -> Action | None:
        by = sender(model)
        if by is None:
            return None
        says = message(model)
        return None if says is None else model.datagram(by, says)

    _input(name, tally, as_if)(make)


# Whose


def _nobody_yet(responders: Callable[[Model], set[int]]) -> Callable[[Model], int | None]:
    return lambda model: next((peer for peer in PEERS if peer not in responders(model)), None)


def _again(responders: Callable[[Model], set[int]]) -> Callable[[Model], int | None]:
    return lambda model: max(responders(model), default=None)


def _voters(model: Model) -> set[int]:
    """Of the vote that matters now."""
    state = model.state
    return state.voters if state.voting_timer.active and not state.reconcile_in_progress else set()


def _of_phase_1(model: Model) -> set[int]:
    return model.state.reconcile_responders if model.state.phase_one_timer.active else set()


def _of_phase_2(model: Model) -> set[int]:
    return model.state.reconcile_responders if model.state.phase_two_timer.active else set()


# Of what


def _top(model: Model) -> bytes:
    return model.state.chain.top_chain_hash


def _chain_hashes(model: Model) -> list[bytes]:
    hashes = [model.state.chain.inception.chain_hash]
    for block in model.state.chain:
        hashes.append(next_chain_hash(hashes[-1], block.block_hash))
    return hashes


def _below(model: Model) -> bytes | None:
    """The chain without its top block."""
    hashes = _chain_hashes(model)
    return hashes[-2] if len(hashes) > 1 else None


def _top_block(model: Model) -> Block | None:
    *_, top = (None, *model.state.chain)
    return top


def _popped(model: Model) -> bytes | None:
    """The chain with the block that was popped last."""
    stack = model.state.reconcile_stack
    return next_chain_hash(_top(model), stack[-1].block_hash) if stack else None


def _candidate(model: Model) -> Block | None:
    state = model.state
    return state.candidate_block if state.voting_timer.active else None


def _chain_of_vote(model: Model) -> bytes | None:
    state = model.state
    return state.top_chain_hash_at_initiation if state.settings.vote_names_chain else None


@_input(LOG)
def _log(model: Model) -> Action | None:
    return model.event()


@_input(TIMER, "timer")
def _expire(model: Model) -> Action | None:
    return None if model.agent.next_timer() is None else Expire()


@_input("operator reconciles")
def _reconcile(model: Model) -> Action | None:
    return Command("reconcile")


# Block Add Request

_message("Block Add Request on the agent's chain", lambda model: BlockAddRequest(UNKNOWN, _top(model)))
_message("Block Add Request on an unknown chain", lambda model: BlockAddRequest(UNKNOWN, UNKNOWN))
_message(
    "Block Add Request on the chain below the top",
    lambda model: BlockAddRequest(UNKNOWN, below) if (below := _below(model)) else None,
)
_message(
    "Block Add Request for the agent's own candidate",
    lambda model: BlockAddRequest(block.block_hash, _top(model)) if (block := _candidate(model)) else None,
)
_message(
    "Block Add Request on the chain with the popped block",
    lambda model: BlockAddRequest(UNKNOWN, popped) if (popped := _popped(model)) else None,
)

# Block Add Response


def _vote(approve: bool) -> Callable[[Model], Message | None]:
    return lambda model: (
        BlockAddResponse(block.block_hash, approve, _chain_of_vote(model)) if (block := _candidate(model)) else None
    )


for _approve, _word in ((True, "yes"), (False, "no")):
    _message(f"vote {_word}", _vote(_approve), _nobody_yet(_voters), "voting")
    _message(f"vote {_word} of an agent that has voted", _vote(_approve), _again(_voters), "voting", f"vote {_word}")
    _message(
        f"vote {_word} for an unknown block",
        lambda model, approve=_approve: BlockAddResponse(UNKNOWN, approve, _chain_of_vote(model)),  # type: ignore[misc]
        _nobody_yet(_voters),
        "voting",
        f"vote {_word}",
    )
    _message(
        f"vote {_word} for the block on top of the chain",
        lambda model, approve=_approve: (  # type: ignore[misc]
            BlockAddResponse(top.block_hash, approve, _chain_of_vote(model)) if (top := _top_block(model)) else None
        ),
        _nobody_yet(_voters),
        "voting",
        f"vote {_word}",
    )
    _message(
        f"vote {_word} for the block that waits behind",
        lambda model, approve=_approve: (  # type: ignore[misc]
            BlockAddResponse(model.state.blocks_to_be_committed[1].block_hash, approve, _chain_of_vote(model))
            if len(model.state.blocks_to_be_committed) > 1
            else None
        ),
        _nobody_yet(_voters),
        "voting",
        f"vote {_word}",
    )
    _message(
        f"vote {_word} that names another chain",
        lambda model, approve=_approve: (  # type: ignore[misc]
            BlockAddResponse(block.block_hash, approve, UNKNOWN) if (block := _candidate(model)) else None
        ),
        _nobody_yet(_voters),
        "voting",
        f"vote {_word}",
    )
_message(
    "vote no that names no chain",
    lambda model: (
        BlockAddResponse(block.block_hash, False)
        if model.state.settings.vote_names_chain and (block := _candidate(model))
        else None
    ),
    _nobody_yet(_voters),
    "voting",
    "vote no",
)

# Commit Block


def _succeeding(model: Model, block: Block) -> CommitBlock:
    return CommitBlock(block, next_chain_hash(_top(model), block.block_hash))


for _young, _word in ((False, "old"), (True, "young")):
    _message(
        f"Commit Block of a new {_word} block that succeeds the top",
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
        if (below := _below(model))
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
            query(below) if len(model.state.chain) > 1 and (below := _below(model)) else None
        ),
    )
    _message(f"{_query.NAME} about an unknown chain", lambda model, query=_query: query(UNKNOWN))  # type: ignore[misc]
    _message(
        f"{_query.NAME} about the chain with the popped block",
        lambda model, query=_query: query(popped) if (popped := _popped(model)) else None,  # type: ignore[misc]
    )
_message(
    "Chain Contain Query that names a block's hash",
    lambda model: ChainContainQuery(top.block_hash) if (top := _top_block(model)) else None,
)

# Chain Contain Response

for _contained, _word in ((True, "yes"), (False, "no")):
    for _who, _sender in (("", _nobody_yet(_of_phase_1)), (" of an agent that has answered", _again(_of_phase_1))):
        _message(
            f"Chain Contain Response {_word}{_who}",
            lambda model, contained=_contained: ChainContainResponse(_top(model), contained),  # type: ignore[misc]
            _sender,
            "phase one",
            f"Chain Contain Response {_word}" if _who else None,
        )
    _message(
        f"Chain Contain Response {_word} about an unknown chain",
        lambda model, contained=_contained: ChainContainResponse(UNKNOWN, contained),  # type: ignore[misc]
        _nobody_yet(_of_phase_1),
        "phase one",
        f"Chain Contain Response {_word}",
    )
    _message(
        f"Chain Contain Response {_word} about the chain with the popped block",
        lambda model, contained=_contained: (  # type: ignore[misc]
            ChainContainResponse(popped, contained) if (popped := _popped(model)) else None
        ),
        _nobody_yet(_of_phase_1),
        "phase one",
        f"Chain Contain Response {_word}",
    )

# Next in Sequence Response


def _phase_two(model: Model) -> bool:
    return model.state.phase_two_timer.active


def _next_new(*, young: bool) -> Callable[[Model], Message | None]:
    def make(model: Model) -> Message:
        block = model.new_block(PEERS[1], young=young)
        return NextInSequenceResponse(_top(model), block.block_hash, block.timestamp_us)

    return make


def _next(candidate: Callable[[Model], Block | None]) -> Callable[[Model], Message | None]:
    def make(model: Model) -> Message | None:
        block = candidate(model)
        return None if block is None else NextInSequenceResponse(_top(model), block.block_hash, block.timestamp_us)

    return make


def _named_block(model: Model) -> Block | None:
    """The block that was named first in this phase 2."""
    named = [candidate for candidate in model.state.reconcile_response_dictionary if candidate != IS_TOP_OF_CHAIN]
    return model.blocks.get(named[0]) if _phase_two(model) and named else None


def _of_stack(place: int) -> Callable[[Model], Block | None]:
    """From the top of the stack: 1, 2."""
    return lambda model: model.state.reconcile_stack[-place] if len(model.state.reconcile_stack) >= place else None


def _waiting(model: Model) -> Block | None:
    return model.state.blocks_to_be_committed[0] if model.state.blocks_to_be_committed else None


for _name, _says in {
    "Is Top Of Chain, old": lambda model: NextInSequenceResponse(_top(model), None, OLD_US),
    "Is Top Of Chain, young": lambda model: NextInSequenceResponse(_top(model), None, YOUNG_US),
    "an old new block": _next_new(young=False),
    "a young new block": _next_new(young=True),
    "the block that was named first": _next(_named_block),
    "the block on top of the stack": _next(_of_stack(1)),
    "the second block of the stack": _next(_of_stack(2)),
    "the top block itself": _next(_top_block),
    "a block of the agent's deque": _next(_waiting),
}.items():
    _message(f"Next in Sequence Response: {_name}", _says, _nobody_yet(_of_phase_2), "phase two")
_COUNTED = {
    "Is Top Of Chain": "Next in Sequence Response: Is Top Of Chain, old",
    "an old new block": "Next in Sequence Response: an old new block",
    "the block that was named first": "Next in Sequence Response: the block that was named first",
}
for _name, _says in {
    "Is Top Of Chain": lambda model: NextInSequenceResponse(_top(model), None, OLD_US),
    "an old new block": _next_new(young=False),
    "the block that was named first": _next(_named_block),
}.items():
    _message(
        f"Next in Sequence Response of an agent that has answered: {_name}",
        _says,
        _again(_of_phase_2),
        "phase two",
        _COUNTED[_name],
    )
_message(
    "Next in Sequence Response about an unknown chain",
    lambda model: NextInSequenceResponse(
        UNKNOWN, (block := model.new_block(PEERS[1], young=False)).block_hash, block.timestamp_us
    ),
    _nobody_yet(_of_phase_2),
    "phase two",
    "Next in Sequence Response: an old new block",
)
_message(
    "Next in Sequence Response about the chain with the popped block",
    lambda model: NextInSequenceResponse(popped, None, OLD_US) if (popped := _popped(model)) else None,
    _nobody_yet(_of_phase_2),
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
    lambda model: RequestForBlock(block.block_hash) if (block := _waiting(model)) else None,
)
_message(
    "Request for Block: the inception block",
    lambda model: RequestForBlock(model.state.chain.inception.block_hash),
)


def _asked_for(model: Model) -> Message | None:
    wanted = model.state.majority_response_block_hash
    return BlockResponse(model.blocks[wanted]) if model.state.phase_three_timer.active and wanted else None


_message("Block Response: the block asked for", _asked_for)
_message("Block Response: another block", lambda model: BlockResponse(model.new_block(PEERS[1], young=False)))
_message(
    "Block Response: the top block",
    lambda model: BlockResponse(top) if (top := _top_block(model)) else None,
)


def _then_timer(given: Input) -> Input:
    return Input(f"{given.name}, and the timer ends", given.make, "timer", given.as_if, given.name)


INPUTS |= {then.name: then for then in [_then_timer(given) for given in INPUTS.values() if given.as_if is not None]}
