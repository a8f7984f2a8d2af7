"""Generate the JSON Schemas (draft 2020-12) of all JSON documents in the agent contract.

The schemas describe the input and output of a correct agent. They allow additional keys wherever CONTRACT.md requires
readers to ignore them.
"""

from collections.abc import Callable
from typing import Any

from ucp.contract.schemas import (
    _chain_export_schema,
    _control_schema,
    _mission_schema,
    _trace_schema,
    _virtual_schema,
)

DIALECT = "https://json-schema.org/draft/2020-12/schema"

DOCUMENTS: dict[str, Callable[[], dict[str, Any]]] = {
    "mission": _mission_schema.schema,
    "trace": _trace_schema.schema,
    "chain-export": _chain_export_schema.schema,
    "control": _control_schema.schema,
    "virtual": _virtual_schema.schema,
}
"""Name of a document -> function that returns its schema."""


def generate(name: str) -> dict[str, object]:
    """Return the JSON schema of the document with this name."""
    return {"$schema": DIALECT, "title": name, **DOCUMENTS[name]()}
