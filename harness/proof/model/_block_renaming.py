"""Exchange the blocks in an agent's state for other blocks. The prover thus treats states as equal that differ only in
the identity of their blocks.

The exchange is correct because agents compare blocks only for equality. The one exception is a tie of phase 2
(Algorithm 15), which compares the ages of two blocks. With `Bounds.clocks_any`, either block may be the older one.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache

from harness.proof.model._snapshot import Snapshot, replaced
from ucp.block import Block, InceptionBlock, next_chain_hash
from ucp.chain import Chain
from ucp.messages import Message

Ordinals = tuple[int, ...]
"""Numbers of blocks. A block's number is its position among all completed blocks, counted from 1."""
Completed = tuple[bytes, int, int]
"""A completed block: its hash, the number of the agent that completed it, and its ordinal."""


class NumberedBlocks:
    """An index of all known blocks and chains by number and by hash."""

    def __init__(self, inception: InceptionBlock, make: Callable[[int], Block]) -> None:
        self.numbers: dict[bytes, int] = {}
        """Block hash -> ordinal."""
        self.makers: dict[bytes, int] = {}
        """Block hash -> agent that completed the block."""
        self.completed: list[Completed] = []
        """The completed blocks in the order in which they became known."""
        self._inception = inception
        self._chains: dict[bytes, Ordinals] = {inception.chain_hash: ()}
        """Chain hash -> ordinals of the chain's blocks, the oldest first."""
        self._block = cache(make)

    def note_completed(self, blocks: Iterable[Completed]) -> None:
        """Add blocks that an agent has completed, in this process or in a worker process."""
        for block_hash, agent_id, ordinal in blocks:
            if block_hash not in self.makers:
                self.makers[block_hash] = agent_id
                self.numbers[block_hash] = ordinal
                self.completed.append((block_hash, agent_id, ordinal))

    def completed_by(self, agent_id: int, ordinal: int) -> bytes:
        """Return the hash of the block with this number, which this agent has completed."""
        return next(made for made, maker, number in self.completed if (maker, number) == (agent_id, ordinal))

    def in_words(self, block_hash: str) -> str:
        """Return the name of the block with this hash, for text output."""
        ordinal = self.numbers.get(bytes.fromhex(block_hash))
        return f"#{ordinal}" if ordinal else block_hash[:12]

    def learn_chain(self, chain: Chain) -> None:
        below: Ordinals = ()
        for block, chain_hash in chain.with_chain_hashes():
            below = self._chains[chain_hash] = (*below, *self.named(block.block_hash))

    def learn_chain_hash(self, chain_hash: bytes, ordinals: Ordinals) -> None:
        self._chains[chain_hash] = ordinals

    def named(self, digest: bytes) -> Ordinals:
        """Return the numbers of the blocks to which a hash refers: one block for a block hash, all blocks of the chain
        for a chain hash.

        The result is empty for an unknown hash.
        """
        number = self.numbers.get(digest)
        return self._chains.get(digest, ()) if number is None else (number,)

    def named_in(self, message: Message) -> frozenset[int]:
        """Return the ordinals of the blocks in a message: the block that it contains or names, and all blocks of the
        chains that it names.
        """
        fields = (getattr(message, name) for name in message.__slots__)
        hashes = [field.block_hash if isinstance(field, Block) else field for field in fields]
        return frozenset().union(*(self.named(digest) for digest in hashes if isinstance(digest, bytes)))

    def of(self, snapshot: Snapshot) -> Ordinals:
        """Return the numbers of the blocks that occur in an agent's state, without repetition. If two states differ
        only in their blocks, corresponding blocks are at the same position in both results.
        """
        return tuple(dict.fromkeys(self._all(snapshot)))

    def _all(self, snapshot: Snapshot) -> Iterable[int]:
        numbers = self.numbers
        held = (snapshot["chain"].parts["_blocks"], snapshot["blocks_to_be_committed"], snapshot["reconcile_stack"])
        for place in held:
            yield from (numbers[block.block_hash] for block in place)
        if snapshot["candidate_block"] is not None:
            yield numbers[snapshot["candidate_block"].block_hash]
        if snapshot["majority_response_block_hash"] is not None:
            yield numbers[snapshot["majority_response_block_hash"]]
        yield from self._chains.get(snapshot["top_chain_hash_at_initiation"], ())
        candidates = snapshot["reconcile_response_dictionary"]
        yield from sorted(numbers[candidate] for candidate in candidates if candidate)

    def exchanged(self, snapshot: Snapshot, exchange: Mapping[int, int]) -> Snapshot:
        """Return the agent's state with other blocks in place of its blocks. `exchange` maps the number of each block
        to the number of its replacement.
        """
        us = {self._block(old).timestamp_us: self._block(new).timestamp_us for old, new in exchange.items()}

        def block_of(block: Block) -> Block:
            return self._block(exchange[self.numbers[block.block_hash]])

        def hash_of(digest: bytes) -> bytes:
            number = self.numbers.get(digest)
            if number is not None:
                return self._block(exchange[number]).block_hash
            return self._chain_hash([exchange[ordinal] for ordinal in self._chains[digest]]) if digest else digest

        after = {name: replaced(value, hash_of, block_of) for name, value in snapshot.items()}
        for counted in after["reconcile_response_dictionary"].values():
            counted[1] = us.get(counted[1], 0)
        return after

    def _chain_hash(self, ordinals: Sequence[int]) -> bytes:
        chain_hash = self._inception.chain_hash
        for count, ordinal in enumerate(ordinals, 1):
            chain_hash = next_chain_hash(chain_hash, self._block(ordinal).block_hash)
            self._chains.setdefault(chain_hash, tuple(ordinals[:count]))
        return chain_hash
