"""Test cases about blocks and votes, and about malformed datagrams, datagrams of unknown senders, and floods."""

import asyncio
import time
from collections import Counter
from random import Random

from harness.conformance._reference_model import PEERS, STRANGER
from harness.conformance._state_space import VARIANTS
from harness.conformance.cases._bench import INCEPTION, SPEEDUP, CaseBench, case, require
from ucp.block import Block, next_chain_hash
from ucp.contract.vectors import drop_vectors
from ucp.events import decode_events
from ucp.messages import (
    BlockAddRequest,
    BlockAddResponse,
    BlockResponse,
    ChainContainQuery,
    CommitBlock,
    RequestForBlock,
    decode,
    encode,
)

SMALL_BLOCKS = {**VARIANTS["default"].settings.to_json(), "max_block_bytes": 1024, "max_event_bytes": 267}
FULL_FROM = 1024 - 267
EVENT_DATA_BYTES = 100


@case("a block is full when an event of maximum size might not fit", "Section 3.6.1", 1)
async def _full(bench: CaseBench) -> None:
    async with bench.agent({"settings": SMALL_BLOCKS}) as agent:
        size, count = 0, 0
        while size < FULL_FROM:
            await agent.receive_nothing(f"is proposed with {size} bytes of events", 0.05)
            await agent.log(b"%03d" % count + bytes(EVENT_DATA_BYTES - 3))
            size, count = size + 11 + EVENT_DATA_BYTES, count + 1
        proposed, committed = await agent.receive(2, "a Block Add Request, and a Commit Block when the vote is over")
        if not isinstance(proposed, BlockAddRequest) or not isinstance(committed, CommitBlock):
            require(False, "a Block Add Request, then a Commit Block", f"{proposed.NAME}, {committed.NAME}")
            return
        block = committed.block
        require(proposed.block_hash == block.block_hash, "the block that was proposed", block.block_hash.hex())
        require(
            committed.chain_hash == next_chain_hash(INCEPTION, block.block_hash), "the block's own chain hash", "not"
        )
        events = decode_events(block.event_data)
        order = [int(event.data[:3]) for event in events]
        require(order == list(range(count)), f"{count} events, the oldest first", order)
        newest = events[-1].timestamp_us
        require(
            block.timestamp_us == newest, "the timestamp of its newest event", f"{block.timestamp_us - newest} us off"
        )


@case("votes of the previous vote do not count", "Section 3.6.2", 2)
async def _votes(bench: CaseBench) -> None:
    async with bench.agent() as agent:
        await agent.log(b"event")
        (proposed,) = await agent.receive(1, "a Block Add Request")
        require(isinstance(proposed, BlockAddRequest), "a Block Add Request", proposed.NAME)
        assert isinstance(proposed, BlockAddRequest)
        for peer in PEERS[:2]:
            agent.send(peer, BlockAddResponse(proposed.block_hash, False))
        query, again, committed = await agent.receive(
            3, "Chain Contain Query, then the proposal again, then its commit, because no agent answers", 10.0
        )
        require(isinstance(query, ChainContainQuery), "a Chain Contain Query after the vote is lost", query.NAME)
        require(again == proposed, "the same Block Add Request after a reconcile that no agent answers", again.NAME)
        require(
            isinstance(committed, CommitBlock), "a Commit Block, because no agent disapproved this time", committed.NAME
        )


@case("an agent that is stopped at the end of its vote decides once, late", "contract, Time", 5)
async def _stopped(bench: CaseBench) -> None:
    async with bench.agent() as agent:
        await agent.log(b"event")
        await agent.receive(1, "a Block Add Request")
        await agent.process.pause()
        await agent.receive_nothing("while it is stopped", 25.0 / SPEEDUP)
        await agent.process.resume()
        (committed,) = await agent.receive(1, "a Commit Block when it goes on")
        require(isinstance(committed, CommitBlock), "a Commit Block when it goes on", committed.NAME)
        await agent.receive_nothing("after that")


FLOOD = 3000
BATCH = 50


