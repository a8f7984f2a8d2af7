"""Define a vehicle: a program that offers MAVLink on three TCP ports, and the command that starts it.

Each vehicle runs in its own network namespace, so all vehicles can listen on the same ports. These are the first three
serial ports of ArduPilot SITL. The pilot in the harness uses the first port, the agent the second, and a ground station
the third. A `VehicleKind` represents the program: ArduPilot or the embedded vehicle. Other code does not depend on the
program.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Protocol, get_args

VehicleType = Literal["copter", "plane", "rover"]
VEHICLE_TYPES: tuple[VehicleType, ...] = get_args(VehicleType)

PILOT_PORT = 5760  # ArduPilot SITL: serial0
AGENT_PORT = 5762  # ArduPilot SITL: serial1
STATION_PORT = 5763  # ArduPilot SITL: serial2

METRES_PER_DEGREE = 111_319.5  # of latitude; ArduPilot's own scale (WGS 84 equatorial radius)
SPACING_M = 5.0

READY_S = 10.0  # simulated seconds after which a booted embedded vehicle knows its position and can be armed

MAX_SYSID = 255  # a MAVLink system ID is a u8, and 0 means all systems


class VehicleError(Exception):
    """The base class of all errors of this package. Each is one sentence for the user with the cause and a solution."""


class NoBinaryError(VehicleError):
    """An error: no ArduPilot binary is given or found. A run may use the embedded vehicle instead."""


class UnusableBinaryError(VehicleError):
    """An error: an ArduPilot binary was given or found, but cannot be run."""


class NoProgramError(VehicleError):
    """An error: a program that the vehicle needs, such as a debugger, is not on this machine."""


class FlightError(VehicleError):
    """An error: a vehicle did not do what its pilot requested, or stopped answering."""


@dataclass(frozen=True)
class Home:
    """A place on the ground: degrees (WGS 84), metres above sea level, and a heading in degrees clockwise from
    north.
    """

    lat_deg: float
    lon_deg: float
    alt_m: float = 0.0
    heading_deg: float = 0.0

    def __post_init__(self) -> None:
        if not all(math.isfinite(value) for value in (self.lat_deg, self.lon_deg, self.alt_m, self.heading_deg)):
            raise VehicleError(f"home {self} is not on Earth: give finite numbers")
        if not -90 <= self.lat_deg <= 90:
            raise VehicleError(f"home latitude {self.lat_deg} is not on Earth: give -90 to 90 degrees")
        if not -180 <= self.lon_deg <= 180:
            raise VehicleError(f"home longitude {self.lon_deg} is not on Earth: give -180 to 180 degrees")
        if not 0 <= self.heading_deg < 360:
            raise VehicleError(f"home heading {self.heading_deg} is not valid: give 0 to 359 degrees")

    def __str__(self) -> str:
        """Return the place in the format of ArduPilot's option `--home`: LAT,LON,ALT,HDG."""
        return f"{self.lat_deg:.7f},{self.lon_deg:.7f},{self.alt_m:.2f},{self.heading_deg:.1f}"

    @classmethod
    def parse(cls, text: str) -> Home:
        """Parse a place in the form LAT,LON,ALT,HDG. Raises VehicleError for any other text."""
        try:
            lat, lon, alt, heading = (float(part) for part in text.split(","))
        except ValueError:
            raise VehicleError(
                f"home {text!r} is not LAT,LON,ALT,HDG: give four numbers, for example -35.363262,149.165237,584,270"
            ) from None
        return cls(lat, lon, alt, heading)

    def offset(self, north_m: float, east_m: float) -> Home:
        """Return the place at this offset in metres, with the same altitude and heading.

        The calculation assumes a flat earth, which is accurate enough for a flying field.
        """
        lat = self.lat_deg + north_m / METRES_PER_DEGREE
        lon = self.lon_deg + east_m / (METRES_PER_DEGREE * max(math.cos(math.radians(self.lat_deg)), 1e-6))
        return Home(max(-90.0, min(90.0, lat)), (lon + 180.0) % 360.0 - 180.0, self.alt_m, self.heading_deg)

    def metres_to(self, lat_deg: float, lon_deg: float, alt_m: float) -> tuple[float, float, float]:
        """Return the offset of another place from this place, in metres north, east and up. This method is the inverse
        of `offset`.
        """
        north_m = (lat_deg - self.lat_deg) * METRES_PER_DEGREE
        degrees_east = (lon_deg - self.lon_deg + 180.0) % 360.0 - 180.0
        east_m = degrees_east * METRES_PER_DEGREE * max(math.cos(math.radians(self.lat_deg)), 1e-6)
        return north_m, east_m, alt_m - self.alt_m


