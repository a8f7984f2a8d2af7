"""Names of blocks for people: `<agent>.<ordinal>`, as in the thesis's figures."""

from collections.abc import Mapping

from harness.archive.exports import Export


def name_blocks(exports: Mapping[int, Export]) -> dict[str, str]:
    """Block hash -> "4.11", the ordinal counting from 1 that agent's completed blocks.

    An agent whose own export is missing (it died) is counted by the timestamps of its blocks on the others.
    """
    completed: dict[int, dict[str, int]] = {
        agent_id: dict.fromkeys(export.completed, 0) for agent_id, export in exports.items()
    }
    strays: dict[int, dict[str, int]] = {}
    for export in exports.values():
        for block in export.blocks():
            if block.block_hash not in completed.get(block.agent_id, {}):
                strays.setdefault(block.agent_id, {})[block.block_hash] = block.timestamp_us
    for agent_id, blocks in strays.items():
        in_time = sorted(blocks, key=lambda block_hash: (blocks[block_hash], block_hash))
        completed.setdefault(agent_id, {}).update(dict.fromkeys(in_time, 0))
    return {
        block_hash: f"{agent_id}.{ordinal}"
        for agent_id, blocks in sorted(completed.items())
        for ordinal, block_hash in enumerate(blocks, start=1)
    }
