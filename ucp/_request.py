"""A command that an agent is given, as JSON that a trace can hold."""

import json
from typing import Any

MAX_PARTS = 100
"""No request has more objects and lists in it."""


def check_request(request: dict[str, Any]) -> None:
    """Raises ValueError for what json reads, and nobody else does: NaN, half a character; or for very much of it."""
    try:
        text = json.dumps(request, allow_nan=False, ensure_ascii=False)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    text.encode()
    if text.count("[") + text.count("{") > MAX_PARTS:
        raise ValueError(f"more than {MAX_PARTS} objects and lists")
