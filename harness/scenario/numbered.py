"""Seconds by number, short enough for thousands of them in a file: "17@12.345 18@12.5", or "3+0.25" for a duration."""

import re
from collections.abc import Iterable
from typing import Annotated, Any

from pydantic import BeforeValidator, Field

MAX_CHARACTERS = 1024 * 1024
_SECONDS = r"\d{1,9}(?:\.\d{1,12})?"


def _listed(sign: str) -> str:
    entry = rf"\d{{1,10}}{re.escape(sign)}{_SECONDS}"
    return rf"^{entry}(?: {entry})*$"


def numbered(text: str) -> list[tuple[int, float]]:
    """(number, seconds), in the order of the text."""
    pairs = (re.split(r"[@+]", entry) for entry in text.split())
    return [(int(number), float(seconds)) for number, seconds in pairs]


def in_text(pairs: Iterable[tuple[int, float]], sign: str) -> str:
    """As a file says it, to the microsecond."""
    return " ".join(f"{number}{sign}{seconds:.6f}".rstrip("0").rstrip(".") for number, seconds in pairs)


def _listing(sign: str, example: str) -> BeforeValidator:
    """Says what is wrong in better words than the pattern itself."""

    def check(text: Any) -> Any:
        if isinstance(text, str) and len(text) <= MAX_CHARACTERS and not re.match(_listed(sign), text):
            raise ValueError(f'should be numbers and seconds, as in "{example}"')
        return text

    return BeforeValidator(check)


Arrivals = Annotated[str, Field(pattern=_listed("@"), max_length=MAX_CHARACTERS), _listing("@", "17@12.345 18@12.5")]
"""Number of a datagram, and the mission second at which it arrives."""
Lateness = Annotated[str, Field(pattern=_listed("+"), max_length=MAX_CHARACTERS), _listing("+", "3+0.25 8+1")]
"""Number of a timer, and by how many seconds it ends late."""
