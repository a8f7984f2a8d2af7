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
"""Marks beside those of `fault`: what befalls a vehicle, and the end of it."""
RISING = "M-5 4l5-6 5 6"
TROUBLED, WELL_AGAIN = "its vehicle is in trouble", "its vehicle is well again"


class VehicleFault(Fault):
    """A kind of fault for the vehicles of `agents`, which fly on or act as their failsafes say; the agents run on."""

    needs = (RUNNING,)
    of_types: ClassVar[tuple[VehicleType, ...]] = VEHICLE_TYPES
    """Those that it can befall."""

    @property
    def circumstance(self) -> Circumstance:
        """What the vehicles are to simulate."""
        raise NotImplementedError

    def check(self, vehicles: Vehicles) -> None:
        if vehicles.kind == "none":
            raise ValueError("needs vehicles that it can befall: `vehicles.kind` is none")
        for vehicle in self.agents:
            if (kind := vehicles.type_of(vehicle)) not in self.of_types:
                raise ValueError(f"befalls a {' or a '.join(self.of_types)}, and vehicle {vehicle} is a {kind}")

    async def strike(self, lives: Lives, agent_id: int) -> None:
        await lives.befall(agent_id, self.what, self.circumstance, by_hand=self.by_hand)

    @property
    def whose(self) -> str:
        """ "vehicles 1 2"."""
        return f"vehicle{'s' if len(self.agents) > 1 else ''} {' '.join(map(str, self.agents))}"

    @property
    def detail(self) -> str:
        return self.whose


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


class LoseCompass(VehicleFault):
    """None of their vehicles' compasses works from now on."""

    what = "lose_compass"
    mark = FALLING
    meaning = TROUBLED

    @property
    def circumstance(self) -> Circumstance:
        return COMPASS_LOST


class RegainCompass(VehicleFault):
    """Their vehicles' compasses work again."""

    what = "regain_compass"
    mark = RISING
    meaning = WELL_AGAIN

    @property
    def circumstance(self) -> Circumstance:
        return COMPASS_REGAINED


class LoseGps(VehicleFault):
    """Their vehicles have no GPS from now on."""

    what = "lose_gps"
    mark = FALLING
    meaning = TROUBLED

    @property
    def circumstance(self) -> Circumstance:
        return GPS_LOST


class RegainGps(VehicleFault):
    """Their vehicles have a GPS again."""

    what = "regain_gps"
    mark = RISING
    meaning = WELL_AGAIN

    @property
    def circumstance(self) -> Circumstance:
        return GPS_REGAINED


class StopMotor(VehicleFault):
    """One motor of each of their copters gives no thrust any more: one with four falls."""

    what = "stop_motor"
    of_types = ("copter",)
    mark = FALLING
    meaning = TROUBLED

    @property
    def circumstance(self) -> Circumstance:
        return MOTOR_STOPPED


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
