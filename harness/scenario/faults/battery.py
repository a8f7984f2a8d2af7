"""A vehicle's battery sags."""

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from harness.scenario.faults.vehicle_fault import FALLING, TROUBLED, VehicleFault
from sitl.circumstances import Circumstance, battery


@dataclass(frozen=True)
class Battery(VehicleFault):
    """Their vehicles' batteries have `volts` from now on, and are used up from there."""

    volts: Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)]

    what = "battery"
    unless_told = {"volts": 10.4}
    keys_in_words = "`volts`, for example 10.4"
    mark = FALLING
    meaning = TROUBLED

    @property
    def circumstance(self) -> Circumstance:
        return battery(self.volts)

    @property
    def detail(self) -> str:
        return f"{self.whose}, {self.volts:g} V"
