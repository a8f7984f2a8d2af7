"""Test vectors for the hashes of inception blocks, events, blocks and chains (eq. 3.1 to 3.5)."""

from ucp.block import MAX_AGENT_ID, MAX_EVENT_DATA_BYTES, Block, InceptionBlock
from ucp.chain import Chain
from ucp.events import LoggableEvent

INITIAL_DATA = (b"", b"test", b"UCP mission 7: survey of the north field", bytes(range(256)))

EVENTS = (
    LoggableEvent(0, 1, b""),
    LoggableEvent(1_795_258_278_064_591, 5, b"position"),
    LoggableEvent(2**64 - 1, 254, bytes(range(256))),
    LoggableEvent(1_000_000, 128, b"\x00\xff" * 16),
)

BLOCKS = (
    Block(1, 0, b"\x00"),
    Block(7, 1_795_258_278_064_591, EVENTS[1].encode()),
    Block(7, 1_795_258_278_064_592, EVENTS[1].encode() + EVENTS[3].encode()),
    Block(28, 1_000_000, EVENTS[3].encode()),
    Block(MAX_AGENT_ID, 2**64 - 1, bytes(MAX_EVENT_DATA_BYTES)),
)


def vectors() -> dict[str, object]:
    """Return the test vectors. `block_data` is the input of the block hash, and also the encoding of the block in
    messages.
    """
    return {
        "inception": [_inception(data) for data in INITIAL_DATA],
        "events": [_event(event) for event in EVENTS],
        "blocks": [_block(block) for block in BLOCKS],
        "chains": [_chain(INITIAL_DATA[1], BLOCKS), _chain(INITIAL_DATA[1], BLOCKS[::-1]), _chain(b"", BLOCKS[1:2])],
    }


def _inception(initial_data: bytes) -> dict[str, object]:
    block = InceptionBlock(initial_data)
    return {
        "initial_data": initial_data,
        "block_hash": block.block_hash.hex(),
        "chain_hash": block.chain_hash.hex(),
    }


def _event(event: LoggableEvent) -> dict[str, object]:
    return {
        "timestamp_us": event.timestamp_us,
        "event_id": event.event_id,
        "data": event.data,
        "encoded": event.encode(),
    }


def _block(block: Block) -> dict[str, object]:
    return {
        "agent_id": block.agent_id,
        "timestamp_us": block.timestamp_us,
        "event_data": block.event_data,
        "block_data": block.block_data(),
        "block_hash": block.block_hash.hex(),
    }


def _chain(initial_data: bytes, blocks: tuple[Block, ...]) -> dict[str, object]:
    chain = Chain(InceptionBlock(initial_data))
    for block in blocks:
        chain.append(block)
    return {
        "initial_data": initial_data,
        "inception_chain_hash": chain.inception.chain_hash.hex(),
        "blocks": [
            {"block_hash": block.block_hash.hex(), "chain_hash": chain_hash.hex()}
            for block, chain_hash in chain.with_chain_hashes()
        ],
    }
