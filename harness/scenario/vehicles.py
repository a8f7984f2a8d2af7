"""The vehicles under the agents."""

import math
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, field_validator

from harness.scenario.model import Model

VehicleKind = Literal["ardupilot", "embedded", "none"]


class Vehicles(Model):
    """The vehicles under the agents. `kind` unset: ArduPilot if a binary is found, else the embedded vehicle."""

    kind: VehicleKind | None = None
    binary: Path | None = None
    takeoff_altitude_m: Annotated[float, Field(gt=0, le=1000)] = 20.0
    home: tuple[float, float, float, float] = (-35.363262, 149.165237, 584.0, 353.0)
    """Latitude and longitude in degrees, altitude in metres, heading in degrees, of the first vehicle."""

    @field_validator("home")
    @classmethod
    def _on_earth(cls, home: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
        latitude, longitude, _, _ = home
        if not all(math.isfinite(value) for value in home) or abs(latitude) > 90 or abs(longitude) > 180:
            raise ValueError("needs latitude -90..90, longitude -180..180, altitude (m) and heading (degrees)")
        return home
