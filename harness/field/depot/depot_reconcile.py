"""The final reconcile of what came home, by the protocol, without vehicles (Section 5.1).

What each export holds is put into an agent, as after a brown-out (`Agent.boot`), on an air that loses nothing, in
virtual time. One agent after another reconciles, until a round changes no chain, as at the end of a run; then each is
given the blocks that it had still to commit, and proposes them to all. An edited block is given to nobody. What was
only in an agent's earlier export goes back on top of its chain, as what is on its reconcile stack does. The block that
it was building stays as it was: no events come any more.
"""

import base64
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness.archive.exports import SUFFIX, Export, ExportedBlock, ExportMaker
from harness.errors import MachineError
from harness.field.depot.collected_exports import CameHome
from harness.field.depot.consolidation import Consolidation
from harness.field.depot.record_lines import Reconciled, Vehicle
from harness.play.mission import reconcile_finally
from harness.play.simulation.restored import Restored
from harness.play.simulation.simulation import Simulation
from harness.run.simulate import InMemory, without_waiting
from harness.scenario import Scenario
from harness.scenario.changes import timeline_of
from harness.scenario.load import parse
from ucp.agent_files import write_json_atomically
from ucp.block import Block
from ucp.clock import MICROSECONDS
from ucp.store import StoredState

LIMIT_S = 1e7
"""Virtual seconds for agents to become idle: a block that is popped takes five."""


@dataclass(frozen=True)
class Reconciliation:
    """The exports after the reconcile, by agent, and what the record says of it."""

    exports: dict[int, Export]
    line: Reconciled


def reconcile(record: Consolidation, say: Callable[[str], None] = lambda words: None) -> Reconciliation:
    """Reconcile the exports of a record with each other. `say` is told again and again how far it is."""
    home = record.home
    stored = _stored(home)

    async def breathe(simulation: Simulation) -> None:
        tops = await simulation.top_chain_hashes()
        say(f"reconciling, {simulation.now():.0f} s in virtual time: {len({*tops.values()})} distinct chains")

    swarm = Restored(_scenario(record), stored, InMemory(tracing=False), breathe=breathe)
    rounds = without_waiting(_put_together(swarm, [agent_id for agent_id, held in stored.items() if held.deque]))
    swarm.end()
    at_us = max(export.exported_at_us for export in home.exports.values()) + round(swarm.now() * MICROSECONDS)
    maker, signatures = ExportMaker(), _signatures(home)
    exports = {
        life.agent.agent_id: maker.export(life.state, at_us, signatures).model_copy(
            update={"current_block": home.exports[life.agent.agent_id].current_block}
        )
        for life in swarm.living()
        if life.state is not None
    }
    return Reconciliation(exports, _line(record, exports, rounds))


async def _put_together(swarm: Restored, with_deques: Iterable[int]) -> int:
    """How many rounds it took, each of which lets every agent reconcile once."""
    first, *_ = timeline_of(swarm.scenario)
    await swarm.begin(first)
    await swarm.until_idle(LIMIT_S)
    rounds = await _reconcile(swarm)
    for agent_id in with_deques:
        await swarm.give_deque(agent_id)
        await swarm.until_idle(LIMIT_S)
    if len({*(await swarm.top_chain_hashes()).values()}) > 1:
        rounds += await _reconcile(swarm)
    return rounds


async def _reconcile(swarm: Restored) -> int:
    await reconcile_finally(swarm, LIMIT_S)
    done = swarm.played.final_reconcile
    return 0 if done is None else done.rounds


def write(reconciliation: Reconciliation, directory: Path) -> None:
    """Write the exports. Raises MachineError if the disk refuses."""
    try:
        for agent_id, export in reconciliation.exports.items():
            write_json_atomically(directory / f"{agent_id}{SUFFIX}", export.model_dump(mode="json", by_alias=True))
    except OSError as error:
        raise MachineError(f"{directory} cannot be written: {error.strerror}") from None


def _scenario(record: Consolidation) -> Scenario:
    """A mission in which nothing happens any more."""
    asked: dict[str, Any] = {
        "name": "final reconcile",
        "agents": list(record.header.roster),
        "initial_data": record.header.inception.block_data,
        "events": {"source": "scripted"},
        "vehicles": {"kind": "none"},
    }
    return parse(asked)


def _signatures(home: CameHome) -> dict[bytes, bytes]:
    """Those of the blocks' makers that came home, by block hash; each is as good as it was."""
    return {
        bytes.fromhex(block.block_hash): base64.b64decode(block.signature)
        for brought in home.brought
        for block in brought.export.blocks()
        if block.signature is not None
    }


def _stored(home: CameHome) -> dict[int, StoredState]:
    """What each agent boots with: every block once, and none that was edited."""
    claims, made = home.claims, dict[str, Block]()
    stored = {}
    held_by_anybody = {block.block_hash for export in home.exports.values() for block in export.blocks()}
    for agent_id, export in home.exports.items():
        given = set(claims)

        def take(blocks: list[ExportedBlock], given: set[str] = given) -> list[Block]:
            taken = []
            for block in blocks:
                if block.block_hash not in given:
                    given.add(block.block_hash)
                    taken.append(_block(block, made))
            return taken

        chain, deque = take(export.chain), take(export.blocks_to_be_committed)
        stack = take(export.reconcile_stack)
        for brought in home.earlier:
            if brought.export.agent_id == agent_id:
                only_there = [block for block in brought.export.blocks() if block.block_hash not in held_by_anybody]
                stack = [*reversed(take(only_there)), *stack]
                held_by_anybody |= {block.block_hash for block in only_there}
        completed = [bytes.fromhex(block_hash) for block_hash in export.completed]
        stored[agent_id] = StoredState(completed, chain, deque, stack)
    return stored


def _block(block: ExportedBlock, made: dict[str, Block]) -> Block:
    if block.block_hash not in made:
        made[block.block_hash] = Block(block.agent_id, block.timestamp_us, base64.b64decode(block.event_data))
    return made[block.block_hash]


def _line(record: Consolidation, exports: Mapping[int, Export], rounds: int) -> Reconciled:
    names = record.names
    before = {
        agent_id: {block.block_hash for block in export.blocks()} for agent_id, export in record.home.exports.items()
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
    return Reconciled(
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
