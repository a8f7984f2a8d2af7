"""What all parts of a scenario share: strict models, and the types of their values."""

import base64
import binascii
from typing import Annotated

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field

from ucp.block import MAX_AGENT_ID

MAX_AGENTS = 1000

Probability = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Seconds = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Instant = Annotated[float, Field(ge=0, allow_inf_nan=False)]
"""Mission seconds since the start."""
VehicleId = Annotated[int, Field(ge=1, le=MAX_AGENT_ID, strict=True)]

VehicleKey = Annotated[
    VehicleId, BeforeValidator(lambda value: int(value) if isinstance(value, str) and value.isdecimal() else value)
]
"""A vehicle as the key of a mapping: JSON has strings there."""


def _decodable(text: str) -> str:
    try:
        base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError):
        raise ValueError("should be base64") from None
    return text


Data = Annotated[str, AfterValidator(_decodable)]
"""Bytes, in base64."""


class Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)
