"""Names of blocks, chains and messages in a story."""

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
from ucp.trace import HandlerRun, Sent

INCEPTION = "inception"
SPELT_OUT = 4
"""Longer chains are named by their ends."""


class LocalChain:
    """An agent's chain as its trace has it grow: hashes of its blocks, and the chain hash of each, the oldest first."""

    def __init__(self, trace: Trace) -> None:
        try:
            data = base64.b64decode(trace.header.initial_data or "")
        except binascii.Error:
            data = b""
        self.chain_hashes = [InceptionBlock(data).chain_hash]
        self.blocks: list[str] = []

    def replay(self, run: HandlerRun) -> None:
        """The changes of the next run. What cannot be, such as a block that goes without being on top, is as it may."""
        for operation, block in run.changes:
            if operation == "chain+":
                self.blocks.append(block)
                self.chain_hashes.append(next_chain_hash(self.chain_hashes[-1], _digest(block)))
            elif operation == "chain-" and self.blocks:
                self.blocks.pop()
                self.chain_hashes.pop()


def _digest(block_hash: str) -> bytes:
    """Of what is no hash, none: nobody else has named a chain with it."""
    try:
        return bytes.fromhex(block_hash)
    except ValueError:
        return b""


class Names:
    """Blocks are named as in the thesis's figures, chains by their blocks."""

    def __init__(self, traces: Mapping[int, Trace]) -> None:
        self._blocks = {
            block: f"{agent_id}.{ordinal}"
            for agent_id, trace in traces.items()
            for ordinal, block in enumerate(dict.fromkeys(trace.completed()), 1)
        }
        self._chains: dict[bytes, list[str]] = {}
        for trace in traces.values():
            for life in trace.lives():
                chain = LocalChain(trace)
                self._chains[chain.chain_hashes[0]] = []
                for _, run in life:
                    chain.replay(run)
                    self._chains.setdefault(chain.chain_hashes[-1], self.of(chain.blocks))

    def block(self, block_hash: str) -> str:
        """ "1.1"."""
        return self._blocks.get(block_hash, "an unknown block")

    def of(self, block_hashes: Sequence[str]) -> list[str]:
        return [self.block(block_hash) for block_hash in block_hashes]

    def chain(self, chain_hash: bytes) -> str:
        """ "1.1 2.1", or "1.1 .. 4.2" of a long one."""
        blocks = self._chains.get(chain_hash)
        return "an unknown chain" if blocks is None else _spelt(blocks)

    def chain_below(self, chain_hash: bytes) -> str:
        """The chain that the top block of this one went on top of."""
        blocks = self._chains.get(chain_hash)
        return "an unknown chain" if not blocks else _spelt(blocks[:-1])


def _spelt(blocks: Sequence[str]) -> str:
    if not blocks:
        return INCEPTION
    return " ".join(blocks) if len(blocks) <= SPELT_OUT else f"{blocks[0]} .. {blocks[-1]}"


class Naming(Protocol):
    """What knows how blocks and chains are called."""

    def block(self, block_hash: str) -> str: ...

    def chain(self, chain_hash: bytes) -> str: ...

    def chain_below(self, chain_hash: bytes) -> str: ...


ANSWERS = frozenset(
    message.NAME for message in (BlockAddResponse, ChainContainResponse, NextInSequenceResponse, BlockResponse)
)
"""They are for whoever asked."""

_SAYS: dict[type[Message], Callable[[Any, Naming], str]] = {
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


def told(sent: Sent, names: Names) -> str:
    """A message that an agent's trace has."""
    if sent.datagram is None:
        return f"{sent.message} (not recorded)"
    try:
        message = decode(base64.b64decode(sent.datagram.text, validate=True)).message
    except (MalformedDatagramError, binascii.Error):
        return f"{sent.message} (not well-formed)"
    return in_words(message, names)


def in_words(message: Message, names: Naming) -> str:
    """ "Chain Contain Query (1.1 2.1)"."""
    return f"{message.NAME} ({_SAYS[type(message)](message, names)})"
