"""Parts that several JSON schemas share."""

from typing import Any

from ucp.block import MAX_AGENT_ID, MAX_EVENT_DATA_BYTES

Schema = dict[str, Any]

HASH: Schema = {"type": "string", "pattern": "^[0-9a-f]{64}$"}
BASE64: Schema = {
    "type": "string",
    "pattern": "^([A-Za-z0-9+/]{4})*([A-Za-z0-9+/]{2}==|[A-Za-z0-9+/]{3}=)?$",
    "contentEncoding": "base64",
}
EVENT_DATA: Schema = BASE64 | {"maxLength": (MAX_EVENT_DATA_BYTES + 2) // 3 * 4}
AGENT_ID: Schema = {"type": "integer", "minimum": 1, "maximum": MAX_AGENT_ID}
EVENT_ID: Schema = {"type": "integer", "minimum": 1, "maximum": 254}
COUNT: Schema = {"type": "integer", "minimum": 0}
TIMESTAMP: Schema = {"type": "integer", "minimum": 0, "maximum": 2**64 - 1}
FLAG: Schema = {"type": "boolean"}
SECONDS: Schema = {"type": "number"}
ROSTER: Schema = {"type": "array", "items": AGENT_ID, "minItems": 1}


def record(properties: Schema, *, optional: tuple[str, ...] = (), closed: bool = False) -> Schema:
    """Return the JSON schema of an object with these keys. All keys except the `optional` ones are required.

    If `closed` is true, no other keys are allowed.
    """
    required = [name for name in properties if name not in optional]
    made: Schema = {"type": "object", "properties": properties, "required": required}
    return made | {"additionalProperties": False} if closed else made


def listed(items: Schema) -> Schema:
    """Return the JSON schema of a list of any length."""
    return {"type": "array", "items": items}
