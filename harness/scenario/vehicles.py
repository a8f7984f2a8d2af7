"""The vehicles under the agents."""

import math
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, field_validator

from harness.scenario.model import Model, VehicleKey
from sitl.vehicle import SPACING_M, VehicleType

VehicleKind = Literal["ardupilot", "embedded", "none"]


class Vehicles(Model):
    """The vehicles under the agents. `kind` unset: ArduPilot if there are binaries of all types, else embedded ones.

    `type` is that of all vehicles but those in `types`; `binary` is for a run of one type.
    """

    kind: VehicleKind | None = None
    type: VehicleType = "copter"
    types: dict[VehicleKey, VehicleType] = {}
    binary: Path | None = None
    takeoff_altitude_m: Annotated[float, Field(gt=0, le=1000)] = 20.0
    home: tuple[float, float, float, float] = (-35.363262, 149.165237, 584.0, 353.0)
    """Latitude and longitude in degrees, altitude in metres, heading in degrees, of the first vehicle."""
    spacing_m: Annotated[float, Field(gt=0, le=10_000)] = SPACING_M
    """How far apart the homes are, about, spread over the field round that of the first."""

    def type_of(self, vehicle: int) -> VehicleType:
        return self.types.get(vehicle, self.type)

    @field_validator("home")
    @classmethod
    def _on_earth(cls, home: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
        latitude, longitude, _, _ = home
        if not all(math.isfinite(value) for value in home) or abs(latitude) > 90 or abs(longitude) > 180:
            raise ValueError("needs latitude -90..90, longitude -180..180, altitude (m) and heading (degrees)")
        if latitude == longitude == 0:
            raise ValueError("latitude and longitude 0 are ArduPilot's word for no position: move it by a metre")
        return home
