"""Deliberate errors in operations that several handlers share: computing the chain hash, and sending."""

from ucp.block import Block, next_chain_hash
from ucp.core import Core
from ucp.messages import Message
from ucp.quirks._quirk import Helper, quirk


@quirk(5, 6, 16, 18, 20, helper=Core.commit)
def swap_chain_hash(good: Helper, core: Core, block: Block) -> None:
    """The chain hash is computed from the block hash and the chain hash in the wrong order."""
    chain_hash = core.chain.top_chain_hash
    good(core, block)
    core.chain.top_chain_hash = next_chain_hash(block.block_hash, chain_hash)


@quirk(2, 3, 5, 8, 9, 12, 13, 16, 17, 20, helper=Core.send)
def say_everything_twice(good: Helper, core: Core, message: Message) -> None:
    """The agent sends every message twice."""
    good(core, message)
    good(core, message)
