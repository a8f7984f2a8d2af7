"""Test vectors of the agent contract: inputs with the correct outputs. `python -m ucp.contract.vectors` writes the
files.

The vectors cover hashes, messages, dropped datagrams, full blocks, refused missions and requests, secured datagrams,
and complete missions in virtual time. To write the vectors of secured datagrams, Python needs the packages of the extra
`secure`.
"""

import base64
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ucp.contract.vectors import (
    _block_vectors,
    _hash_vectors,
    _message_vectors,
    _mission_vectors,
    drop_vectors,
    refusal_vectors,
)

DIRECTORY = Path(__file__).parent


def _secured() -> Any:
    from ucp.contract.vectors import _secured_vectors  # it needs cryptography, and a replay of missions does not

    return _secured_vectors.vectors()


DOCUMENTS: dict[str, Callable[[], Any]] = {
    "hashes": _hash_vectors.vectors,
    "messages": _message_vectors.vectors,
    "drops": drop_vectors.vectors,
    "blocks": _block_vectors.vectors,
    "refusals": refusal_vectors.vectors,
    "secured": _secured,
}
"""Name of a file with test vectors -> function that returns its content."""

MISSIONS = DIRECTORY / "missions"
INDEX = MISSIONS / "index.json"
"""The file that lists all recorded missions, with their descriptions and the features that they need."""


def texts() -> dict[Path, str]:
    """Return the text of each file with test vectors, by path."""
    made = {DIRECTORY / f"{name}.json": _json(vectors()) for name, vectors in DOCUMENTS.items()}
    index = {}
    for name, mission in _mission_vectors.MISSIONS.items():
        exchanges = mission().exchanges
        features = exchanges[0]["input"]["mission"]["features"]
        index[name] = {"what": " ".join((mission.__doc__ or "").split()), "features": features, "lines": len(exchanges)}
        made[MISSIONS / f"{name}.jsonl"] = "".join(json.dumps(exchange) + "\n" for exchange in exchanges)
    return made | {INDEX: _json(index)}


def write_all() -> None:
    """Write all files with test vectors. Existing files are replaced."""
    for path, text in texts().items():
        path.parent.mkdir(exist_ok=True)
        path.write_text(text, encoding="ascii")


def _json(document: Any) -> str:
    """Return a document as JSON text. Bytes become base64, as everywhere in the agent contract."""
    return json.dumps(document, indent=1, default=lambda data: base64.b64encode(data).decode("ascii")) + "\n"
