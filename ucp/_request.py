"""Check that a command to an agent is JSON that can be written to a trace."""

import json
from typing import Any

MAX_PARTS = 100
"""Maximum number of objects and lists in the JSON text of a request."""


def check_request(request: dict[str, Any]) -> None:
    """Raise ValueError if a request contains NaN, a lone surrogate, or too many parts. Python's JSON parser accepts all
    of these.
    """
    try:
        text = json.dumps(request, allow_nan=False, ensure_ascii=False)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    text.encode()
    if text.count("[") + text.count("{") > MAX_PARTS:
        raise ValueError(f"more than {MAX_PARTS} objects and lists")
