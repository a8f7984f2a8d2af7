"""Reconcile the exports of a mission by running the protocol without vehicles (Section 5.1).

An agent starts with the content of each export, as after a power failure (`Agent.boot`). The agents run in virtual time
on a network without loss. The agents reconcile one after another, until no chain changes in a round, as in a final
reconcile. Then each agent receives the blocks in its deque and proposes them. Edited blocks are omitted. Blocks that
only an earlier export of an agent contains are put on its reconcile stack. The agent then commits them on top of its
chain. Unfinished blocks do not change, because no further events occur.
"""

import base64
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness.archive.exports import SUFFIX, Export, ExportedBlock, ExportMaker
from harness.errors import MachineError
from harness.field.depot.collected_exports import CollectedExports
from harness.field.depot.consolidation import MergedRecord
from harness.field.depot.record_lines import ReconcileResult, Vehicle
from harness.play.mission import reconcile_finally
from harness.play.simulation.restored_swarm import RestoredSwarm
from harness.play.simulation.simulation import Simulation
from harness.run.simulate import MemoryRecorder, run_to_end
from harness.scenario import Scenario
from harness.scenario.changes import timeline_of
from harness.scenario.load import parse
from ucp.agent_files import write_json_atomically
from ucp.block import Block
from ucp.clock import MICROSECONDS
from ucp.store import StoredState

LIMIT_S = 1e7
"""Number of virtual seconds in which the agents must become idle. The limit is high, because an agent needs five
seconds to pop one block from its chain.
"""


@dataclass(frozen=True)
class ReconciledExports:
    """The exports of all agents after the reconcile. `line` is the line of the merged record that describes the
    reconcile.
    """

    exports: dict[int, Export]
    line: ReconcileResult


def reconcile(record: MergedRecord, report_progress: Callable[[str], None] = lambda words: None) -> ReconciledExports:
    """Reconcile the exports of a merged record with each other. `report_progress` is called with texts about the
    progress.
    """
    collected = record.collected
    stored = _stored(collected)

    async def show_progress(simulation: Simulation) -> None:
        tops = await simulation.top_chain_hashes()
        report_progress(
            f"reconciling, {simulation.now():.0f} s in virtual time: {len({*tops.values()})} distinct chains"
        )

    swarm = RestoredSwarm(_scenario(record), stored, MemoryRecorder(tracing=False), on_progress=show_progress)
    rounds = run_to_end(_play(swarm, [agent_id for agent_id, state in stored.items() if state.deque]))
    swarm.end()
    exported_at_us = max(export.exported_at_us for export in collected.exports.values()) + round(
        swarm.now() * MICROSECONDS
    )
    maker, signatures = ExportMaker(), _signatures(collected)
    exports = {
        incarnation.agent.agent_id: maker.export(incarnation.state, exported_at_us, signatures).model_copy(
            update={"current_block": collected.exports[incarnation.agent.agent_id].current_block}
        )
        for incarnation in swarm.living()
        if incarnation.state is not None
    }
    return ReconciledExports(exports, _line(record, exports, rounds))


async def _play(swarm: RestoredSwarm, agents_with_deque: Iterable[int]) -> int:
    """Simulate the final reconcile. Return the number of its rounds. In each round, every agent reconciles once."""
    first, *_ = timeline_of(swarm.scenario)
    await swarm.begin(first)
    await swarm.until_idle(LIMIT_S)
    rounds = await _reconcile(swarm)
    for agent_id in agents_with_deque:
        await swarm.give_deque(agent_id)
        await swarm.until_idle(LIMIT_S)
    if len({*(await swarm.top_chain_hashes()).values()}) > 1:
        rounds += await _reconcile(swarm)
    return rounds


async def _reconcile(swarm: RestoredSwarm) -> int:
    await reconcile_finally(swarm, LIMIT_S)
    final_reconcile = swarm.played.final_reconcile
    return 0 if final_reconcile is None else final_reconcile.rounds


