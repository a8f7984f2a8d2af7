"""The disk: full, or what is left on it when the power comes back."""

import signal
from collections.abc import Callable
from pathlib import Path

from harness.conformance._reference_model import AGENT, PEERS
from harness.conformance.cases._bench import INCEPTION, AgentEndedError, Alone, Bench, CannotTellError, case, must
from harness.play.agent_control import AgentRefusedError
from ucp.block import Block, next_chain_hash
from ucp.messages import BlockAddRequest, ChainContainQuery, ChainContainResponse, CommitBlock

STORE_FILE = "kept"
STORE = {"store": STORE_FILE, "features": ["store"]}


@case("a full disk ends the trace, and the agent continues", "contract, The program")
async def _full(bench: Bench) -> None:
    def prepare(directory: Path) -> None:
        (directory / f"{AGENT}.trace.jsonl").symlink_to("/dev/full")

    async with bench.program(prepare=prepare) as agent:
        try:
            await agent.process.ready()
        except AgentEndedError as error:
            raise CannotTellError(f"it does not take /dev/full, which stands for a full disk: {error}") from None
        await agent.begin()
        await agent.answers_only(INCEPTION, "its trace could not be written")
        await agent.log(b"event")
        await agent.hear(2, "a Block Add Request and a Commit Block")


@case("an export that cannot be written gives an error and exit status 1", "contract, The program")
async def _no_export(bench: Bench) -> None:
    def prepare(directory: Path) -> None:
        (directory / f"{AGENT}.chain.json" / "in the way").mkdir(parents=True)

    async with bench.agent(prepare=prepare) as agent:
        try:
            await agent.process.ask("export")
            must(False, "`ok` false to export", "`ok` true")
        except AgentRefusedError:
            pass
        await agent.process.send_signal(signal.SIGTERM)
        returned = await agent.end()
        must(returned == 1, "exit status 1", f"status {returned}")


async def _commit(agent: Alone, count: int) -> list[Block]:
    """So many blocks of a peer come onto its chain."""
    blocks, top = [], INCEPTION
    for number in range(count):
        block = Block(PEERS[0], number + 1, b"block %d" % number)
        top = next_chain_hash(top, block.block_hash)
        agent.say(PEERS[0], CommitBlock(block, top))
        blocks.append(block)
    await agent.answers_only(top, f"{count} commits")
    return blocks


async def _comes_back(bench: Bench, spoil: Callable[[Path], None] | None) -> None:
    port = bench.air.take_port()
    try:
        async with bench.agent(STORE, port=port) as first:
            blocks = await _commit(first, 3)
            await first.log(b"event")
            (proposed,) = await first.hear(1, "a Block Add Request")
            directory = first.process.directory
        if spoil is not None:
            spoil(directory / STORE_FILE)
        async with bench.agent(STORE, port=port, directory=directory) as second:
            (again,) = await second.hear(1, "the proposal of the waiting block from the restarted agent")
            must(again == proposed, "the proposal of the waiting block", again.NAME)
            assert isinstance(proposed, BlockAddRequest)
            export = await second.process.export()
            held = [block["block_hash"] for block in export["chain"]]
            must(held == [block.block_hash.hex() for block in blocks], "the three blocks of its chain", held)
            must(export["completed"] == [proposed.block_hash.hex()], "its completed block", export["completed"])
    finally:
        bench.air.give_back(port)


@case("a killed agent restarts with its chain, and proposes the waiting block", "contract, Store", 20)
async def _reboot(bench: Bench) -> None:
    await _comes_back(bench, None)


@case("a store with a truncated end is valid up to its last whole entry", "contract, Store", 20)
async def _torn(bench: Bench) -> None:
    def spoil(path: Path) -> None:
        with path.open("ab") as file:
            file.write(b"\x00half an ent")

    await _comes_back(bench, spoil)


@case("an agent killed during a reconcile restores its stack at the restart", "contract, Store", 20)
async def _reboot_in_reconcile(bench: Bench) -> None:
    port = bench.air.take_port()
    try:
        async with bench.agent(STORE, port=port) as first:
            blocks = await _commit(first, 2)
            await first.process.ask("reconcile")
            (asked,) = await first.hear(1, "a Chain Contain Query")
            must(isinstance(asked, ChainContainQuery), "a Chain Contain Query", asked.NAME)
            assert isinstance(asked, ChainContainQuery)
            first.say(PEERS[0], ChainContainResponse(asked.chain_hash, False))
            (below,) = await first.hear(1, "a Chain Contain Query about the chain below")
            must(below != asked and below.NAME == asked.NAME, "a query about the chain below", below.NAME)
            directory = first.process.directory
        async with bench.agent(STORE, port=port, directory=directory) as second:
            (back,) = await second.hear(1, "a Commit Block of what was on the stack")
            right = CommitBlock(blocks[1], asked.chain_hash)
            must(back == right, "a Commit Block of what was on the stack", back.NAME)
            await second.answers_only(asked.chain_hash, "it came back")
    finally:
        bench.air.give_back(port)
