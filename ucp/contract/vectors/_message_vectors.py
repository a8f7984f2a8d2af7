"""Test vectors for messages: the datagram of each message, with all its fields."""

from collections.abc import Iterator
from typing import Any

from ucp.block import Block, hash_digest
from ucp.contract.vectors._hash_vectors import BLOCKS
from ucp.messages import (
    TYPE_CODES,
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
    encode,
)

BLOCK_HASH, CHAIN_HASH = hash_digest(b"a block"), hash_digest(b"a chain")

MESSAGES: tuple[tuple[int, int, Message], ...] = (
    (7, 0, BlockAddRequest(BLOCK_HASH, CHAIN_HASH)),
    (28, 1, BlockAddResponse(BLOCK_HASH, True)),
    (28, 2, BlockAddResponse(BLOCK_HASH, False)),
    (28, 3, BlockAddResponse(BLOCK_HASH, True, CHAIN_HASH)),
    (7, 255, CommitBlock(BLOCKS[2], CHAIN_HASH)),
    (7, 256, CommitBlock(BLOCKS[-1], CHAIN_HASH)),
    (1, 65536, ChainContainQuery(CHAIN_HASH)),
    (65535, 2**32 - 1, ChainContainResponse(CHAIN_HASH, True)),
    (65535, 0, ChainContainResponse(CHAIN_HASH, False)),
    (256, 9, ChainHashSuccessorQuery(CHAIN_HASH)),
    (1, 10, NextInSequenceResponse(CHAIN_HASH, BLOCK_HASH, 1_795_258_278_064_591)),
    (1, 11, NextInSequenceResponse(CHAIN_HASH, None, 0)),
    (1, 12, RequestForBlock(BLOCK_HASH)),
    (1, 13, BlockResponse(BLOCKS[0])),
    (1, 14, BlockResponse(BLOCKS[3])),
)
"""The sender, sequence number and message of each vector."""


def vectors() -> list[dict[str, Any]]:
    """Return the test vectors. Hashes are in hexadecimal. A field that the message omits is null."""
    return [
        {
            "message": message.NAME,
            "type": TYPE_CODES[type(message)],
            "sender": sender,
            "sequence": sequence,
            "fields": dict(_fields(message)),
            "datagram": encode(sender, sequence, message),
        }
        for sender, sequence, message in MESSAGES
    ]


def _fields(message: Message) -> Iterator[tuple[str, Any]]:
    for name in message.WIRE:
        value = getattr(message, name)
        if isinstance(value, Block):
            event_data = value.event_data
            yield name, {"agent_id": value.agent_id, "timestamp_us": value.timestamp_us, "event_data": event_data}
        else:
            yield name, value.hex() if isinstance(value, bytes) else value
