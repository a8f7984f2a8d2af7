"""Datagrams: what is none, what is not for the agent, and too many of them."""

import asyncio
import time
from collections import Counter
from random import Random

from harness.conformance._reference_model import PEERS, STRANGER
from harness.conformance.cases._bench import INCEPTION, Bench, case, must
from ucp.block import Block, next_chain_hash
from ucp.contract.vectors import drop_vectors
from ucp.messages import (
    BlockAddRequest,
    BlockResponse,
    ChainContainQuery,
    CommitBlock,
    RequestForBlock,
    decode,
    encode,
)

FLOOD = 3000
AT_ONCE = 50


@case("malformed datagrams are dropped and change nothing", "contract, Datagrams")
async def _malformed(bench: Bench) -> None:
    keys = {"agent_id": drop_vectors.AGENT_ID, "roster": list(drop_vectors.ROSTER)}
    async with bench.agent(keys) as agent:
        before = await agent.status()
        for what, data in drop_vectors.cases():
            if drop_vectors.dropped(data) is None:
                continue
            agent.ear.say(data)
            agent.say(drop_vectors.SENDER, ChainContainQuery(INCEPTION))
            (heard,) = await agent.hear(1, f"an answer after a datagram that is {what}")
            must(heard.NAME == "Chain Contain Response", f"nothing comes of a datagram that is {what}", heard.NAME)
        after = await agent.status()
        reasons = Counter(filter(None, (drop_vectors.dropped(data) for _, data in drop_vectors.cases())))
        must(after.get("dropped", reasons) == reasons, f"`dropped` {dict(reasons)}", after.get("dropped"))
        must(after["chain"] == before["chain"], "the chain stays as it was", f"{after['chain']} blocks")


@case("messages in the agent's own name, or of a sender not on the roster, are dropped", "contract, Datagrams")
async def _strangers(bench: Bench) -> None:
    async with bench.agent() as agent:
        for sender in (agent.agent_id, STRANGER):
            agent.say(sender, ChainContainQuery(INCEPTION))
            agent.say(sender, BlockAddRequest(bytes(32), INCEPTION))
        await agent.answers_only(INCEPTION, "messages of itself and of a stranger")


@case("a block of an agent not on the roster is not committed", "contract, Datagrams", 6)
async def _strange_block(bench: Bench) -> None:
    async with bench.agent() as agent:
        block = Block(STRANGER, 5, b"whatever")
        agent.say(PEERS[0], CommitBlock(block, next_chain_hash(INCEPTION, block.block_hash)))
        await agent.answers_only(INCEPTION, "a Commit Block of a stranger's block")


@case("datagrams carry the agent's ID, and sequence numbers that start at 0", "contract, Datagrams")
async def _sequence(bench: Bench) -> None:
    async with bench.agent() as agent:
        for _ in range(5):
            agent.say(PEERS[0], ChainContainQuery(INCEPTION))
        await agent.hear(5, "five answers")
        sent = [decode(data) for _, by_agent, data in agent.ear.record if by_agent]
        must({each.sender for each in sent} == {agent.agent_id}, "its own ID as sender", [each.sender for each in sent])
        numbers = [each.sequence for each in sent]
        must(numbers == list(range(len(sent))), "sequence numbers 0, 1, 2, 3, 4", numbers)


@case("a block of maximum size is committed, and sent byte for byte", "contract, Bytes", 17)
async def _largest_block(bench: Bench) -> None:
    async with bench.agent() as agent:
        block = Block(PEERS[1], 2**64 - 1, bytes(range(256)) * 4)
        agent.say(PEERS[0], CommitBlock(block, next_chain_hash(INCEPTION, block.block_hash)))
        agent.say(PEERS[0], RequestForBlock(block.block_hash))
        (heard,) = await agent.hear(1, "a Block Response")
        must(heard == BlockResponse(block), "the block as it was", heard.NAME)


@case("a query that arrives twice is answered twice", "contract, Datagrams", 9)
async def _twice(bench: Bench) -> None:
    async with bench.agent() as agent:
        data = encode(PEERS[0], 7, ChainContainQuery(INCEPTION))
        agent.ear.say(data)
        agent.ear.say(data)
        heard = await agent.hear(2, "two answers to the same datagram, sent twice")
        must(heard[0] == heard[1], "the same answer twice", [each.NAME for each in heard])


@case("a flood of noise and of unrequested answers changes nothing", "Section 4.1")
async def _flood(bench: Bench) -> None:
    lots = Random(1)
    async with bench.agent() as agent:
        for number in range(FLOOD):
            block = Block(PEERS[0], number + 1, b"flood")
            noise = lots.randbytes(lots.randrange(1, 1400))
            agent.ear.say(noise if number % 2 else encode(PEERS[0], number, BlockResponse(block)))
            if number % AT_ONCE == 0:
                await asyncio.sleep(0.01)
        for _ in range(100):  # what the flood has left in its socket's buffer is lost
            agent.say(PEERS[0], ChainContainQuery(INCEPTION))
            await agent.ear.arrival(time.time() + 0.1)
            if agent.ear.heard:
                break
        (heard, *_) = await agent.hear(1, "an answer after the flood")
        must(heard.NAME == "Chain Contain Response", "an answer after the flood", heard.NAME)
        status = await agent.status()
        must(status["chain"] == 0, "an empty chain after the flood", f"{status['chain']} blocks")
