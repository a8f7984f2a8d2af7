"""Flight plans: which vehicles fly what, and whether they are given it whole or leg by leg."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from harness.scenario.strict_model import Model, VehicleId
from sitl.plan import MAX_LEGS, By, GoTo, Land, Loiter, Plan, TakeOff
from sitl.plan import Leg as PlannedLeg

LEGS = ("take_off", "go_to", "loiter_s", "land")


class Leg(Model):
    """One of four: take off to metres above home, go to metres north and east of it, loiter (mission seconds), land.

    `altitude_m` (above home) and `speed_ms` belong to `go_to`; without, the altitude stays and the speed is the type's.
    """

    take_off: float | None = None
    go_to: tuple[float, float] | None = None
    altitude_m: float | None = None
    speed_ms: float | None = None
    loiter_s: float | None = None
    land: Literal[True] | None = None

    @model_validator(mode="after")
    def _one_leg(self) -> "Leg":
        if sum(getattr(self, leg) is not None for leg in LEGS) != 1:
            raise ValueError("needs exactly one of `take_off`, `go_to`, `loiter_s`, `land: true`")
        if self.go_to is None and (self.altitude_m is not None or self.speed_ms is not None):
            raise ValueError("`altitude_m` and `speed_ms` belong to a `go_to`")
        return self

    def planned(self) -> PlannedLeg:
        if self.take_off is not None:
            return TakeOff(self.take_off)
        if self.go_to is not None:
            return GoTo(*self.go_to, self.altitude_m, self.speed_ms)
        return Loiter(self.loiter_s) if self.loiter_s is not None else Land()


class Flight(Model):
    """A plan and the vehicles that fly it.

    `by: mission`: uploaded by the MAVLink mission protocol and flown in AUTO; `guided`: leg by leg in GUIDED.
    """

    vehicles: Annotated[list[VehicleId], Field(min_length=1)]
    by: By = "mission"
    plan: Annotated[list[Leg], Field(min_length=1, max_length=MAX_LEGS)]

    def planned(self) -> Plan:
        return Plan(tuple(leg.planned() for leg in self.plan))
