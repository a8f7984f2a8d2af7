"""The nine messages as a story tells them: "Block Add Request (1.1 on inception)"."""

import base64
import binascii
from collections.abc import Callable
from typing import Any, Protocol

from harness.report.stories.story_names import Names
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
from ucp.trace import Sent


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
        return f"{sent.message} (not on record)"
    try:
        message = decode(base64.b64decode(sent.datagram.text, validate=True)).message
    except (MalformedDatagramError, binascii.Error):
        return f"{sent.message} (not well-formed)"
    return in_words(message, names)


def in_words(message: Message, names: Naming) -> str:
    """ "Chain Contain Query (1.1 2.1)"."""
    return f"{message.NAME} ({_SAYS[type(message)](message, names)})"
