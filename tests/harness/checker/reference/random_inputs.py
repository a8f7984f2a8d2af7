"""Create random inputs for an agent: messages, events, timer expiries and requests to reconcile."""

from collections.abc import Callable
from random import Random

from harness.checker.reference.reference_agent import ReferenceAgent
from ucp.agent import Agent
from ucp.block import Block, next_chain_hash
from ucp.events import LoggableEvent
from ucp.messages import (
    BlockAddRequest,
    BlockAddResponse,
    BlockResponse,
    ChainContainQuery,
    ChainContainResponse,
    ChainHashSuccessorQuery,
    CommitBlock,
    Datagram,
    Message,
    NextInSequenceResponse,
    RequestForBlock,
)
from ucp.trace import RecordedBytes

ROSTER = range(1, 6)
LIFE = 250
"""Number of inputs that an agent gets before it reboots with its stored data, or before a new agent with other settings
takes its place.
"""

Give = Callable[[Agent | ReferenceAgent], None]


class Inputs:
    """A generator of random inputs for an agent. Some inputs fit the state of the agent, some nearly fit it, and some
    do not fit it at all.

    Timestamps of blocks are below `newest_us`. If `newest_us` is small, some timestamps are equal.
    """

    def __init__(self, rng: Random, newest_us: int = 1_000) -> None:
        self.rng = rng
        events = [LoggableEvent(rng.randrange(newest_us), 1, rng.randbytes(4)) for _ in range(12)]
        self.blocks = [Block(rng.choice(ROSTER), event.timestamp_us, event.encode()) for event in events]
        self.heard: list[Message] = []

    def draw(self, core: Agent, number: int, now: float) -> tuple[float, Give]:
        """Return the time of the input with this number, and a function that gives the input to an agent."""
        rng, ends = self.rng, core.next_timer()
        draw = rng.random()
        if draw < 0.08 and ends is not None:
            now = max(now, ends)
            return now, lambda agent: agent.handle_timer(now)
        if draw < 0.12:
            event = self.event()
            return now, lambda agent: agent.add_event(event, now)
        if draw < 0.13:
            return now, lambda agent: agent.begin_reconcile(now)
        datagram = Datagram(rng.choice(ROSTER), number, self.message(core))

        def give(agent: Agent | ReferenceAgent) -> None:
            if isinstance(agent, Agent):
                agent.receive_message(*datagram, now, RecordedBytes(content=datagram))
            else:
                agent.receive_message(*datagram, now)

        return now, give

    def message(self, agent: Agent) -> Message:
        rng, state = self.rng, agent.state
        if self.heard and rng.random() < 0.1:
            return rng.choice(self.heard)
        held = [*state.chain, *state.blocks_to_be_committed, *state.reconcile_stack]
        block = rng.choice(held if held and rng.random() < 0.5 else self.blocks)
        top = state.chain.top_chain_hash
        below = [state.chain.inception.chain_hash, *(chain_hash for _, chain_hash in state.chain.with_chain_hashes())]
        chain_hash = rng.choice((top, top, rng.choice(below), rng.choice(self.blocks).block_hash))
        asked = state.majority_response_block_hash
        wanted = next((each for each in (*held, *self.blocks) if each.block_hash == asked), block)
        candidate = state.candidate_block.block_hash if state.candidate_block else block.block_hash
        named = rng.choice((None, state.top_chain_hash_at_initiation, chain_hash))
        yes = rng.random() < 0.5
        message: Message = rng.choice(
            (
                BlockAddRequest(block.block_hash, chain_hash),
                BlockAddResponse(rng.choice((candidate, block.block_hash)), yes, named or None),
                CommitBlock(block, next_chain_hash(chain_hash, block.block_hash)),
                ChainContainQuery(chain_hash),
                ChainContainResponse(chain_hash, yes),
                ChainHashSuccessorQuery(chain_hash),
                NextInSequenceResponse(chain_hash, block.block_hash if yes else None, block.timestamp_us),
                RequestForBlock(block.block_hash),
                BlockResponse(rng.choice((wanted, block))),
            )
        )
        self.heard.append(message)
        return message

    def event(self) -> LoggableEvent:
        rng = self.rng
        return LoggableEvent(rng.randrange(1_000), rng.randint(1, 254), bytes(rng.choice((0, 40, 256))))
