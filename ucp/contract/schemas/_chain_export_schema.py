"""The JSON schema of the chain export (`ucp-chain-export/1`)."""

from ucp.contract.schemas._schema_parts import (
    AGENT_ID,
    BASE64,
    COUNT,
    EVENT_DATA,
    FLAG,
    HASH,
    TIMESTAMP,
    Schema,
    listed,
    record,
)
from ucp.export import SCHEMA

SIGNATURE: Schema = {**BASE64, "minLength": 88, "maxLength": 88}
"""The signature of a block in a secured mission, 64 bytes in base64. The agent that completed the block made it."""


def block(chain_hash: Schema) -> Schema:
    """Return the JSON schema of a block. Blocks in the deque and the reconcile stack have no chain hash."""
    return record(
        {
            "agent_id": AGENT_ID,
            "timestamp_us": TIMESTAMP,
            "event_data": EVENT_DATA,
            "block_hash": HASH,
            "chain_hash": chain_hash,
            "signature": SIGNATURE,
        },
        optional=("signature",),
    )


MISSION_OR_BOOT: Schema = {"type": "string", "pattern": "^[0-9a-f]{32}$"}
HEAD: Schema = record(
    {
        "mission": MISSION_OR_BOOT,
        "boot": MISSION_OR_BOOT,
        "number": {"type": "integer", "minimum": 1, "maximum": 2**32 - 1},
        "height": COUNT,
        "top_chain_hash": HASH,
        "completed": HASH,
        "held": HASH,
        "revoked": listed(AGENT_ID),
        "signature": SIGNATURE,
    }
)
"""The signed head of a chain export in a secured mission."""


def schema() -> Schema:
    """Return the JSON schema of a chain export."""
    uncommitted = listed(block({"type": "null"}))
    return record(
        {
            "schema": {"const": SCHEMA},
            "agent_id": AGENT_ID,
            "exported_at_us": COUNT,
            "inception": record({"block_data": BASE64, "block_hash": HASH, "chain_hash": HASH}),
            "chain": listed(block(HASH)),
            "blocks_to_be_committed": uncommitted,
            "reconcile_stack": uncommitted,
            "current_block": record({"event_data": EVENT_DATA}),
            "reconcile_in_progress": FLAG,
            "idle": FLAG,
            "completed": listed(HASH),
            "head": HEAD,
        },
        optional=("head",),
    )
