"""Faults of a vehicle: battery, compass, fence, GPS, ground station, motor, remote control and wind."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

from pydantic import Field

from harness.scenario.faults.fault import RUNNING, AgentOperations, Fault
from harness.scenario.vehicles import Vehicles
from sitl.circumstances import (
    COMPASS_LOST,
    COMPASS_REGAINED,
    FENCE_BREACHED,
    FENCE_LIFTED,
    GPS_LOST,
    GPS_REGAINED,
    MOTOR_STOPPED,
    RC_LOST,
    RC_REGAINED,
    STATION_LOST,
    STATION_REGAINED,
    SimulatedFailure,
    battery,
)
from sitl.circumstances import wind as wind_circumstance
from sitl.vehicle import VEHICLE_TYPES, VehicleType

FALLING = "M-5-2l5 6 5-6M0-6v4"
"""Marks of the faults in this module: the start of a vehicle's problem, and its end."""
RISING = "M-5 4l5-6 5 6"
HAS_FAULT, RECOVERED = "its vehicle has a fault", "its vehicle has recovered"


class VehicleFault(Fault):
    """A fault of the vehicles of `agents`. The vehicle continues its flight, or its failsafe acts. The agents continue
    to run.
    """

    states_before = (RUNNING,)
    vehicle_types: ClassVar[tuple[VehicleType, ...]] = VEHICLE_TYPES
    """Types of vehicles that can have this fault."""

    @property
    def circumstance(self) -> SimulatedFailure:
        """The event, such as a GPS failure, that the vehicles simulate."""
        raise NotImplementedError

    def check(self, vehicles: Vehicles) -> None:
        if vehicles.kind == "none":
            raise ValueError("needs vehicles, but `vehicles.kind` is none")
        for vehicle in self.agents:
            if (kind := vehicles.type_of(vehicle)) not in self.vehicle_types:
                raise ValueError(
                    f"applies only to a {' or a '.join(self.vehicle_types)}, but vehicle {vehicle} is a {kind}"
                )

    async def apply(self, operations: AgentOperations, agent_id: int) -> None:
        await operations.set_circumstance(agent_id, self.what, self.circumstance, by_hand=self.by_hand)

    @property
    def vehicles_in_words(self) -> str:
        """The vehicles as text, such as "vehicles 1 2"."""
        return f"vehicle{'s' if len(self.agents) > 1 else ''} {' '.join(map(str, self.agents))}"

    @property
    def detail(self) -> str:
        return self.vehicles_in_words


@dataclass(frozen=True)
class Battery(VehicleFault):
    """The batteries of these vehicles drop to `volts`, and discharge further."""

    volts: Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)]

    key_descriptions = {"volts": "Voltage of the batteries of `battery`."}

    what = "battery"
    default_values = {"volts": 10.4}
    keys_in_words = "`volts`, for example 10.4"
    mark = FALLING
    meaning = HAS_FAULT

    @property
    def circumstance(self) -> SimulatedFailure:
        return battery(self.volts)

    @property
    def detail(self) -> str:
        return f"{self.vehicles_in_words}, {self.volts:g} V"


class BreachFence(VehicleFault):
    """The fence of these vehicles shrinks to two metres around home. A vehicle that is away from home breaches it."""

    what = "breach_fence"
    mark = FALLING
    meaning = HAS_FAULT

    @property
    def circumstance(self) -> SimulatedFailure:
        return FENCE_BREACHED


class LiftFence(VehicleFault):
    """The fence of these vehicles is switched off again."""

    what = "lift_fence"
    mark = RISING
    meaning = RECOVERED

    @property
    def circumstance(self) -> SimulatedFailure:
        return FENCE_LIFTED


class LoseCompass(VehicleFault):
    """All compasses of these vehicles fail."""

    what = "lose_compass"
    mark = FALLING
    meaning = HAS_FAULT

    @property
    def circumstance(self) -> SimulatedFailure:
        return COMPASS_LOST


class RegainCompass(VehicleFault):
    """The compasses of these vehicles work again."""

    what = "regain_compass"
    mark = RISING
    meaning = RECOVERED

    @property
    def circumstance(self) -> SimulatedFailure:
        return COMPASS_REGAINED


class LoseGcs(VehicleFault):
    """These vehicles receive nothing from their ground station, and the ground station receives nothing from these
    vehicles.
    """

    what = "lose_gcs"
    mark = FALLING
    meaning = HAS_FAULT

    @property
    def circumstance(self) -> SimulatedFailure:
        return STATION_LOST


class RegainGcs(VehicleFault):
    """These vehicles and their ground station receive each other again."""

    what = "regain_gcs"
    mark = RISING
    meaning = RECOVERED

    @property
    def circumstance(self) -> SimulatedFailure:
        return STATION_REGAINED


class LoseGps(VehicleFault):
    """These vehicles lose GPS."""

    what = "lose_gps"
    mark = FALLING
    meaning = HAS_FAULT

    @property
    def circumstance(self) -> SimulatedFailure:
        return GPS_LOST


class RegainGps(VehicleFault):
    """These vehicles have GPS again."""

    what = "regain_gps"
    mark = RISING
    meaning = RECOVERED

    @property
    def circumstance(self) -> SimulatedFailure:
        return GPS_REGAINED


class LoseRc(VehicleFault):
    """The receivers of these vehicles lose the signal of the remote control."""

    what = "lose_rc"
    mark = FALLING
    meaning = HAS_FAULT

    @property
    def circumstance(self) -> SimulatedFailure:
        return RC_LOST


class RegainRc(VehicleFault):
    """The receivers of these vehicles receive the signal of the remote control again."""

    what = "regain_rc"
    mark = RISING
    meaning = RECOVERED

    @property
    def circumstance(self) -> SimulatedFailure:
        return RC_REGAINED


class StopMotor(VehicleFault):
    """One motor of each of these copters stops. A copter with four motors falls."""

    what = "stop_motor"
    vehicle_types = ("copter",)
    mark = FALLING
    meaning = HAS_FAULT

    @property
    def circumstance(self) -> SimulatedFailure:
        return MOTOR_STOPPED


@dataclass(frozen=True)
class Wind(VehicleFault):
    """The wind at these vehicles changes: it now blows at the speed `wind_ms` from the direction `from_deg`. A speed of
    0 ends the wind.
    """

    wind_ms: Annotated[float, Field(ge=0, le=60, allow_inf_nan=False)]
    from_deg: Annotated[float, Field(ge=0, lt=360, allow_inf_nan=False)]

    key_descriptions = {
        "wind_ms": "Speed of `wind` in metres per second.",
        "from_deg": "Direction from which `wind` blows, in degrees clockwise from north.",
    }

    what = "wind"
    default_values = {"wind_ms": 10.0, "from_deg": 0.0}
    keys_in_words = "`wind_ms`, in metres per second, and `from_deg`, clockwise from north"
    mark = FALLING
    meaning = HAS_FAULT

    @property
    def circumstance(self) -> SimulatedFailure:
        return wind_circumstance(self.wind_ms, self.from_deg)

    @property
    def detail(self) -> str:
        return f"{self.vehicles_in_words}, {self.wind_ms:g} m/s from {self.from_deg:g}°"
