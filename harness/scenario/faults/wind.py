"""Wind rises, and falls."""

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from harness.scenario.faults.vehicle_fault import FALLING, TROUBLED, VehicleFault
from sitl.circumstances import Circumstance
from sitl.circumstances import wind as of_wind


@dataclass(frozen=True)
class Wind(VehicleFault):
    """Their vehicles are in wind of `wind_ms` metres per second that comes from `from_deg`; of 0 it is over."""

    wind_ms: Annotated[float, Field(ge=0, le=60, allow_inf_nan=False)]
    from_deg: Annotated[float, Field(ge=0, lt=360, allow_inf_nan=False)]

    what = "wind"
    unless_told = {"wind_ms": 10.0, "from_deg": 0.0}
    keys_in_words = "`wind_ms`, in metres per second, and `from_deg`, clockwise from north"
    mark = FALLING
    meaning = TROUBLED

    @property
    def circumstance(self) -> Circumstance:
        return of_wind(self.wind_ms, self.from_deg)

    @property
    def detail(self) -> str:
        return f"{self.whose}, {self.wind_ms:g} m/s from {self.from_deg:g}°"
