"""Test cases about the disk: a full disk, and restarts with the data of a killed agent."""

import signal
from collections.abc import Callable
from pathlib import Path

from harness.conformance._reference_model import AGENT, PEERS
from harness.conformance.cases._bench import (
    INCEPTION,
    AgentEndedError,
    BenchAgent,
    CannotJudgeError,
    CaseBench,
    case,
    require,
)
from harness.play.agent_control import AgentRefusedError
from ucp.block import Block, next_chain_hash
from ucp.messages import BlockAddRequest, ChainContainQuery, ChainContainResponse, CommitBlock

STORE_FILE = "kept"
STORE = {"store": STORE_FILE, "features": ["store"]}


@case("a full disk ends the trace, and the agent continues", "contract, The program")
async def _full(bench: CaseBench) -> None:
    bench.require_own_machine("the disk")

    def prepare(directory: Path) -> None:
        (directory / f"{AGENT}.trace.jsonl").symlink_to("/dev/full")

    async with bench.program(prepare=prepare) as agent:
        try:
            await agent.process.ready()
        except AgentEndedError as error:
            raise CannotJudgeError(f"the agent cannot use /dev/full, which simulates a full disk: {error}") from None
        await agent.begin()
        await agent.require_single_answer(INCEPTION, "its trace could not be written")
        await agent.log(b"event")
        await agent.receive(2, "a Block Add Request and a Commit Block")


@case("an export that cannot be written gives an error and exit status 1", "contract, The program")
async def _no_export(bench: CaseBench) -> None:
    bench.require_own_machine("the disk")

    def prepare(directory: Path) -> None:
        (directory / f"{AGENT}.chain.json" / "in the way").mkdir(parents=True)

    async with bench.agent(prepare=prepare) as agent:
        try:
            await agent.process.ask("export")
            require(False, "`ok` false to export", "`ok` true")
        except AgentRefusedError:
            pass
        await agent.process.send_signal(signal.SIGTERM)
        returned = await agent.end()
        require(returned == 1, "exit status 1", f"status {returned}")


async def _commit(agent: BenchAgent, count: int) -> list[Block]:
    """Make the agent commit blocks of another agent, and return the committed blocks."""
    blocks, top = [], INCEPTION
    for number in range(count):
        block = Block(PEERS[0], number + 1, b"block %d" % number)
        top = next_chain_hash(top, block.block_hash)
        agent.send(PEERS[0], CommitBlock(block, top))
        blocks.append(block)
    await agent.require_single_answer(top, f"{count} commits")
    return blocks


async def _require_restart(bench: CaseBench, damage: Callable[[Path], None] | None) -> None:
    port = bench.lab.take_port()
    try:
        async with bench.agent(STORE, port=port) as first:
            blocks = await _commit(first, 3)
            await first.log(b"event")
            (proposed,) = await first.receive(1, "a Block Add Request")
            directory = first.process.directory
        if damage is not None:
            damage(directory / STORE_FILE)
        async with bench.agent(STORE, port=port, directory=directory) as second:
            (again,) = await second.receive(1, "the proposal of the waiting block from the restarted agent")
            require(again == proposed, "the proposal of the waiting block", again.NAME)
            assert isinstance(proposed, BlockAddRequest)
            export = await second.process.export()
            held = [block["block_hash"] for block in export["chain"]]
            require(held == [block.block_hash.hex() for block in blocks], "the three blocks of its chain", held)
            require(export["completed"] == [proposed.block_hash.hex()], "its completed block", export["completed"])
    finally:
        bench.lab.return_port(port)


@case("a killed agent restarts with its chain, and proposes the waiting block", "contract, Store", 20)
async def _reboot(bench: CaseBench) -> None:
    await _require_restart(bench, None)


@case("a store with a truncated end is valid up to its last whole entry", "contract, Store", 20)
async def _torn(bench: CaseBench) -> None:
    bench.require_own_machine("the store")

    def damage(path: Path) -> None:
        with path.open("ab") as file:
            file.write(b"\x00half an ent")

    await _require_restart(bench, damage)


@case("an agent killed during a reconcile restores its stack at the restart", "contract, Store", 20)
async def _reboot_in_reconcile(bench: CaseBench) -> None:
    port = bench.lab.take_port()
    try:
        async with bench.agent(STORE, port=port) as first:
            blocks = await _commit(first, 2)
            await first.process.ask("reconcile")
            (query,) = await first.receive(1, "a Chain Contain Query")
            require(isinstance(query, ChainContainQuery), "a Chain Contain Query", query.NAME)
            assert isinstance(query, ChainContainQuery)
            first.send(PEERS[0], ChainContainResponse(query.chain_hash, False))
            (below,) = await first.receive(1, "a Chain Contain Query about the chain below")
            require(below != query and below.NAME == query.NAME, "a query about the chain below", below.NAME)
            directory = first.process.directory
        async with bench.agent(STORE, port=port, directory=directory) as second:
            (back,) = await second.receive(1, "a Commit Block with the block of the stack")
            right = CommitBlock(blocks[1], query.chain_hash)
            require(back == right, "a Commit Block with the block of the stack", back.NAME)
            await second.require_single_answer(query.chain_hash, "it came back")
    finally:
        bench.lab.return_port(port)
