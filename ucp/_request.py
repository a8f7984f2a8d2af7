"""Check that a command is JSON that a trace can contain."""

import json
from typing import Any

MAX_PARTS = 100
"""Maximum number of objects and lists in a request."""


def check_request(request: dict[str, Any]) -> None:
    """Raise ValueError for NaN, a lone surrogate, or too many parts. Python's json accepts them."""
    try:
        text = json.dumps(request, allow_nan=False, ensure_ascii=False)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    text.encode()
    if text.count("[") + text.count("{") > MAX_PARTS:
        raise ValueError(f"more than {MAX_PARTS} objects and lists")
