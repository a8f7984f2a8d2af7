"""A roster as somebody types it."""

from harness.errors import ScenarioError


def roster_of(text: str) -> int | list[int]:
    """As a scenario has it: a number of agents, or their IDs. Raises ScenarioError."""
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isascii() and part.isdecimal() and len(part) < 10 for part in parts):
        raise ScenarioError(f"`--agents` is {text!r}: it should be a number of agents, or IDs as 10,28,32")
    return int(parts[0]) if len(parts) == 1 else [int(part) for part in parts]
