"""Write the chain export of an agent, a JSON document with all blocks that it holds (`ucp-chain-export/1`)."""

import base64
from collections.abc import Mapping

from ucp.block import Block
from ucp.state import AgentState

SCHEMA = "ucp-chain-export/1"


def export_chain(
    state: AgentState, exported_at_us: int, signatures: Mapping[bytes, bytes] | None = None
) -> dict[str, object]:
    """Return the chain export of an agent as a JSON object.

    The list of the chain begins with the oldest block. The list of the deque begins with its front. The list of the
    reconcile stack ends with its top. In a secured mission, `signatures` maps each block hash to the signature of the
    block.
    """
    inception = state.chain.inception

    def exported(block: Block, chain_hash: bytes | None) -> dict[str, object]:
        signature = signatures.get(block.block_hash) if signatures else None
        return _block(block, chain_hash) | ({"signature": _base64(signature)} if signature else {})

    return {
        "schema": SCHEMA,
        "agent_id": state.agent_id,
        "exported_at_us": exported_at_us,
        "inception": {
            "block_data": _base64(inception.block_data),
            "block_hash": inception.block_hash.hex(),
            "chain_hash": inception.chain_hash.hex(),
        },
        "chain": [exported(block, chain_hash) for block, chain_hash in state.chain.with_chain_hashes()],
        "blocks_to_be_committed": [exported(block, None) for block in state.blocks_to_be_committed],
        "reconcile_stack": [exported(block, None) for block in state.reconcile_stack],
        "current_block": {"event_data": _base64(bytes(state.current_block))},
        "reconcile_in_progress": state.reconcile_in_progress,
        "idle": state.idle,
        "completed": [block_hash.hex() for block_hash in state.completed],
    }


def _block(block: Block, chain_hash: bytes | None) -> dict[str, object]:
    return {
        "agent_id": block.agent_id,
        "timestamp_us": block.timestamp_us,
        "event_data": _base64(block.event_data),
        "block_hash": block.block_hash.hex(),
        "chain_hash": chain_hash.hex() if chain_hash else None,
    }


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")
