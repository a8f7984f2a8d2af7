"""Faults of a vehicle rather than of its agent: battery, compass, GPS, motor and wind."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

from pydantic import Field

from harness.scenario.faults.fault import RUNNING, Fault, Lives
from harness.scenario.vehicles import Vehicles
from sitl.circumstances import (
    COMPASS_LOST,
    COMPASS_REGAINED,
    GPS_LOST,
    GPS_REGAINED,
    MOTOR_STOPPED,
    Circumstance,
    battery,
)
from sitl.circumstances import wind as of_wind
from sitl.vehicle import VEHICLE_TYPES, VehicleType

FALLING = "M-5-2l5 6 5-6M0-6v4"
"""Marks of the faults in this module: the start of a problem of a vehicle, and its end."""
RISING = "M-5 4l5-6 5 6"
TROUBLED, WELL_AGAIN = "its vehicle has a fault", "its vehicle has recovered"


class VehicleFault(Fault):
    """A fault of the vehicles of `agents`. A vehicle flies on, or its failsafe acts. The agents continue to run."""

    needs = (RUNNING,)
    of_types: ClassVar[tuple[VehicleType, ...]] = VEHICLE_TYPES
    """Types of vehicles that can have this fault."""

    @property
    def circumstance(self) -> Circumstance:
        """The circumstance that the vehicles simulate."""
        raise NotImplementedError

    def check(self, vehicles: Vehicles) -> None:
        if vehicles.kind == "none":
            raise ValueError("needs vehicles, but `vehicles.kind` is none")
        for vehicle in self.agents:
            if (kind := vehicles.type_of(vehicle)) not in self.of_types:
                raise ValueError(f"befalls a {' or a '.join(self.of_types)}, and vehicle {vehicle} is a {kind}")

    async def strike(self, lives: Lives, agent_id: int) -> None:
        await lives.befall(agent_id, self.what, self.circumstance, by_hand=self.by_hand)

    @property
    def whose(self) -> str:
        """The vehicles in words: "vehicles 1 2"."""
        return f"vehicle{'s' if len(self.agents) > 1 else ''} {' '.join(map(str, self.agents))}"

    @property
    def detail(self) -> str:
        return self.whose


@dataclass(frozen=True)
class Battery(VehicleFault):
    """The batteries of these vehicles drop to `volts`, and discharge further."""

    volts: Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)]

    key_descriptions = {"volts": "Voltage of the batteries of `battery`."}

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


class LoseCompass(VehicleFault):
    """All compasses of these vehicles fail."""

    what = "lose_compass"
    mark = FALLING
    meaning = TROUBLED

    @property
    def circumstance(self) -> Circumstance:
        return COMPASS_LOST


class RegainCompass(VehicleFault):
    """The compasses of these vehicles work again."""

    what = "regain_compass"
    mark = RISING
    meaning = WELL_AGAIN

    @property
    def circumstance(self) -> Circumstance:
        return COMPASS_REGAINED


class LoseGps(VehicleFault):
    """These vehicles lose GPS."""

    what = "lose_gps"
    mark = FALLING
    meaning = TROUBLED

    @property
    def circumstance(self) -> Circumstance:
        return GPS_LOST


class RegainGps(VehicleFault):
    """These vehicles have GPS again."""

    what = "regain_gps"
    mark = RISING
    meaning = WELL_AGAIN

    @property
    def circumstance(self) -> Circumstance:
        return GPS_REGAINED


class StopMotor(VehicleFault):
    """One motor of each of these copters stops. A copter with four motors falls."""

    what = "stop_motor"
    of_types = ("copter",)
    mark = FALLING
    meaning = TROUBLED

    @property
    def circumstance(self) -> Circumstance:
        return MOTOR_STOPPED


@dataclass(frozen=True)
class Wind(VehicleFault):
    """The wind at these vehicles changes to `wind_ms` from `from_deg`. A speed of 0 ends the wind."""

    wind_ms: Annotated[float, Field(ge=0, le=60, allow_inf_nan=False)]
    from_deg: Annotated[float, Field(ge=0, lt=360, allow_inf_nan=False)]

    key_descriptions = {
        "wind_ms": "Speed of `wind` in metres per second.",
        "from_deg": "Direction from which `wind` blows, in degrees clockwise from north.",
    }

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
