"""Write chain exports for tests."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from harness.archive.exports import Export
from harness.field.depot.collected_exports import collect_exports
from harness.field.depot.consolidation import MergedRecord, consolidate
from ucp.agent import Agent
from ucp.block import Block
from ucp.events import LoggableEvent
from ucp.export import export_chain
from ucp.store import StoredState

DATA = b"the inception block"


def make_block(agent_id: int, number: int, events: int = 2) -> Block:
    """Return a block. Its content is different for each number."""
    logged = [LoggableEvent(1000 * number + index, 1 + index, bytes([agent_id, number])) for index in range(events)]
    return Block(agent_id, logged[-1].timestamp_us, b"".join(event.encode() for event in logged))


def document(
    agent_id: int,
    chain: str = "",
    deque: str = "",
    stack: str = "",
    *,
    building: int = 0,
    data: bytes = DATA,
    exported_at_us: int = 10**6,
    completed: str | None = None,
) -> dict[str, Any]:
    """Return an export with the blocks in a text like "1.1 2.1". The block under construction contains `building`
    events.
    """

    def blocks(names: str) -> list[Block]:
        return [make_block(*map(int, name.split("."))) for name in names.split()]

    held = [*blocks(chain), *blocks(deque), *blocks(stack)]
    own = [block for block in held if block.agent_id == agent_id] if completed is None else blocks(completed)
    own.sort(key=lambda block: block.timestamp_us)
    agent = Agent(agent_id, {agent_id, *(block.agent_id for block in held)}, data, tracing=False)
    state = StoredState([block.block_hash for block in own], blocks(chain))
    agent.boot(state, 0.0)
    for block in blocks(deque):
        agent.state.blocks_to_be_committed.append(block)
    agent.state.reconcile_stack += blocks(stack)
    for number in range(building):
        agent.state.current_block += LoggableEvent(10**6 + number, 7, bytes([agent_id])).encode()
    return export_chain(agent.state, exported_at_us)


def write(directory: Path, *documents: Mapping[str, Any]) -> Path:
    directory.mkdir(parents=True, exist_ok=True)
    for each in documents:
        (directory / f"{each['agent_id']}.chain.json").write_text(json.dumps(each))
    return directory


def consolidated(directory: Path, *documents: Mapping[str, Any]) -> MergedRecord:
    return consolidate(collect_exports([write(directory, *documents)]))


def write_exports(directory: Path, exports: Mapping[int, Export]) -> Path:
    return write(directory, *(export.model_dump(mode="json", by_alias=True) for export in exports.values()))


def names(record: MergedRecord) -> list[str]:
    return [block.line.name for block in record.blocks]
