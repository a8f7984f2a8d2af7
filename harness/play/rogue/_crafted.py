"""Datagrams that no agent has sent: crafted with `ucp.scapy`, or sealed with a captured vehicle's keys.

The group's secret opens everybody's datagrams, and makes the keys of any sender. What it does not make is another
vehicle's signature: so what is sealed here in another's name is signed with the captured vehicle's key, as there is no
other.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from random import Random
from typing import Any

from scapy.packet import Packet

from ucp.block import HASH_BYTES
from ucp.events import MAX_EVENT_BYTES
from ucp.messages import CARRY_A_BLOCK, MalformedDatagramError, Message
from ucp.scapy import LAYERS, UCP, Block, CommitBlock, LoggableEvent, to_layer
from ucp.secure.block_signature import sign_block
from ucp.secure.bundle import Bundle
from ucp.secure.envelope import read_clear
from ucp.secure.sealed_datagrams import Request
from ucp.secure.secured_agent import boot_of
from ucp.secure.session import Session
from ucp.wire import Kind

FORGED_EVENT_ID = 1
FORGED_DATA = b"forged by a rogue node"


def datagram(sender: int, sequence: int, message: Message | Packet) -> bytes:
    layer = message if isinstance(message, Packet) else to_layer(message)
    return bytes(UCP(sender=sender, sequence=sequence) / layer)


def forged_block(agent_id: int, timestamp_us: int) -> Block:
    """A block that claims to be the agent's."""
    event = LoggableEvent(timestamp_us=timestamp_us, event_id=FORGED_EVENT_ID, data=FORGED_DATA)
    return Block(agent_id=agent_id, events=[event])


def forged_commit(block: Block, chain_hash: bytes) -> CommitBlock:
    """`chain_hash` is the block's own at its place in the chain."""
    return CommitBlock(chain_hash=chain_hash, block=block)


def random_message(name: str | None, roster: Sequence[int], timestamp_us: int, rng: Random) -> Packet:
    """A well-formed message of this type (None: of any), with whatever content; a block in it is of the roster's."""

    def block() -> Block:
        data = rng.randbytes(rng.randint(1, MAX_EVENT_BYTES))
        event = LoggableEvent(timestamp_us=timestamp_us, event_id=rng.randint(1, 254), data=data)
        return Block(agent_id=rng.choice(roster), events=[event])

    content: dict[Kind, Callable[[], Any]] = {
        Kind.U64: lambda: timestamp_us,
        Kind.FLAG: lambda: rng.getrandbits(1),
        Kind.HASH: lambda: rng.randbytes(HASH_BYTES),
        Kind.OPTIONAL_HASH: lambda: rng.choice([None, rng.randbytes(HASH_BYTES)]),
        Kind.BLOCK: block,
    }
    message, layer = rng.choice([(message, layer) for message, layer in LAYERS.items() if name in (None, message.NAME)])
    return layer(**{field: content[kind]() for field, kind in message.WIRE.items()})


def corrupted(data: bytes, bits: int, rng: Random) -> bytes:
    """With so many of its bits flipped, or all if it has fewer."""
    flipped = bytearray(data)
    for bit in rng.sample(range(8 * len(data)), min(bits, 8 * len(data))):
        flipped[bit // 8] ^= 1 << bit % 8
    return bytes(flipped)


class CapturedKeys:
    """`chance` gives 8 bytes for each life that is made up. Times are mission seconds, and microseconds UTC."""

    def __init__(self, bundle: Bundle, chance: Callable[[], bytes]) -> None:
        self.agent_id = bundle.agent_id
        self._bundle = bundle
        self._chance = chance
        self._ear = self._session(bundle.agent_id, 0)
        self._mouths: dict[int, Session] = {}
        """By the sender in whose name it speaks."""
        self._signatures: dict[bytes, bytes] = {}
        """The makers', of all blocks that were on the air."""

    def opened(self, datagram: bytes, now: float) -> tuple[Message, Request] | None:
        """What a datagram says, and how an answer would name it; None if it is nothing new that can be opened."""
        self._ear.epochs.look_at(now)
        try:
            clear = read_clear(datagram)
            opened = self._ear.open(datagram, clear)
        except (MalformedDatagramError, KeyError):  # of a sender of another mission
            return None
        message = opened.said.message
        if type(message) in CARRY_A_BLOCK:
            self._signatures[message.block.block_hash] = opened.block_signature  # type: ignore[union-attr]
        return message, Request(clear.sender, clear.boot, clear.sequence)

    def sealed(
        self, sender: int, sequence: int, message: Message, request: Request | None, now: float, now_us: int
    ) -> bytes:
        """A datagram in the name of `sender`, as good as these keys can make it; each sequence is used once."""
        mouth = self._mouths.get(sender)
        if mouth is None:
            mouth = self._mouths[sender] = self._session(sender, now_us)
        mouth.epochs.look_at(now)
        signature = None
        if type(message) in CARRY_A_BLOCK:
            block = message.block  # type: ignore[union-attr]
            heard = self._signatures.get(block.block_hash)
            signature = heard or sign_block(mouth.private_key, mouth.mission, block.block_data())
        return mouth.seal(sequence, message, request, signature, 0)

    def _session(self, sender: int, now_us: int) -> Session:
        """A life of that sender, which began now: it is newer than its own."""
        return Session(replace(self._bundle, agent_id=sender), boot_of(now_us, self._chance()))