@case("malformed datagrams are dropped and change nothing", "contract, Datagrams")
async def _malformed(bench: CaseBench) -> None:
    keys = {"agent_id": drop_vectors.AGENT_ID, "roster": list(drop_vectors.ROSTER)}
    async with bench.agent(keys) as agent:
        before = await agent.status()
        for what, data in drop_vectors.cases():
            if drop_vectors.dropped(data) is None:
                continue
            agent.peer_socket.send(data)
            agent.send(drop_vectors.SENDER, ChainContainQuery(INCEPTION))
            (received,) = await agent.receive(1, f"an answer after a datagram that is {what}")
            require(
                received.NAME == "Chain Contain Response", f"nothing comes of a datagram that is {what}", received.NAME
            )
        after = await agent.status()
        reasons = Counter(filter(None, (drop_vectors.dropped(data) for _, data in drop_vectors.cases())))
        require(after.get("dropped", reasons) == reasons, f"`dropped` {dict(reasons)}", after.get("dropped"))
        require(after["chain"] == before["chain"], "the chain stays as it was", f"{after['chain']} blocks")


@case("messages in the agent's own name, or of a sender not on the roster, are dropped", "contract, Datagrams")
async def _strangers(bench: CaseBench) -> None:
    async with bench.agent() as agent:
        for sender in (agent.agent_id, STRANGER):
            agent.send(sender, ChainContainQuery(INCEPTION))
            agent.send(sender, BlockAddRequest(bytes(32), INCEPTION))
        await agent.require_single_answer(INCEPTION, "messages of itself and of a stranger")


@case("a block of an agent not on the roster is not committed", "contract, Datagrams", 6)
async def _strange_block(bench: CaseBench) -> None:
    async with bench.agent() as agent:
        block = Block(STRANGER, 5, b"whatever")
        agent.send(PEERS[0], CommitBlock(block, next_chain_hash(INCEPTION, block.block_hash)))
        await agent.require_single_answer(INCEPTION, "a Commit Block of a stranger's block")


@case("datagrams carry the agent's ID, and sequence numbers that start at 0", "contract, Datagrams")
async def _sequence(bench: CaseBench) -> None:
    async with bench.agent() as agent:
        for _ in range(5):
            agent.send(PEERS[0], ChainContainQuery(INCEPTION))
        await agent.receive(5, "five answers")
        sent = [decode(data) for _, by_agent, data in agent.peer_socket.record if by_agent]
        require(
            {each.sender for each in sent} == {agent.agent_id}, "its own ID as sender", [each.sender for each in sent]
        )
        numbers = [each.sequence for each in sent]
        require(numbers == list(range(len(sent))), "sequence numbers 0, 1, 2, 3, 4", numbers)


@case("a block of maximum size is committed, and sent byte for byte", "contract, Bytes", 17)
async def _largest_block(bench: CaseBench) -> None:
    async with bench.agent() as agent:
        block = Block(PEERS[1], 2**64 - 1, bytes(range(256)) * 4)
        agent.send(PEERS[0], CommitBlock(block, next_chain_hash(INCEPTION, block.block_hash)))
        agent.send(PEERS[0], RequestForBlock(block.block_hash))
        (received,) = await agent.receive(1, "a Block Response")
        require(received == BlockResponse(block), "the block as it was", received.NAME)


@case("a query that arrives twice is answered twice", "contract, Datagrams", 9)
async def _twice(bench: CaseBench) -> None:
    async with bench.agent() as agent:
        data = encode(PEERS[0], 7, ChainContainQuery(INCEPTION))
        agent.peer_socket.send(data)
        agent.peer_socket.send(data)
        received = await agent.receive(2, "two answers to the same datagram, sent twice")
        require(received[0] == received[1], "the same answer twice", [each.NAME for each in received])


@case("a flood of noise and of unrequested answers changes nothing", "Section 4.1")
async def _flood(bench: CaseBench) -> None:
    rng = Random(1)
    async with bench.agent() as agent:
        for number in range(FLOOD):
            block = Block(PEERS[0], number + 1, b"flood")
            noise = rng.randbytes(rng.randrange(1, 1400))
            agent.peer_socket.send(noise if number % 2 else encode(PEERS[0], number, BlockResponse(block)))
            if number % BATCH == 0:
                await asyncio.sleep(0.01)
        for _ in range(100):  # the buffer of the agent's socket may be full, so ask again
            agent.send(PEERS[0], ChainContainQuery(INCEPTION))
            await agent.peer_socket.arrival(time.time() + 0.1)
            if agent.peer_socket.received:
                break
        (received, *_) = await agent.receive(1, "an answer after the flood")
        require(received.NAME == "Chain Contain Response", "an answer after the flood", received.NAME)
        status = await agent.status()
        require(status["chain"] == 0, "an empty chain after the flood", f"{status['chain']} blocks")
