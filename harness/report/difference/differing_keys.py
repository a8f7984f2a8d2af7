"""The keys in which two JSON documents differ."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class KeyDifference:
    """A key such as `network.loss` or `timeline.0.at_s`, and its value in either; None also where there is none."""

    key: str
    a: Any
    b: Any


def differing_keys(a: Any, b: Any, key: str = "") -> Iterator[KeyDifference]:
    """The innermost keys that differ, in the order of `a`. Lists of different lengths differ as a whole."""
    if isinstance(a, dict) and isinstance(b, dict):
        pairs = [(name, a.get(name), b.get(name)) for name in {**a, **b}]
    elif isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        pairs = [(index, value_a, value_b) for index, (value_a, value_b) in enumerate(zip(a, b, strict=True))]
    else:
        if a != b:
            yield KeyDifference(key, a, b)
        return
    for name, value_a, value_b in pairs:
        yield from differing_keys(value_a, value_b, f"{key}.{name}" if key else str(name))
