"""Reading `run.json` as it is: whole, half written by a run that was killed, or edited.

Only what nobody could show is refused. Everything else is asked for by `mapping`, `listing` and `number`, which give
nothing instead of failing where a key is missing or holds something else.
"""

import json
import math
from pathlib import Path
from typing import Any

from harness.errors import RunDirectoryError

SCHEMA = "ucp-run/1"
MAX_BYTES = 64 * 1024 * 1024


class DamagedResultError(RunDirectoryError):
    """There is no `run.json`, or what there is was cut off or edited."""


def read_result(path: Path) -> dict[str, Any]:
    """Raises DamagedResultError, or RunDirectoryError for another version: a sentence that names file and trouble."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise DamagedResultError(f"{path}: larger than {MAX_BYTES} bytes, which no run's record is")
        document = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DamagedResultError(f"{path}: cannot be read: {error.strerror}; is this a run directory?") from None
    except (ValueError, RecursionError):
        raise DamagedResultError(f"{path}: truncated or damaged: not a JSON document") from None
    if not isinstance(document, dict) or "schema" not in document:
        raise DamagedResultError(f"{path}: not the result of a run (it has no `schema`)")
    if document["schema"] != SCHEMA:
        raise RunDirectoryError(f"{path}: its schema is {document['schema']!r}, and this version reads {SCHEMA!r}")
    return document


def mapping(document: Any, *keys: str) -> dict[str, Any]:
    """The object under these keys, or an empty one."""
    found = _under(document, keys)
    return found if isinstance(found, dict) else {}


def listing(document: Any, *keys: str) -> list[Any]:
    found = _under(document, keys)
    return found if isinstance(found, list) else []


def number(document: Any, *keys: str) -> float | None:
    """The finite number under these keys, or None."""
    found = _under(document, keys)
    if isinstance(found, bool) or not isinstance(found, int | float):
        return None
    try:
        return float(found) if math.isfinite(found) else None
    except OverflowError:
        return None


def roster_of(result: dict[str, Any]) -> list[int]:
    """The agents that the run is known to have had, whether or not they left anything."""
    agents = mapping(result, "scenario").get("agents")
    if type(agents) is int and 0 < agents <= 1000:
        agents = range(1, agents + 1)
    named = [*(agents if isinstance(agents, list | range) else []), *listing(result, "scenario", "vehicles")]
    return agent_ids([*listing(result, "roster"), *named, *mapping(result, "agents"), *mapping(result, "vehicles")])


def agent_ids(names: Any) -> list[int]:
    """The agent IDs among these, which are numbers, or numbers as text where they were keys."""
    found = {int(name) for name in names if type(name) is int or (isinstance(name, str) and _is_agent_id(name))}
    return sorted(agent_id for agent_id in found if 0 < agent_id <= 0xFFFF)


def _is_agent_id(name: str) -> bool:
    return name.isascii() and name.isdigit() and len(name) <= 5


def _under(document: Any, keys: tuple[str, ...]) -> Any:
    for key in keys:
        document = document.get(key) if isinstance(document, dict) else None
    return document
