"""What a vehicle is: a program that speaks MAVLink on three TCP ports, and how it is started.

A vehicle lives in a network namespace of its own, so every vehicle listens on the same ports: the ones that ArduPilot
SITL uses for its first three serial ports. The pilot (the orchestrator) has the first, the agent the second, and a
ground station the third.
Which program it is, real ArduPilot or the embedded vehicle, is a `VehicleKind`; nothing else needs to know.
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

READY_S = 10.0  # simulated seconds from the boot of an embedded vehicle until it knows where it is and can be armed

MAX_SYSID = 255  # MAVLink: u8 system ID, 0 is "everybody"


class VehicleError(Exception):
    """The base of all errors of `sitl`: one sentence for the user on the cause and the way out."""


class NoBinaryError(VehicleError):
    """No ArduPilot was named and none is on PATH; a run may fall back to the embedded vehicle."""


class UnusableBinaryError(VehicleError):
    """An ArduPilot binary was named, or found, and cannot be run."""


class NoProgramError(VehicleError):
    """A program that is to run around a vehicle is not on this machine."""


class FlightError(VehicleError):
    """A vehicle did not do what its pilot asked, or stopped answering."""


@dataclass(frozen=True)
class Home:
    """A place on the ground: degrees (WGS 84), metres above sea level, heading in degrees clockwise from north."""

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
            raise VehicleError(f"home heading {self.heading_deg} is no heading: give 0 to 359 degrees")

    def __str__(self) -> str:
        """The form of ArduPilot's `--home` option: LAT,LON,ALT,HDG."""
        return f"{self.lat_deg:.7f},{self.lon_deg:.7f},{self.alt_m:.2f},{self.heading_deg:.1f}"

    @classmethod
    def parse(cls, text: str) -> Home:
        """Read LAT,LON,ALT,HDG. Raises VehicleError when it is anything else."""
        try:
            lat, lon, alt, heading = (float(part) for part in text.split(","))
        except ValueError:
            raise VehicleError(
                f"home {text!r} is not LAT,LON,ALT,HDG: give four numbers, for example -35.363262,149.165237,584,270"
            ) from None
        return cls(lat, lon, alt, heading)

    def offset(self, north_m: float, east_m: float) -> Home:
        """The place this far away, same altitude and heading. Flat earth: good for a flying field, not for a voyage."""
        lat = self.lat_deg + north_m / METRES_PER_DEGREE
        lon = self.lon_deg + east_m / (METRES_PER_DEGREE * max(math.cos(math.radians(self.lat_deg)), 1e-6))
        return Home(max(-90.0, min(90.0, lat)), (lon + 180.0) % 360.0 - 180.0, self.alt_m, self.heading_deg)

    def metres_to(self, lat_deg: float, lon_deg: float, alt_m: float) -> tuple[float, float, float]:
        """How far north, east and above this place that one is. The inverse of `offset`, and as flat."""
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
    env: Mapping[str, str] = field(default_factory=dict)  # to be set on top of the orchestrator's own


class VehicleKind(Protocol):
    """A kind of vehicle. It prepares a vehicle's directory and returns the command that starts the vehicle."""

    @property
    def name(self) -> str: ...

    @property
    def vehicle_type(self) -> VehicleType: ...

    @property
    def frame(self) -> str | None:
        """What its program calls its frame, if it has several."""

    @property
    def sha256(self) -> str | None:
        """The hash of its program, if that is a file of its own."""

    @property
    def parameters(self) -> Mapping[str, float]:
        """What its user gives it, which it has to know."""

    @property
    def lack(self) -> str | None:
        """What it may need to fly and does not have, with the way out; None if nothing is known to be missing."""

    def check(self) -> None:
        """Raises VehicleError if it cannot be had as it is set up."""

    def launch(self, sysid: int, home: Home, speedup: float, directory: Path) -> Launch:
        """Prepare `directory`, which exists and is the vehicle's working directory, and say how to start it.

        `speedup` is simulated seconds per second. Raises VehicleError when the vehicle cannot be had like that.
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
    """Metres north and east of the field's centre, for the index-th vehicle (from 0): a sunflower's seeds.

    No two are closer than about `spacing_m`, any number of vehicles fits, and adding one moves none of the others.
    """
    radius = spacing_m * math.sqrt(index)
    bearing = index * math.pi * (3 - math.sqrt(5))  # the golden angle
    return radius * math.cos(bearing), radius * math.sin(bearing)


def home_in_field(index: int, centre: Home, spacing_m: float = SPACING_M) -> Home:
    """The home of the index-th vehicle (from 0) of a field, at `place_in_field`."""
    return centre.offset(*place_in_field(index, spacing_m))
