"""The JSON schemas of requests to an agent's control socket, and of their answers."""

from ucp.contract.schemas._schema_parts import BASE64, COUNT, EVENT_ID, FLAG, HASH, SECONDS, Schema, record
from ucp.mission import LATEST_EPOCH_US

REQUESTS: dict[str, Schema] = {
    "status": {},
    "start": {"epoch_us": COUNT | {"maximum": LATEST_EPOCH_US}},
    "log": {"event_id": EVENT_ID, "data": BASE64},
    "stop_events": {},
    "reconcile": {},
    "export": {},
    "quirk": {"name": {"type": "string"}, "value": {"type": ["boolean", "number"]}},
    "revoke": {"revocation": BASE64},
}
"""Command -> its further keys."""

STATUS: dict[str, Schema] = {
    "started": FLAG,
    "idle": FLAG,
    "reconcile_in_progress": FLAG,
    "chain": COUNT,
    "deque": COUNT,
    "stack": COUNT,
    "completed": COUNT,
    "reconciles": COUNT,
    "top_chain_hash": HASH,
    "handled": COUNT,
    "bytes_sent": COUNT,
}
MAY_BE_MISSING: dict[str, Schema] = {
    "mission_s": SECONDS,
    "dropped": {"type": "object", "additionalProperties": COUNT},
    "send_failures": COUNT,
    "trace_problem": {"type": ["string", "null"]},
    "version": {"type": "string"},
}

DONE: Schema = {"ok": {"const": True}}
REFUSED: Schema = record(
    {"ok": {"const": False}, "error": {"type": "string", "minLength": 1}, "unsupported": {"const": True}},
    optional=("unsupported",),
)


def request(*commands: str) -> Schema:
    """Return the JSON schema of a request with one of these commands."""
    return {"oneOf": [record({"command": {"const": command}, **REQUESTS[command]}) for command in commands]}


def answer(command: str) -> Schema:
    """Return the JSON schema of the answer to a command."""
    success = {
        "status": record(DONE | STATUS | MAY_BE_MISSING, optional=tuple(MAY_BE_MISSING)),
        "export": record({**DONE, "path": {"type": "string"}}),
    }.get(command, record(DONE))
    return {"anyOf": [success, REFUSED]}


def schema() -> Schema:
    """Return the JSON schema of a request with its answer. Each request and each answer also has a schema of its
    own.
    """
    definitions: Schema = {"request": request(*REQUESTS)}
    definitions |= {f"{command}-answer": answer(command) for command in REQUESTS}
    exchanges = [
        record(
            {
                "request": {"type": "object", "properties": {"command": {"const": command}}, "required": ["command"]},
                "answer": {"$ref": f"#/$defs/{command}-answer"},
            }
        )
        for command in REQUESTS
    ]
    return {"oneOf": exchanges, "$defs": definitions}
