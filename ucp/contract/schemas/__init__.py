"""JSON Schemas (draft 2020-12) of the JSON documents of the agent contract. `harness.json_schemas` writes the files.

They say what a right agent reads and writes. Keys that they do not name are allowed wherever CONTRACT.md says that a
reader ignores them.
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
"""What there is a schema of, by name."""


def generate(name: str) -> dict[str, Any]:
    """The schema of this name."""
    return {"$schema": DIALECT, "title": name, **DOCUMENTS[name]()}
