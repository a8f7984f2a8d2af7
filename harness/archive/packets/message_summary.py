"""What a message says, without its bytes: all that is kept of each datagram."""

from typing import NamedTuple

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

RESPONSES: dict[str, str] = {
    BlockAddRequest.NAME: BlockAddResponse.NAME,
    ChainContainQuery.NAME: ChainContainResponse.NAME,
    ChainHashSuccessorQuery.NAME: NextInSequenceResponse.NAME,
    RequestForBlock.NAME: BlockResponse.NAME,
}
"""Request -> its response; a Commit Block is neither."""

CARRY_A_BLOCK = frozenset((CommitBlock.NAME, BlockResponse.NAME))
TOP_OF_CHAIN = "top of chain"


class MessageSummary(NamedTuple):
    """`message` is its name, all that is known of one that is sealed.

    `answer` is what a response answers: approve, disapprove, yes, no, top of chain, block.
    """

    message: str
    block_hash: bytes | None
    chain_hash: bytes | None
    answer: str | None = None

    @property
    def is_sealed(self) -> bool:
        """Whether it is not known what it says: every message names a block or a chain."""
        return self.block_hash is None and self.chain_hash is None

    @property
    def asks(self) -> tuple[str, bytes | None] | None:
        """The subject of a request, equal to what its responses `answers`; responses do not name the asker."""
        response = RESPONSES.get(self.message)
        return None if response is None or self.is_sealed else (response, self._subject)

    @property
    def answers(self) -> tuple[str, bytes | None] | None:
        return None if self.answer is None else (self.message, self._subject)

    @property
    def _subject(self) -> bytes | None:
        """A successor is asked for by chain and named by block; all else that names a block is about the block."""
        return self.chain_hash if self.message == NextInSequenceResponse.NAME else self.block_hash or self.chain_hash


def summarize(message: Message) -> MessageSummary:
    match message:
        case BlockAddRequest(block_hash, chain_hash):
            return MessageSummary(message.NAME, block_hash, chain_hash)
        case BlockAddResponse(block_hash, approve, chain_hash):
            return MessageSummary(message.NAME, block_hash, chain_hash, "approve" if approve else "disapprove")
        case CommitBlock(block, chain_hash):
            return MessageSummary(message.NAME, block.block_hash, chain_hash)
        case ChainContainQuery(chain_hash) | ChainHashSuccessorQuery(chain_hash):
            return MessageSummary(message.NAME, None, chain_hash)
        case ChainContainResponse(chain_hash, contained):
            return MessageSummary(message.NAME, None, chain_hash, "yes" if contained else "no")
        case NextInSequenceResponse(chain_hash, block_hash, _):
            return MessageSummary(message.NAME, block_hash, chain_hash, "block" if block_hash else TOP_OF_CHAIN)
        case RequestForBlock(block_hash):
            return MessageSummary(message.NAME, block_hash, None)
        case BlockResponse(block):
            return MessageSummary(message.NAME, block.block_hash, None, "block")
