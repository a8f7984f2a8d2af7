"""Compare the state that an agent stored on its disk with the state that it exported.

An agent writes each change to its store before any other agent can observe the change. When the agent ends, the store
therefore contains the blocks of the export. Two kinds of stores are not compared: stores in a format other than
`ucp-store/1`, which belong to agents of other authors, and stores on a full disk, because the last changes are missing
there.
"""

from collections.abc import Iterator

from harness.archive.exports import Export
from harness.checker.evidence import Evidence
from harness.checker.records.contradiction import Contradiction, of_agent
from ucp.store import SCHEMA, StoredState, StoreError, read_store

MAX_STORE_BYTES = 256 * 1024 * 1024


def compare(evidence: Evidence) -> Iterator[Contradiction]:
    """Yield each disk store that is damaged, or that differs from the agent's export."""
    for agent_id, path in evidence.stores.items():
        export, recorded = evidence.exports.get(agent_id), evidence.recorded(agent_id)
        incarnations = evidence.incarnations.get(agent_id)
        if export is None or recorded is None or recorded.outcome != "exported" or recorded.trace_problem:
            continue
        if incarnations is None or not any(run.changes for run in incarnations[-1].runs):
            continue  # its last incarnation wrote no store
        if not path.is_file() or path.stat().st_size > MAX_STORE_BYTES:
            yield of_agent(
                agent_id, f"its store {path.name} is not a file, or is larger than {MAX_STORE_BYTES} bytes", "2"
            )
            continue
        try:
            header, stored = read_store(path)
        except (StoreError, OSError):
            yield of_agent(agent_id, f"its store {path.name} is damaged", "2")
            continue
        if not isinstance(header, dict) or header.get("schema") != SCHEMA:
            continue
        for place in _differing(stored, export):
            yield of_agent(agent_id, f"its store and its export differ in the {place}", "2")


def _differing(stored: StoredState, export: Export) -> Iterator[str]:
    for place, blocks, exported in (
        ("chain", stored.chain, export.chain),
        ("deque", stored.deque, export.blocks_to_be_committed),
        ("reconcile stack", stored.stack, export.reconcile_stack),
    ):
        if [block.block_hash.hex() for block in blocks] != [block.block_hash for block in exported]:
            yield place
    if [block_hash.hex() for block_hash in stored.completed] != export.completed:
        yield "completed blocks"