def write(reconciliation: ReconciledExports, directory: Path) -> None:
    """Write the exports after the reconcile to a directory. Raises MachineError if that fails."""
    try:
        for agent_id, export in reconciliation.exports.items():
            write_json_atomically(directory / f"{agent_id}{SUFFIX}", export.model_dump(mode="json", by_alias=True))
    except OSError as error:
        raise MachineError(f"{directory} cannot be written: {error.strerror}") from None


def _scenario(record: MergedRecord) -> Scenario:
    """Return a scenario without events and faults."""
    document: dict[str, Any] = {
        "name": "final reconcile",
        "agents": list(record.header.roster),
        "initial_data": record.header.inception.block_data,
        "events": {"source": "scripted"},
        "vehicles": {"kind": "none"},
    }
    return parse(document)


def _signatures(collected: CollectedExports) -> dict[bytes, bytes]:
    """Return the signatures in the exports, by block hash. This function does not verify the signatures."""
    return {
        bytes.fromhex(block.block_hash): base64.b64decode(block.signature)
        for read_export in collected.read_exports
        for block in read_export.export.blocks()
        if block.signature is not None
    }


def _stored(collected: CollectedExports) -> dict[int, StoredState]:
    """Return the state with which each agent starts the reconcile. The state comes from the agent's export. Repeated
    and edited blocks are omitted.
    """
    claims, shared_blocks = collected.claims, dict[str, Block]()
    stored = {}
    held_anywhere = {block.block_hash for export in collected.exports.values() for block in export.blocks()}
    for agent_id, export in collected.exports.items():
        seen = set(claims)

        def unseen(blocks: list[ExportedBlock], seen: set[str] = seen) -> list[Block]:
            unseen_blocks = []
            for block in blocks:
                if block.block_hash not in seen:
                    seen.add(block.block_hash)
                    unseen_blocks.append(_block(block, shared_blocks))
            return unseen_blocks

        chain, deque = unseen(export.chain), unseen(export.blocks_to_be_committed)
        stack = unseen(export.reconcile_stack)
        for read_export in collected.earlier:
            if read_export.export.agent_id == agent_id:
                only_there = [block for block in read_export.export.blocks() if block.block_hash not in held_anywhere]
                stack = [*reversed(unseen(only_there)), *stack]
                held_anywhere |= {block.block_hash for block in only_there}
        completed = [bytes.fromhex(block_hash) for block_hash in export.completed]
        stored[agent_id] = StoredState(completed, chain, deque, stack)
    return stored


def _block(block: ExportedBlock, shared_blocks: dict[str, Block]) -> Block:
    if block.block_hash not in shared_blocks:
        shared_blocks[block.block_hash] = Block(block.agent_id, block.timestamp_us, base64.b64decode(block.event_data))
    return shared_blocks[block.block_hash]


def _line(record: MergedRecord, exports: Mapping[int, Export], rounds: int) -> ReconcileResult:
    names = record.names
    before = {
        agent_id: {block.block_hash for block in export.blocks()}
        for agent_id, export in record.collected.exports.items()
    }
    chains = {export.chain_of_block_hashes for export in exports.values()}
    uniform = len(chains) == 1
    in_all = set.intersection(*(set(chain) for chain in chains))
    left_out = []
    for block in record.blocks:
        line = block.line
        if line.block_hash is None or line.block_hash in in_all:
            continue
        why = "it was edited or damaged" if line.claimed_hash else "some chains lack it"
        left_out.append(f"{line.name}: {why}")
    return ReconcileResult(
        uniform=uniform,
        rounds=rounds,
        vehicles=[
            Vehicle(
                agent_id=agent_id,
                chain=len(export.chain),
                top_chain_hash=export.top_chain_hash,
                gained=[names[block.block_hash] for block in export.chain if block.block_hash not in before[agent_id]],
            )
            for agent_id, export in sorted(exports.items())
        ],
        chain=list(next(iter(chains))) if uniform else [],
        left_out=left_out,
    )