@dataclass(frozen=True)
class Launch:
    """The command that starts one vehicle in its own directory and network namespace."""

    argv: list[str]
    pilot_port: int = PILOT_PORT
    agent_port: int = AGENT_PORT
    station_port: int = STATION_PORT
    env: Mapping[str, str] = field(default_factory=dict)  # variables to add to the orchestrator's environment


class VehicleKind(Protocol):
    """A kind of vehicle. It prepares a vehicle's directory and returns the command that starts the vehicle."""

    @property
    def name(self) -> str: ...

    @property
    def vehicle_type(self) -> VehicleType: ...

    @property
    def frame(self) -> str | None:
        """The name by which the program knows the frame. None if the program has only one frame."""

    @property
    def sha256(self) -> str | None:
        """The SHA-256 hash of the program in hexadecimal, or None if the program is not a single file."""

    @property
    def parameters(self) -> Mapping[str, float]:
        """The parameters that the user has set. The vehicle must know each of them."""

    @property
    def lack(self) -> str | None:
        """A sentence that names a missing requirement for a flight and its remedy. None if nothing is missing."""

    @property
    def uses_udp(self) -> bool:
        """True if the program receives UDP datagrams in its network namespace."""

    def check(self) -> None:
        """Raise VehicleError if this machine cannot run the vehicle with its settings."""

    def launch(self, sysid: int, home: Home, speedup: float, directory: Path) -> Launch:
        """Prepare the working directory of a vehicle, and return the command that starts it.

        `sysid` is the MAVLink system ID, 1 to 255. `speedup` is in simulated seconds per second. `directory` must
        exist. Raises VehicleError for an impossible argument.
        """


def check_launch(sysid: int, home: Home, speedup: float) -> None:
    """Raise VehicleError for a system ID, a home or a speedup that no vehicle can have."""
    if not 1 <= sysid <= MAX_SYSID:
        raise VehicleError(f"vehicle {sysid}: a MAVLink system ID is 1 to {MAX_SYSID}")
    if home.lat_deg == home.lon_deg == 0:
        raise VehicleError(f"vehicle {sysid}: a home at 0,0 is ArduPilot's word for no position: move it by a metre")
    if not (math.isfinite(speedup) and speedup > 0):
        raise VehicleError(f"vehicle {sysid}: speedup {speedup} is not a positive number")


def place_in_field(index: int, spacing_m: float = SPACING_M) -> tuple[float, float]:
    """Return the home position of the vehicle with this index, in metres north and east of the centre of the field.
    Indexes begin at 0.

    The places have the pattern of sunflower seeds. Two places are at least about `spacing_m` apart. The pattern allows
    any number of vehicles. The home of a vehicle does not depend on the number of vehicles.
    """
    radius = spacing_m * math.sqrt(index)
    bearing = index * math.pi * (3 - math.sqrt(5))  # the golden angle
    return radius * math.cos(bearing), radius * math.sin(bearing)


def home_in_field(index: int, centre: Home, spacing_m: float = SPACING_M) -> Home:
    """Return the home position of the vehicle with this index, counted from 0."""
    return centre.offset(*place_in_field(index, spacing_m))
