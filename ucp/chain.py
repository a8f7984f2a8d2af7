"""The chain of an agent. It is a stack of blocks with the inception block at the bottom. Two dictionaries find a block
by its block hash and by its chain hash. Each query of a handler therefore takes one dictionary look-up, regardless of
the number of blocks.
"""

from collections.abc import Iterator

from ucp.block import Block, InceptionBlock, next_chain_hash


class Chain:
    """The chain of an agent: an inception block and the blocks that were committed after it.

    `len(chain)` does not count the inception block. Iteration omits it, and starts at the oldest other block.
    """

    def __init__(self, inception: InceptionBlock) -> None:
        self.inception = inception
        self.top_chain_hash = inception.chain_hash
        self._blocks: list[Block] = []
        self._chain_hashes: list[bytes] = [inception.chain_hash]
        self._height_of_chain_hash: dict[bytes, int] = {inception.chain_hash: 0}
        self._block_of_hash: dict[bytes, Block] = {}

    def __len__(self) -> int:
        return len(self._blocks)

    def __iter__(self) -> Iterator[Block]:
        return iter(self._blocks)

    def __contains__(self, block_hash: bytes) -> bool:
        return block_hash in self._block_of_hash

    def with_chain_hashes(self) -> Iterator[tuple[Block, bytes]]:
        """Yield each block except the inception block, with its chain hash. The oldest is first."""
        return zip(self._blocks, self._chain_hashes[1:], strict=True)

    @property
    def top_timestamp_us(self) -> int:
        """The timestamp of the top block in microseconds; 0 for the inception block."""
        return self._blocks[-1].timestamp_us if self._blocks else 0

    def get(self, block_hash: bytes) -> Block | None:
        return self._block_of_hash.get(block_hash)

    def contains_chain_hash(self, chain_hash: bytes) -> bool:
        return chain_hash in self._height_of_chain_hash

    def successor(self, chain_hash: bytes) -> Block | None:
        """Return the block that follows the block with this chain hash. Return None for the top block. Raises KeyError
        if the chain hash is unknown.
        """
        height = self._height_of_chain_hash[chain_hash]
        return self._blocks[height] if height < len(self._blocks) else None

    def append(self, block: Block) -> None:
        """Append a block to the chain (eq. 3.2). Raises ValueError if the chain already contains it."""
        if block.block_hash in self._block_of_hash:
            raise ValueError(f"block {block.block_hash.hex()} is in the chain already")
        chain_hash = next_chain_hash(self.top_chain_hash, block.block_hash)
        self._blocks.append(block)
        self._chain_hashes.append(chain_hash)
        self._height_of_chain_hash[chain_hash] = len(self._blocks)
        self._block_of_hash[block.block_hash] = block
        self.top_chain_hash = chain_hash

    def pop(self) -> Block:
        """Remove the newest block and return it. Raises IndexError if the chain is empty."""
        if not self._blocks:
            raise IndexError("the inception block is never popped")
        block = self._blocks.pop()
        del self._block_of_hash[block.block_hash]
        del self._height_of_chain_hash[self._chain_hashes.pop()]
        self.top_chain_hash = self._chain_hashes[-1]
        return block
