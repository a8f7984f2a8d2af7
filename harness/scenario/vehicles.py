"""Describe the vehicles of a scenario and their flight plans."""

import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, ValidationInfo, model_validator

from harness.scenario.strict_model import StrictModel, VehicleId, VehicleKey
from sitl import parameters, start_places
from sitl.airframes import NOT_FLOWN, airframe
from sitl.plan import MAX_LEGS, By, GoTo, Land, Loiter, Plan, TakeOff
from sitl.plan import Leg as PlannedLeg
from sitl.setup import Debugger, VehicleSetup
from sitl.start_places import HomeOffset
from sitl.vehicle import SPACING_M, Home, VehicleError, VehicleType, home_in_field

VehicleKind = Literal["ardupilot", "embedded", "none"]

MAX_ARGUMENTS = 100
LONG_OPTIONS = ("instance", "home", "model", "speedup", "console", "defaults", "sysid", "base-port", "uartA", "uartB")
RESERVED_LONG_OPTIONS = frozenset({*(f"--{name}" for name in LONG_OPTIONS), *(f"--serial{port}" for port in range(3))})
RESERVED_SHORT_OPTIONS = frozenset({"-I", "-O", "-M", "-s", "-C"})
"""Options of ArduPilot's command line that only the harness may set."""


def _from_file(read: Callable[[str, Path], Any], written_out: Any) -> BeforeValidator:
    """Return a validator that replaces the name of a file in the scenario's directory by the content of the file.

    `read` reads the file. `written_out` is the type of a value that is not a file name.
    """

    def value(asked: Any, info: ValidationInfo) -> Any:
        if not isinstance(asked, str):
            return asked
        beside = (info.context or {}).get("beside")
        if beside is None:
            raise ValueError("only a scenario in a file can name another file: write out its content")
        try:
            return read(asked, beside)
        except VehicleError as error:
            raise ValueError(str(error)) from None

    return BeforeValidator(value, json_schema_input_type=str | written_out)


def _named_place(name: str, beside: Path) -> list[float]:
    home = start_places.named(name, beside, os.environ)
    return [home.lat_deg, home.lon_deg, home.alt_m, home.heading_deg]


def _checked(values: dict[str, float]) -> dict[str, float]:
    try:
        parameters.check(values)
    except VehicleError as error:
        raise ValueError(str(error)) from None
    return values


def _check_frame(frame: str) -> str:
    if program := NOT_FLOWN.get(frame):
        raise ValueError(f"has the type {program}, which is unknown: use copter, plane or rover")
    return frame


def _check_arguments(arguments: list[str]) -> list[str]:
    for argument in arguments:
        is_ours = argument.partition("=")[0] in RESERVED_LONG_OPTIONS or argument[:2] in RESERVED_SHORT_OPTIONS
        if is_ours or "\0" in argument:
            raise ValueError(f"has {argument!r}, which the harness sets: leave it out")
    return arguments


