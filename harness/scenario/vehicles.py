"""The vehicles of a scenario and their flight plans."""

import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, ValidationInfo, model_validator

from harness.scenario.strict_model import Model, VehicleId, VehicleKey
from sitl import parameters, start_places
from sitl.airframes import NOT_FLOWN, type_of
from sitl.plan import MAX_LEGS, By, GoTo, Land, Loiter, Plan, TakeOff
from sitl.plan import Leg as PlannedLeg
from sitl.setup import Debugger, Setup
from sitl.start_places import Offset
from sitl.vehicle import SPACING_M, Home, VehicleError, VehicleType, home_in_field

VehicleKind = Literal["ardupilot", "embedded", "none"]

MAX_ARGUMENTS = 100
LONG_OPTIONS = ("instance", "home", "model", "speedup", "console", "defaults", "sysid", "base-port", "uartA", "uartB")
SET_BY_US = frozenset({*(f"--{name}" for name in LONG_OPTIONS), *(f"--serial{port}" for port in range(3))})
SHORT_AND_SET_BY_US = frozenset({"-I", "-O", "-M", "-s", "-C"})
"""Options of ArduPilot that the harness gives itself."""


def _read(read: Callable[[str, Path], Any], written_out: Any) -> BeforeValidator:
    """Of text: what `read` finds under that name, beside the file that the scenario is in; else it is `written_out`."""

    def value(asked: Any, info: ValidationInfo) -> Any:
        if not isinstance(asked, str):
            return asked
        beside = (info.context or {}).get("beside")
        if beside is None:
            raise ValueError("only a scenario that is a file itself can name one: write out what is in it")
        try:
            return read(asked, beside)
        except VehicleError as error:
            raise ValueError(str(error)) from None

    return BeforeValidator(value, json_schema_input_type=str | written_out)


def _named(name: str, beside: Path) -> list[float]:
    home = start_places.named(name, beside, os.environ)
    return [home.lat_deg, home.lon_deg, home.alt_m, home.heading_deg]


def _sound(values: dict[str, float]) -> dict[str, float]:
    try:
        parameters.check(values)
    except VehicleError as error:
        raise ValueError(str(error)) from None
    return values


def _flown_here(frame: str) -> str:
    if program := NOT_FLOWN.get(frame):
        raise ValueError(f"flies by {program}, which no pilot of the harness knows: there are copter, plane and rover")
    return frame


def _no_options_of_ours(arguments: list[str]) -> list[str]:
    for argument in arguments:
        is_ours = argument.partition("=")[0] in SET_BY_US or argument[:2] in SHORT_AND_SET_BY_US
        if is_ours or "\0" in argument:
            raise ValueError(f"has {argument!r}, which the harness sets itself: leave it out")
    return arguments


