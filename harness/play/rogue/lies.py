"""Create the forged message that an entry `lie` of the timeline describes. The entry names blocks and chains that the
rogue node knows.
"""

from collections.abc import Sequence

from harness.scenario.injection import Lie
from ucp.block import HASH_BYTES, Block, InceptionBlock, next_chain_hash
from ucp.clock import MICROSECONDS
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

NOBODYS = b"\xff" * HASH_BYTES
"""A hash that is the hash of no block. Forged messages contain it."""
MADE = "made "


class UnknownBlockError(Exception):
    """An error: a forged message refers to a block or chain that the rogue node has not received."""


class KnownBlocks:
    """An index of the blocks that the rogue node has received. For each agent, it lists the blocks in the order in
    which the agent proposed them. `initial_data` is the data of the inception block. `epoch_us` is mission second 0 on
    the agents' clocks, in microseconds.
    """

    def __init__(self, initial_data: bytes, epoch_us: int = 0) -> None:
        self._inception = InceptionBlock(initial_data).chain_hash
        self._epoch_us = epoch_us
        self._proposed: dict[int, list[bytes]] = {}
        self._blocks: dict[bytes, Block] = {}

    def receive(self, sender: int, message: Message) -> None:
        """Store the blocks and hashes of a message that an agent sent."""
        if isinstance(message, BlockAddRequest):
            proposed = self._proposed.setdefault(sender, [])
            if message.block_hash not in proposed:
                proposed.append(message.block_hash)
        elif isinstance(message, CommitBlock | BlockResponse):
            self._blocks[message.block.block_hash] = message.block

    def message(self, lie: Lie) -> Message:
        """Return the forged message that a timeline entry describes. Raises UnknownBlockError if it refers to unknown
        blocks.
        """
        of_block = NOBODYS if lie.block is None else self._hash(lie.sender, lie.block)
        of_chain = None if lie.chain is None else self._chain_hash(lie.sender, lie.chain)
        approve = bool(lie.approve)
        match lie.message, of_chain:
            case BlockAddResponse.NAME, _:
                return BlockAddResponse(of_block, approve, of_chain)
            case RequestForBlock.NAME, _:
                return RequestForBlock(of_block)
            case BlockResponse.NAME, _:
                return BlockResponse(self._block(of_block))
            case BlockAddRequest.NAME, bytes(chain_hash):
                return BlockAddRequest(of_block, chain_hash)
            case CommitBlock.NAME, bytes(chain_hash):
                return CommitBlock(self._block(of_block), next_chain_hash(chain_hash, of_block))
            case ChainContainQuery.NAME, bytes(chain_hash):
                return ChainContainQuery(chain_hash)
            case ChainContainResponse.NAME, bytes(chain_hash):
                return ChainContainResponse(chain_hash, approve)
            case ChainHashSuccessorQuery.NAME, bytes(chain_hash):
                return ChainHashSuccessorQuery(chain_hash)
            case NextInSequenceResponse.NAME, bytes(chain_hash):
                timestamp_us = self._epoch_us + round((lie.timestamp_s or 0.0) * MICROSECONDS)
                return NextInSequenceResponse(chain_hash, None if lie.block is None else of_block, timestamp_us)
        raise AssertionError("a lie needs a kind of message and all its fields")

    def _chain_hash(self, sender: int, chain: Sequence[str] | str) -> bytes:
        if isinstance(chain, str):
            return NOBODYS
        chain_hash = self._inception
        for name in chain:
            chain_hash = next_chain_hash(chain_hash, self._hash(sender, name))
        return chain_hash

    def _hash(self, sender: int, name: str) -> bytes:
        if name.startswith(MADE):
            timestamp_us = self._epoch_us + round(float(name.removeprefix(MADE)) * MICROSECONDS)
            block = made_block(sender, timestamp_us)
            self._blocks[block.block_hash] = block
            return block.block_hash
        maker, number = map(int, name.split("."))
        try:
            return self._proposed[maker][number - 1]
        except (KeyError, IndexError):
            raise UnknownBlockError(name) from None

    def _block(self, block_hash: bytes) -> Block:
        try:
            return self._blocks[block_hash]
        except KeyError:
            raise UnknownBlockError(block_hash.hex()) from None


def made_block(agent_id: int, timestamp_us: int) -> Block:
    """Return a forged block. The block contains the ID of an agent that never completed such a block."""
    return Block(agent_id, timestamp_us, LoggableEvent(timestamp_us, 1, b"made by its captor").encode())
