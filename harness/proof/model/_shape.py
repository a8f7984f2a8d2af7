"""Compute the shape of an agent's state. States that differ only in the identity of blocks and agents have the same
shape.

A shape identifies a block by its position among the blocks that the agent holds, sorted by timestamp and then by hash.
Blocks that the agent does not hold are only counted. Like the reductions of `_local_steps.py`, a shape omits parts that
are written before they are read. For a vote, a shape contains only whether more agents approve than disapprove. The
block under construction is omitted, because within the bounds of a proof each event fills a block.

Because of these omissions, a state of any run of any mission can have the same shape as a state within the bounds of a
proof.
"""

from bisect import bisect_left
from hashlib import blake2b
from itertools import chain
from typing import Any

from harness.checker.reference.state import ReferenceState
from ucp.block import Block, next_chain_hash
from ucp.messages import Message
from ucp.state import AgentState

Shape = tuple[Any, ...]

LEFT_OUT = frozenset(("current_block", "completed", "newest_block_timestamp_us", "voters", "reconcile_responders"))
"""Parts of an agent's state that are in a snapshot, but not in a shape: the parts about completing blocks, and the sets
of agents whose votes or answers are counted.
"""

ELSEWHERE = -1
"""The position that stands for a block that the agent does not hold."""
ON_TOP = "on top"
"""A name in a shape. It stands for the chain hash that the agent's chain would have after appending the block in the
message.
"""


class HeldBlockOrder:
    """The chain of an agent, and all blocks that the agent holds, sorted by age. The object is immutable."""

    __slots__ = ("_blocks", "_heights", "_numbers", "_ordinals", "_shape", "_top")

    def __init__(self, state: AgentState | ReferenceState) -> None:
        held = {
            block.block_hash: block.timestamp_us
            for block in chain(state.chain, state.blocks_to_be_committed, state.reconcile_stack)
        }
        self._blocks = sorted((timestamp_us, block_hash) for block_hash, timestamp_us in held.items())
        self._ordinals = ordinals = {block_hash: ordinal for ordinal, (_, block_hash) in enumerate(self._blocks)}
        chain_hash = state.chain.inception.chain_hash
        self._heights = {chain_hash: 0}
        for height, block in enumerate(state.chain, 1):
            chain_hash = next_chain_hash(chain_hash, block.block_hash)
            self._heights[chain_hash] = height
        self._top = state.chain.top_chain_hash
        self._numbers: dict[Shape, int] = {}
        self._shape = tuple(
            tuple([ordinals[block.block_hash] for block in place])
            for place in (state.chain, state.blocks_to_be_committed, state.reconcile_stack)
        )

    def number(self, shape: Shape) -> int:
        """Return 64 bits of the hash of a shape, as a number. The number is equal on all machines. The hash covers
        these held blocks and `shape`, which describes all other parts of a state, or of a state with an input.
        """
        number = self._numbers.get(shape)
        if number is None:
            digest = blake2b(repr((self._shape, shape)).encode(), digest_size=8).digest()
            number = self._numbers[shape] = int.from_bytes(digest, "big")
        return number

    def height(self, chain_hash: bytes) -> int:
        """Return the number of blocks in the chain up to this chain hash. Return ELSEWHERE if the agent does not know
        the chain hash.
        """
        return self._heights.get(chain_hash, ELSEWHERE)

    def ordinal(self, block_hash: bytes) -> int:
        """Return the position of this block among the blocks that the agent holds. Return ELSEWHERE if it does not hold
        the block.
        """
        return self._ordinals.get(block_hash, ELSEWHERE)

    def between(self, timestamp_us: int, block_hash: bytes = b"") -> int:
        """Return the number of held blocks that are older than this timestamp. With equal timestamps, the block hash
        decides.
        """
        return bisect_left(self._blocks, (timestamp_us, block_hash))

    def input_shape(self, message: Message) -> Shape:
        """Return the shape of a message that this agent receives.

        The shape identifies blocks by their positions among the blocks that the agent holds. The shape does not contain
        the sender.
        """
        values = [getattr(message, name) for name in type(message).__slots__]
        about = next((value for value in values if isinstance(value, bytes | Block)), b"")
        if isinstance(about, Block):
            about = about.block_hash
        return (type(message).NAME, *[self._named(value, about) for value in values])

    def _named(self, value: Any, about: bytes) -> Any:
        if isinstance(value, Block):
            ordinal = self.ordinal(value.block_hash)
            new = ordinal == ELSEWHERE
            return ("new", self.between(value.timestamp_us, value.block_hash)) if new else ("block", ordinal)
        if isinstance(value, bytes):
            if (ordinal := self.ordinal(value)) != ELSEWHERE:
                return "block", ordinal
            if (height := self.height(value)) != ELSEWHERE:
                return "chain", height
            return ON_TOP if value == next_chain_hash(self._top, about) else ELSEWHERE
        if value is None or isinstance(value, bool):
            return value
        return self.between(value)


def shape_of(state: AgentState | ReferenceState, held: HeldBlockOrder) -> Shape:
    """Return the shape of a state without the held blocks. This shape and the shape of `held` together identify the
    state.
    """
    shape: list[Any] = [state.reconcile_in_progress]
    for timer in state.timers:
        shape.append(1 if timer.deadline is not None else 2 if timer.active else 0)
    if state.voting_timer.active:
        candidate = state.candidate_block
        shape.append(ELSEWHERE if candidate is None else held.ordinal(candidate.block_hash))
        shape.append(held.height(state.top_chain_hash_at_initiation))
        shape.append(state.vote_count["yes"] > state.vote_count["no"])
    if state.phase_one_timer.active:
        shape += state.reconcile_vote_count.values()
    if state.phase_two_timer.active:
        offered = sorted(
            (timestamp_us, block_hash, count)
            for block_hash, (count, timestamp_us) in state.reconcile_response_dictionary.items()
        )
        for timestamp_us, block_hash, count in offered:
            if block_hash and (ordinal := held.ordinal(block_hash)) != ELSEWHERE:
                shape.append(("block", ordinal, count))
            else:
                shape.append(("new" if block_hash else "top", held.between(timestamp_us, block_hash), count))
    if state.phase_three_timer.active and state.majority_response_block_hash is not None:
        shape.append(held.ordinal(state.majority_response_block_hash))
    return tuple(shape)