def _on_earth(home: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    latitude, longitude, _, _ = home
    if not all(math.isfinite(value) for value in home) or abs(latitude) > 90 or abs(longitude) > 180:
        raise ValueError("needs latitude -90..90, longitude -180..180, altitude (m) and heading (degrees)")
    if latitude == longitude == 0:
        raise ValueError("latitude and longitude 0 are ArduPilot's word for no position: move it by a metre")
    return home


Coordinates = tuple[float, float, float, float]
Place = Annotated[Coordinates, AfterValidator(_on_earth), _read(_named, Coordinates)]
"""Latitude and longitude in degrees, altitude in metres, heading in degrees; or a name in a `locations.txt`."""

Pairs = dict[str, float]
Parameters = Annotated[Pairs, AfterValidator(_sound), _read(lambda name, beside: parameters.read(beside / name), Pairs)]
"""Pairs, or a file of them."""

Offsets = dict[Annotated[int, Field(ge=0, le=start_places.MAX_INSTANCE)], Offset]
Swarm = Annotated[Offsets, _read(lambda name, beside: start_places.swarm(beside / name), Offsets)]
"""By instance, from 0; or a file of them."""

Frame = Annotated[str, Field(pattern=r"^[A-Za-z0-9+][A-Za-z0-9_.+-]{0,63}$"), AfterValidator(_flown_here)]
Arguments = Annotated[
    list[Annotated[str, Field(max_length=1000)]], Field(max_length=MAX_ARGUMENTS), AfterValidator(_no_options_of_ours)
]


class Wind(Model):
    """Of ArduPilot's simulation: metres per second, the direction that it comes from, and how much it changes."""

    speed_ms: Annotated[float, Field(ge=0, le=100)]
    from_deg: Annotated[float, Field(ge=0, le=360)] = 180.0
    turbulence: Annotated[float, Field(ge=0, le=100)] = 0.0

    def parameters(self) -> dict[str, float]:
        return {"SIM_WIND_SPD": self.speed_ms, "SIM_WIND_DIR": self.from_deg, "SIM_WIND_TURB": self.turbulence}


class EachVehicle(Model):
    """What one vehicle has of its own."""

    frame: Frame | None = None
    parameters: Parameters = {}
    wind: Wind | None = None
    home: Place | None = None
    arguments: Arguments = []
    debugger: Debugger | None = None


class Vehicles(Model):
    """The vehicles under the agents. `kind` unset: ArduPilot if there are binaries of all types, else embedded ones.

    `type` is that of all vehicles but those in `types`; `binary` is for a run of one type. What `each` says of a
    vehicle comes before what is said of all, and is added to it where that is parameters or arguments.
    """

    kind: VehicleKind | None = None
    type: VehicleType = "copter"
    types: dict[VehicleKey, VehicleType] = {}
    binary: Path | None = None
    frame: Frame | None = None
    """What ArduPilot simulates: quadplane, motorboat, heli, hexa, or whatever else its binary offers for the type."""
    parameters: Parameters = {}
    """ArduPilot's, from the start on: pairs, or a file of them."""
    wind: Wind | None = None
    arguments: Arguments = []
    """Further ones for ArduPilot's command line."""
    debugger: Debugger | None = None
    """What ArduPilot runs under: gdb tells where it crashed, valgrind what it did to memory."""
    log_mib: Annotated[int, Field(ge=0, le=1_000_000)] | None = 16
    """How long ArduPilot's own log of a vehicle may get: 0 for none, null for no bound. It is about 3 MiB a minute."""
    takeoff_altitude_m: Annotated[float, Field(gt=0, le=1000)] = 20.0
    home: Place = (-35.363262, 149.165237, 584.0, 353.0)
    """Latitude and longitude in degrees, altitude in metres, heading in degrees, of the first vehicle; or a name in a
    `locations.txt` as ArduPilot has it: beside the scenario, the user's own, or beside the binary."""
    spacing_m: Annotated[float, Field(gt=0, le=10_000)] = SPACING_M
    """How far apart the homes are, about, spread over the field round that of the first."""
    swarm: Swarm = {}
    """Where vehicles begin, from `home`: [east, north, up in metres, heading in degrees], or a file as ArduPilot's
    swarminit.txt. The first vehicle is 0, as ArduPilot counts instances; the others are spread."""
    each: dict[VehicleKey, EachVehicle] = {}
    """Of single vehicles."""

    def type_of(self, vehicle: int) -> VehicleType:
        return self.types.get(vehicle, self.type)

    def setup_of(self, vehicle: int) -> Setup:
        """What of its program may be like no other's."""
        own = self.each.get(vehicle, EachVehicle())
        given: dict[str, float] = {}
        for asked in (self, own):
            given |= asked.wind.parameters() if asked.wind else {}
            given |= asked.parameters
        return Setup(
            own.frame or self.frame,
            given,
            (*self.arguments, *own.arguments),
            own.debugger or self.debugger,
            self.log_mib,
        )

    def home_of(self, vehicle: int, index: int) -> Home:
        """Where a vehicle begins, the `index`-th of all, from 0. Raises VehicleError where that is not on Earth."""
        own, first = self.each.get(vehicle, EachVehicle()).home, self.field
        if own is not None:
            return Home(own[0], own[1], own[2], own[3] % 360)
        if offset := self.swarm.get(index):
            return offset.of(first)
        return home_in_field(index, first, self.spacing_m)

    @property
    def field(self) -> Home:
        """Its middle."""
        return Home(*self.home[:3], self.home[3] % 360)

    def check_frames(self, roster: tuple[int, ...]) -> None:
        """Raises ValueError for a frame of another type of vehicle."""
        for vehicle in roster:
            frame, own = self.setup_of(vehicle).frame, self.type_of(vehicle)
            if frame and type_of(frame) not in (None, own):
                raise ValueError(
                    f"frame {frame} is a {type_of(frame)}'s, and vehicle {vehicle} is a {own}: say so with "
                    f"`vehicles.type` or `vehicles.types`, or give it another frame in `vehicles.each`"
                )


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
