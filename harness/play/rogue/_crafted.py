"""Create datagrams that no agent sent, with the packet library `ucp.scapy`."""

from collections.abc import Callable, Sequence
from random import Random
from typing import Any

from scapy.packet import Packet

from ucp.block import HASH_BYTES
from ucp.events import MAX_EVENT_BYTES
from ucp.messages import Message
from ucp.scapy import LAYERS, UCP, Block, CommitBlock, LoggableEvent, to_layer
from ucp.wire import FieldKind

FORGED_EVENT_ID = 1
FORGED_DATA = b"forged by a rogue node"


def datagram(sender: int, sequence: int, message: Message | Packet) -> bytes:
    layer = message if isinstance(message, Packet) else to_layer(message)
    return bytes(UCP(sender=sender, sequence=sequence) / layer)


def forged_block(agent_id: int, timestamp_us: int) -> Block:
    """Return a forged block in the name of the agent."""
    event = LoggableEvent(timestamp_us=timestamp_us, event_id=FORGED_EVENT_ID, data=FORGED_DATA)
    return Block(agent_id=agent_id, events=[event])


def forged_commit(block: Block, chain_hash: bytes) -> CommitBlock:
    """Return a Commit Block message. `chain_hash` is the chain hash directly after the block."""
    return CommitBlock(chain_hash=chain_hash, block=block)


def random_message(name: str | None, roster: Sequence[int], timestamp_us: int, rng: Random) -> Packet:
    """Return a valid message with random content. If `name` is None, the type of the message is random, too. The block
    in the message names an agent of the roster.
    """

    def block() -> Block:
        data = rng.randbytes(rng.randint(1, MAX_EVENT_BYTES))
        event = LoggableEvent(timestamp_us=timestamp_us, event_id=rng.randint(1, 254), data=data)
        return Block(agent_id=rng.choice(roster), events=[event])

    content: dict[FieldKind, Callable[[], Any]] = {
        FieldKind.U64: lambda: timestamp_us,
        FieldKind.FLAG: lambda: rng.getrandbits(1),
        FieldKind.HASH: lambda: rng.randbytes(HASH_BYTES),
        FieldKind.OPTIONAL_HASH: lambda: rng.choice([None, rng.randbytes(HASH_BYTES)]),
        FieldKind.BLOCK: block,
    }
    message, layer = rng.choice([(message, layer) for message, layer in LAYERS.items() if name in (None, message.NAME)])
    return layer(**{field: content[kind]() for field, kind in message.WIRE.items()})


def corrupted(data: bytes, bits: int, rng: Random) -> bytes:
    """Return a copy of the datagram in which `bits` randomly chosen bits are inverted."""
    flipped = bytearray(data)
    for bit in rng.sample(range(8 * len(data)), min(bits, 8 * len(data))):
        flipped[bit // 8] ^= 1 << bit % 8
    return bytes(flipped)
