"""Test cases about blocks and votes: the size of a block, and the independence of successive votes."""

from harness.conformance._reference_model import PEERS
from harness.conformance._state_space import VARIANTS
from harness.conformance.cases._bench import INCEPTION, SPEEDUP, CaseBench, case, require
from ucp.block import next_chain_hash
from ucp.events import decode_events
from ucp.messages import BlockAddRequest, BlockAddResponse, ChainContainQuery, CommitBlock

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
