"""Which blocks a local state is about, and the same state when other blocks stand for these.

Agents ask of blocks whether they are the same, and of two whether one is older only in a tie of phase 2 (Algorithm 15).
Where any may be the older (`Bounds.clocks_any`) it makes no difference which block is which.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache

from harness.proof.model._snapshot import Snapshot, replaced
from ucp.block import Block, InceptionBlock, next_chain_hash
from ucp.chain import Chain
from ucp.messages import Message

Ordinals = tuple[int, ...]
"""Blocks by number: the how manieth of all it is."""
Completed = tuple[bytes, int, int]
"""A block that was completed: its hash, of whom, by the agent's number here, and its number."""


class Blocks:
    """The blocks and chains that were come upon, by number and by hash."""

    def __init__(self, inception: InceptionBlock, make: Callable[[int], Block]) -> None:
        self.numbers: dict[bytes, int] = {}
        """Of a block, by its hash."""
        self.makers: dict[bytes, int] = {}
        """Who completed it, by its hash."""
        self.completed: list[Completed] = []
        """As they were."""
        self._inception = inception
        self._chains: dict[bytes, Ordinals] = {inception.chain_hash: ()}
        """The blocks of a chain, the oldest first, by its chain hash."""
        self._block = cache(make)

    def note_completed(self, blocks: Iterable[Completed]) -> None:
        """These blocks were completed, here or in another process."""
        for block_hash, agent_id, ordinal in blocks:
            if block_hash not in self.makers:
                self.makers[block_hash] = agent_id
                self.numbers[block_hash] = ordinal
                self.completed.append((block_hash, agent_id, ordinal))

    def completed_by(self, agent_id: int, ordinal: int) -> bytes:
        """The hash of the `ordinal`th block of all, which this agent has completed."""
        return next(made for made, maker, number in self.completed if (maker, number) == (agent_id, ordinal))

    def in_words(self, block_hash: str) -> str:
        """A block for people, by its hash."""
        ordinal = self.numbers.get(bytes.fromhex(block_hash))
        return f"#{ordinal}" if ordinal else block_hash[:12]

    def learn_chain(self, chain: Chain) -> None:
        below: Ordinals = ()
        for block, chain_hash in chain.with_chain_hashes():
            below = self._chains[chain_hash] = (*below, *self.named(block.block_hash))

    def learn_chain_hash(self, chain_hash: bytes, ordinals: Ordinals) -> None:
        self._chains[chain_hash] = ordinals

    def named(self, digest: bytes) -> Ordinals:
        """The blocks that a hash names: a block's itself, a chain's all of it; none if it is neither."""
        number = self.numbers.get(digest)
        return self._chains.get(digest, ()) if number is None else (number,)

    def named_in(self, message: Message) -> frozenset[int]:
        """The blocks that a message names, by themselves or as those of a chain."""
        fields = (getattr(message, name) for name in message.__slots__)
        hashes = [field.block_hash if isinstance(field, Block) else field for field in fields]
        return frozenset().union(*(self.named(digest) for digest in hashes if isinstance(digest, bytes)))

    def of(self, snapshot: Snapshot) -> Ordinals:
        """Which blocks the state is about, each once: in an order that is the same for states that are alike but for
        which block is which."""
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
        """The state with other blocks, by number, in the place of those that it is about."""
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
