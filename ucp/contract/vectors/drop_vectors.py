"""Test vectors for dropped datagrams: datagrams that an agent must drop, and similar datagrams that it must handle."""

from collections.abc import Iterator

from ucp.agent import Agent
from ucp.block import Block
from ucp.contract.vectors._message_vectors import BLOCK_HASH, CHAIN_HASH
from ucp.messages import HEADER, MAGIC, MAX_DATAGRAM_BYTES, VERSION, CommitBlock, encode

AGENT_ID = 7
ROSTER = (1, 7, 28)
SENDER = 28
HASH_2 = BLOCK_HASH + CHAIN_HASH
STRANGER = 5
"""The ID of an agent that is not on the roster."""


def datagram(code: int, body: bytes, *, sender: int = SENDER, length: int | None = None) -> bytes:
    """Return a datagram of this type with this body. The datagram may be invalid."""
    return HEADER.pack(MAGIC, VERSION, code, sender, 1, len(body) if length is None else length) + body


def block(agent_id: int, data_bytes: int = 12) -> bytes:
    """Return the encoded form of a block."""
    return agent_id.to_bytes(4, "big") + (1_000_000).to_bytes(8, "big") + b"\x01" * data_bytes


def cases() -> Iterator[tuple[str, bytes]]:
    """Yield each datagram with its description and the reason why it is dropped."""
    good = datagram(1, HASH_2)
    yield "a good one", good
    yield "nothing at all", b""
    yield "half a header", good[:7]
    yield "one byte less than a header", good[:13]
    yield "a header alone, of type 1", datagram(1, b"")
    yield "one byte too large, of a type that has no length", datagram(1, bytes(MAX_DATAGRAM_BYTES - 13))
    yield "as large as can be, with a body that type 1 cannot have", datagram(1, bytes(MAX_DATAGRAM_BYTES - 14))
    yield "too large, and not even UCP", bytes(MAX_DATAGRAM_BYTES + 1)
    yield "magic in lower case", b"uc" + good[2:]
    yield "version 0", good[:2] + b"\x00" + good[3:]
    yield "version 2", good[:2] + b"\x02" + good[3:]
    yield "wrong magic and wrong version", b"XX\x09" + good[3:]
    yield "sender 0", datagram(1, HASH_2, sender=0)
    yield "sender 65536", datagram(1, HASH_2, sender=65536)
    yield "sender 0, and a wrong length", datagram(1, HASH_2, sender=0, length=3)
    yield "a length one too small", datagram(1, HASH_2, length=63)
    yield "a length one too large", datagram(1, HASH_2, length=65)
    yield "cut off by the last byte", good[:-1]
    yield "one byte behind the body", good + b"\x00"
    yield "type 0", datagram(0, HASH_2)
    yield "type 10", datagram(10, HASH_2)
    yield "type 255, with a wrong length", datagram(255, HASH_2, length=1)
    for code, right in ((1, 64), (2, 33), (2, 65), (4, 32), (5, 33), (6, 32), (7, 40), (7, 72), (8, 32)):
        for size in (right - 1, right, right + 1):
            yield f"type {code} with a body of {size} bytes", datagram(code, b"\x01" * size)
    for code in (2, 5):
        yield f"type {code} without a body", datagram(code, b"")
        yield f"type {code} with the vote 2", datagram(code, b"\x02" + BLOCK_HASH)
        yield f"type {code} with the vote 255", datagram(code, b"\xff" + BLOCK_HASH)
        yield f"type {code} with the vote 2 and a wrong length", datagram(code, b"\x02\x00")
    yield "type 7 with a body of 8 bytes", datagram(7, bytes(8))
    for code, before in ((3, CHAIN_HASH), (9, b"")):
        yield f"type {code} without a body", datagram(code, b"")
        for size in (0, 1, 1024, 1025):
            yield f"type {code} with {size} bytes of event data", datagram(code, before + block(SENDER, size))
        yield f"type {code} with half a block header", datagram(code, before + block(SENDER)[:11])
        yield f"type {code} with a block of agent 0", datagram(code, before + block(0))
        yield f"type {code} with a block of agent 65536", datagram(code, before + block(65536))
        yield f"type {code} with a block of agent {STRANGER}", datagram(code, before + block(STRANGER))
        yield f"type {code} with a block of the agent itself", datagram(code, before + block(AGENT_ID))
    yield "type 3 with half a chain hash", datagram(3, CHAIN_HASH[:16])
    yield "the agent's own", datagram(1, HASH_2, sender=AGENT_ID)
    yield "the agent's own, with a block of a stranger", encode(AGENT_ID, 0, CommitBlock(Block(5, 1, b"x"), CHAIN_HASH))
    yield "of a stranger", datagram(1, HASH_2, sender=STRANGER)
    yield "of a stranger, malformed", datagram(2, b"\x02", sender=STRANGER)
    yield "of a stranger, with a block of a stranger", datagram(9, block(STRANGER), sender=STRANGER)


def vectors() -> dict[str, object]:
    """Return the test vectors. `dropped` is the reason for a drop, or null if the agent must handle the datagram."""
    return {
        "agent_id": AGENT_ID,
        "roster": ROSTER,
        "datagrams": [{"what": what, "datagram": data, "dropped": dropped(data)} for what, data in cases()],
    }


def dropped(data: bytes) -> str | None:
    """Return the reason why a new agent drops the datagram. Return None if the agent handles it."""
    agent = Agent(AGENT_ID, ROSTER, b"")
    agent.receive_datagram(data, 0.0)
    return next(iter(agent.dropped), None)