def _check_place(home: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    latitude, longitude, _, _ = home
    if not all(math.isfinite(value) for value in home) or abs(latitude) > 90 or abs(longitude) > 180:
        raise ValueError("needs latitude -90..90, longitude -180..180, altitude (m) and heading (degrees)")
    if latitude == longitude == 0:
        raise ValueError("ArduPilot reads latitude and longitude 0 as no position: move it by one metre")
    return home


Coordinates = tuple[float, float, float, float]
Place = Annotated[Coordinates, AfterValidator(_check_place), _from_file(_named_place, Coordinates)]
"""A place: latitude and longitude in degrees, altitude in metres, heading in degrees. Or a name from a
`locations.txt`.
"""

Pairs = dict[str, float]
Parameters = Annotated[
    Pairs, AfterValidator(_checked), _from_file(lambda name, beside: parameters.read(beside / name), Pairs)
]
"""ArduPilot parameters: name -> value, or the name of a parameter file."""

Offsets = dict[Annotated[int, Field(ge=0, le=start_places.MAX_INSTANCE)], HomeOffset]
SwarmOffsets = Annotated[Offsets, _from_file(lambda name, beside: start_places.swarm(beside / name), Offsets)]
"""Number of an ArduPilot instance, from 0 -> its offset. Or the name of a file with offsets."""

Frame = Annotated[str, Field(pattern=r"^[A-Za-z0-9+][A-Za-z0-9_.+-]{0,63}$"), AfterValidator(_check_frame)]
Arguments = Annotated[
    list[Annotated[str, Field(max_length=1000)]], Field(max_length=MAX_ARGUMENTS), AfterValidator(_check_arguments)
]


class Wind(StrictModel):
    """The wind in ArduPilot's simulation from the start of the mission on."""

    speed_ms: Annotated[float, Field(ge=0, le=100)]
    """Speed in metres per second (`SIM_WIND_SPD`)."""
    from_deg: Annotated[float, Field(ge=0, le=360)] = 180.0
    """Direction from which the wind blows, in degrees clockwise from north (`SIM_WIND_DIR`)."""
    turbulence: Annotated[float, Field(ge=0, le=100)] = 0.0
    """Strength of the turbulence (`SIM_WIND_TURB`)."""

    def parameters(self) -> dict[str, float]:
        return {"SIM_WIND_SPD": self.speed_ms, "SIM_WIND_DIR": self.from_deg, "SIM_WIND_TURB": self.turbulence}


class EachVehicle(StrictModel):
    """Settings of one vehicle. They override the settings of all vehicles."""

    frame: Frame | None = None
    """Frame that ArduPilot simulates. Default: the frame of all vehicles."""
    parameters: Parameters = {}
    """ArduPilot parameters, in addition to the parameters of all vehicles."""
    wind: Wind | None = None
    """Wind at this vehicle. Default: the wind of all vehicles."""
    home: Place | None = None
    """Home of this vehicle, in the form of `vehicles.home`. By default, it is a place in the field, or comes from
    `vehicles.swarm`.
    """
    arguments: Arguments = []
    """Arguments for ArduPilot, after the arguments of all vehicles."""
    debugger: Debugger | None = None
    """Debugger of this vehicle. Default: the debugger of all vehicles."""


class Vehicles(StrictModel):
    """The vehicles that carry the agents."""

    kind: VehicleKind | None = None
    """`ardupilot`: ArduPilot's SITL. `embedded`: simple vehicles inside the harness. `none`: no vehicles. The default
    is `ardupilot` if a binary for each type is installed, and otherwise `embedded`.
    """
    type: VehicleType = "copter"
    """Type of all vehicles that `types` does not list."""
    types: dict[VehicleKey, VehicleType] = {}
    """Types of single vehicles, by vehicle ID."""
    binary: Path | None = None
    """Path of the ArduPilot binary. It is an error if the vehicles have more than one type."""
    frame: Frame | None = None
    """Frame that ArduPilot simulates, such as quadplane, motorboat, heli or hexa. It is an error if the frame is
    unknown or belongs to another type of vehicle. Default: the frame of the type.
    """
    parameters: Parameters = {}
    """ArduPilot parameters at the start, as pairs of name and value, or the name of a parameter file."""
    wind: Wind | None = None
    """Wind in ArduPilot's simulation."""
    arguments: Arguments = []
    """Additional arguments for ArduPilot, at most 100. It is an error to give an option that the harness sets itself,
    such as `--home`.
    """
    debugger: Debugger | None = None
    """Debugger that runs ArduPilot. gdb reports the place of a crash. valgrind reports memory errors."""
    log_mib: Annotated[int, Field(ge=0, le=1_000_000)] | None = 16
    """Maximum size in MiB of ArduPilot's log of one vehicle. With 0, ArduPilot writes no log. With null, the size is
    not limited. A log grows by about 3 MiB per minute.
    """
    takeoff_altitude_m: Annotated[float, Field(gt=0, le=1000)] = 20.0
    """Altitude in metres above home to which vehicles without a flight plan take off."""
    home: Place = (-35.363262, 149.165237, 584.0, 353.0)
    """Home of the first vehicle: latitude and longitude in degrees, altitude in metres, heading in degrees. Or a name
    from a file `locations.txt` in ArduPilot's format. The file is searched in the directory of the scenario, in the
    user's own ArduPilot directory, and next to the binary.
    """
    spacing_m: Annotated[float, Field(gt=0, le=10_000)] = SPACING_M
    """Approximate distance in metres between homes. The homes form a field around the home of the first vehicle."""
    swarm: SwarmOffsets = {}
    """Homes of single vehicles, relative to `home`: [east, north, up in metres, heading in degrees]. Or the name of a
    file in the format of ArduPilot's swarminit.txt. The keys are ArduPilot's instance numbers: 0 is the vehicle with
    the lowest ID. Vehicles that are not listed start in the field.
    """
    each: dict[VehicleKey, EachVehicle] = {}
    """Settings of single vehicles, by vehicle ID."""

    def type_of(self, vehicle: int) -> VehicleType:
        return self.types.get(vehicle, self.type)

    def setup_of(self, vehicle: int) -> VehicleSetup:
        """Return the frame, parameters, arguments, debugger and log size of this vehicle."""
        own = self.each.get(vehicle, EachVehicle())
        given: dict[str, float] = {}
        for asked in (self, own):
            given |= asked.wind.parameters() if asked.wind else {}
            given |= asked.parameters
        return VehicleSetup(
            own.frame or self.frame,
            given,
            (*self.arguments, *own.arguments),
            own.debugger or self.debugger,
            self.log_mib,
        )

    def home_of(self, vehicle: int, index: int) -> Home:
        """Return the home position of the vehicle at this index. Raises VehicleError if it is not a place on Earth."""
        own, first = self.each.get(vehicle, EachVehicle()).home, self.field
        if own is not None:
            return Home(own[0], own[1], own[2], own[3] % 360)
        if offset := self.swarm.get(index):
            return offset.of(first)
        return home_in_field(index, first, self.spacing_m)

    @property
    def field(self) -> Home:
        """The home position of the first vehicle. It is the middle of the field."""
        return Home(*self.home[:3], self.home[3] % 360)

    def check_frames(self, roster: tuple[int, ...]) -> None:
        """Raise ValueError for an unknown frame, or for a frame of a different vehicle type."""
        for vehicle in roster:
            frame, own = self.setup_of(vehicle).frame, self.type_of(vehicle)
            try:
                of_type = airframe(frame, own).vehicle_type
            except VehicleError as error:
                raise ValueError(str(error)) from None
            if of_type != own:
                raise ValueError(
                    f"frame {frame} belongs to a {of_type}, but vehicle {vehicle} is a {own}: change "
                    "`vehicles.type` or `vehicles.types`, or give it another frame in `vehicles.each`"
                )


LEGS = ("take_off", "go_to", "loiter_s", "land")


class Leg(StrictModel):
    """One leg of a flight plan. Needs exactly one of `take_off`, `go_to`, `loiter_s` and `land`."""

    take_off: float | None = None
    """Altitude in metres above home to which the vehicle takes off."""
    go_to: tuple[float, float] | None = None
    """Destination as [north, east] in metres from home."""
    altitude_m: float | None = None
    """Altitude in metres above home, only for `go_to`. By default, the altitude does not change."""
    speed_ms: float | None = None
    """Speed in metres per second, only for `go_to`. The default depends on the type of the vehicle."""
    loiter_s: float | None = None
    """Mission seconds for which the vehicle stays in place. A plane flies circles."""
    land: Literal[True] | None = None
    """If true, the vehicle lands."""

    @model_validator(mode="after")
    def _one_leg(self) -> "Leg":
        if sum(getattr(self, leg) is not None for leg in LEGS) != 1:
            raise ValueError("needs exactly one of `take_off`, `go_to`, `loiter_s`, `land: true`")
        if self.go_to is None and (self.altitude_m is not None or self.speed_ms is not None):
            raise ValueError("`altitude_m` and `speed_ms` belong to a `go_to`")
        return self

    def to_planned_leg(self) -> PlannedLeg:
        if self.take_off is not None:
            return TakeOff(self.take_off)
        if self.go_to is not None:
            return GoTo(*self.go_to, self.altitude_m, self.speed_ms)
        return Loiter(self.loiter_s) if self.loiter_s is not None else Land()


class Flight(StrictModel):
    """A flight plan and the vehicles that fly it."""

    vehicles: Annotated[list[VehicleId], Field(min_length=1)]
    """IDs of the vehicles that fly the plan. It is an error if a vehicle is in two plans."""
    by: By = "mission"
    """`mission` or `guided`. With `mission`, the plan is uploaded with the MAVLink mission protocol and flown in AUTO
    mode. With `guided`, the legs are commanded one after another in GUIDED mode.
    """
    plan: Annotated[list[Leg], Field(min_length=1, max_length=MAX_LEGS)]
    """Legs in the order of the flight. It is an error if the type of vehicle cannot fly a leg."""

    def to_plan(self) -> Plan:
        return Plan(tuple(leg.to_planned_leg() for leg in self.plan))
