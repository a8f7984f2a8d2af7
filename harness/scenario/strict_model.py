"""The base class of all scenario models: strict pydantic models, and the types of their values."""

import base64
import binascii
import re
from collections.abc import Iterable
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field

from ucp.block import MAX_AGENT_ID

MAX_AGENTS = 1000

Probability = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Seconds = Annotated[float, Field(gt=0, allow_inf_nan=False)]
MissionSecond = Annotated[float, Field(ge=0, allow_inf_nan=False)]
"""A time in mission seconds since the start of the mission."""
VehicleId = Annotated[int, Field(ge=1, le=MAX_AGENT_ID, strict=True)]

VehicleKey = Annotated[
    VehicleId, BeforeValidator(lambda value: int(value) if isinstance(value, str) and value.isdecimal() else value)
]
"""A vehicle ID as the key of a mapping. In JSON the key is a string."""


def _check_base64(text: str) -> str:
    try:
        base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError):
        raise ValueError("must be base64") from None
    return text


Data = Annotated[str, AfterValidator(_check_base64)]
"""Bytes, encoded in base64."""


class StrictModel(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)


MAX_CHARACTERS = 1024 * 1024
_SECONDS = r"\d{1,9}(?:\.\d{1,12})?"


def _pairs_pattern(sign: str) -> str:
    entry = rf"\d{{1,10}}{re.escape(sign)}{_SECONDS}"
    return rf"^{entry}(?: {entry})*$"


def parse_pairs(text: str) -> list[tuple[int, float]]:
    """Return the pairs (number, seconds) that the text contains, in the same order."""
    pairs = (re.split(r"[@+]", entry) for entry in text.split())
    return [(int(number), float(seconds)) for number, seconds in pairs]


def format_pairs(pairs: Iterable[tuple[int, float]], sign: str) -> str:
    """Return the pairs in the notation of a scenario, rounded to microseconds."""
    return " ".join(f"{number}{sign}{seconds:.6f}".rstrip("0").rstrip(".") for number, seconds in pairs)


def _check_pairs(sign: str, example: str) -> BeforeValidator:
    """Return a validator whose error message shows an example instead of the regular expression."""

    def check(text: Any) -> Any:
        if isinstance(text, str) and len(text) <= MAX_CHARACTERS and not re.match(_pairs_pattern(sign), text):
            raise ValueError(f'should be numbers and seconds, as in "{example}"')
        return text

    return BeforeValidator(check)


Arrivals = Annotated[
    str, Field(pattern=_pairs_pattern("@"), max_length=MAX_CHARACTERS), _check_pairs("@", "17@12.345 18@12.5")
]
"""Numbers of datagrams, each with the mission second of its arrival."""
Lateness = Annotated[
    str, Field(pattern=_pairs_pattern("+"), max_length=MAX_CHARACTERS), _check_pairs("+", "3+0.25 8+1")
]
"""Numbers of timers, each with the number of seconds by which it expires late."""
