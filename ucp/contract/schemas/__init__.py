"""JSON Schemas (draft 2020-12) of all that the agent contract has in JSON; `python -m ucp.contract.schemas` writes
the files.

They say what a right agent reads and writes. Keys that they do not name are allowed wherever CONTRACT.md says that a
reader ignores them.
"""

import json
from collections.abc import Callable
from pathlib import Path
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


def path(name: str) -> Path:
    """Where its file is."""
    return Path(__file__).with_name(f"{name}.schema.json")


def write_all() -> None:
    """Write all files anew."""
    for name in DOCUMENTS:
        path(name).write_text(json.dumps(generate(name), indent=1) + "\n", encoding="utf-8")
