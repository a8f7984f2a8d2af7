"""Name the blocks, chains and messages in a story file."""

import base64
import binascii
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

from harness.archive.traces import Trace
from ucp.block import InceptionBlock, next_chain_hash
from ucp.messages import (
    BlockAddRequest,
    BlockAddResponse,
    BlockResponse,
    ChainContainQuery,
    ChainContainResponse,
    ChainHashSuccessorQuery,
    CommitBlock,
    MalformedDatagramError,
    Message,
    NextInSequenceResponse,
    RequestForBlock,
    decode,
)
from ucp.trace import HandlerRun, SentMessage

INCEPTION = "inception"
MAX_FULL_CHAIN = 4
"""Maximum length of a chain whose name lists all of its blocks. The name of a longer chain consists of its first and
last blocks.
"""


class LocalChain:
    """The chain of an agent according to the agent's trace: block hashes and chain hashes, with the oldest first."""

    def __init__(self, trace: Trace) -> None:
        try:
            data = base64.b64decode(trace.header.initial_data or "")
        except binascii.Error:
            data = b""
        self.chain_hashes = [InceptionBlock(data).chain_hash]
        self.blocks: list[str] = []

    def replay(self, run: HandlerRun) -> None:
        """Apply the changes of the next handler run to the chain. Ignore changes that are impossible."""
        for operation, block in run.changes:
            if operation == "chain+":
                self.blocks.append(block)
                self.chain_hashes.append(next_chain_hash(self.chain_hashes[-1], _digest(block)))
            elif operation == "chain-" and self.blocks:
                self.blocks.pop()
                self.chain_hashes.pop()


def _digest(block_hash: str) -> bytes:
    """Return the bytes of a hexadecimal hash. Return empty bytes if the text is not a hash."""
    try:
        return bytes.fromhex(block_hash)
    except ValueError:
        return b""


class StoryNames:
    """The names of all blocks, such as "1.1". The figures of the thesis use the same form. The name of a chain lists
    the names of its blocks.
    """

    def __init__(self, traces: Mapping[int, Trace]) -> None:
        self._blocks = {
            block: f"{agent_id}.{ordinal}"
            for agent_id, trace in traces.items()
            for ordinal, block in enumerate(dict.fromkeys(trace.completed()), 1)
        }
        self._chains: dict[bytes, list[str]] = {}
        for trace in traces.values():
            for life in trace.incarnations():
                chain = LocalChain(trace)
                self._chains[chain.chain_hashes[0]] = []
                for _, run in life:
                    chain.replay(run)
                    self._chains.setdefault(chain.chain_hashes[-1], self.of(chain.blocks))

    def block(self, block_hash: str) -> str:
        """Return the name of a block, such as "1.1"."""
        return self._blocks.get(block_hash, "an unknown block")

    def of(self, block_hashes: Sequence[str]) -> list[str]:
        return [self.block(block_hash) for block_hash in block_hashes]

    def chain(self, chain_hash: bytes) -> str:
        """Return the name of a chain, such as "1.1 2.1". The name of a long chain has the form "1.1 .. 4.2"."""
        blocks = self._chains.get(chain_hash)
        return "an unknown chain" if blocks is None else _chain_text(blocks)

    def chain_below(self, chain_hash: bytes) -> str:
        """Return the name of the chain without its top block."""
        blocks = self._chains.get(chain_hash)
        return "an unknown chain" if not blocks else _chain_text(blocks[:-1])


def _chain_text(blocks: Sequence[str]) -> str:
    if not blocks:
        return INCEPTION
    return " ".join(blocks) if len(blocks) <= MAX_FULL_CHAIN else f"{blocks[0]} .. {blocks[-1]}"


class NameSource(Protocol):
    """An object that returns names for blocks and chains."""

    def block(self, block_hash: str) -> str: ...

    def chain(self, chain_hash: bytes) -> str: ...

    def chain_below(self, chain_hash: bytes) -> str: ...


ANSWERS = frozenset(
    message.NAME for message in (BlockAddResponse, ChainContainResponse, NextInSequenceResponse, BlockResponse)
)
"""Names of the messages that answer the query or request of a single agent."""

_FORMATS: dict[type[Message], Callable[[Any, NameSource], str]] = {
    BlockAddRequest: lambda message, names: (
        f"{names.block(message.block_hash.hex())} on {names.chain(message.chain_hash)}"
    ),
    BlockAddResponse: lambda message, names: (
        f"{names.block(message.block_hash.hex())}: {'approve' if message.approve else 'disapprove'}"
    ),
    CommitBlock: lambda message, names: (
        f"{names.block(message.block.block_hash.hex())} on {names.chain_below(message.chain_hash)}"
    ),
    ChainContainQuery: lambda message, names: names.chain(message.chain_hash),
    ChainContainResponse: lambda message, names: (
        f"{names.chain(message.chain_hash)}: {'yes' if message.contained else 'no'}"
    ),
    ChainHashSuccessorQuery: lambda message, names: names.chain(message.chain_hash),
    NextInSequenceResponse: lambda message, names: (
        f"{names.chain(message.chain_hash)}: "
        f"{names.block(message.block_hash.hex()) if message.block_hash else 'Is Top Of Chain'}"
    ),
    RequestForBlock: lambda message, names: names.block(message.block_hash.hex()),
    BlockResponse: lambda message, names: names.block(message.block.block_hash.hex()),
}


def message_text(sent: SentMessage, names: StoryNames) -> str:
    """Return the text of a message in a trace."""
    if sent.datagram is None:
        return f"{sent.message} (not recorded)"
    try:
        message = decode(base64.b64decode(sent.datagram.text, validate=True)).message
    except (MalformedDatagramError, binascii.Error):
        return f"{sent.message} (not well-formed)"
    return in_words(message, names)


def in_words(message: Message, names: NameSource) -> str:
    """Return a text about a message, such as "Chain Contain Query (1.1 2.1)"."""
    return f"{message.NAME} ({_FORMATS[type(message)](message, names)})"
