"""What a vehicle is: a program that speaks MAVLink on two TCP ports, and how it is started.

A vehicle lives in a network namespace of its own, so every vehicle listens on the same two ports: the ones that
ArduPilot SITL uses for its first two serial ports. The pilot (the orchestrator) has the first, the agent the second.
Which program it is, real ArduPilot or the embedded vehicle, is a `VehicleKind`; nothing else needs to know.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

PILOT_PORT = 5760  # ArduPilot SITL: serial0
AGENT_PORT = 5762  # ArduPilot SITL: serial1

METRES_PER_DEGREE = 111_319.5  # of latitude; ArduPilot's own scale (WGS 84 equatorial radius)
SPACING_M = 5.0

MAX_SYSID = 255  # MAVLink: u8 system ID, 0 is "everybody"


class VehicleError(Exception):
    """Something about a vehicle that its user can understand and mend; the message is one sentence and the way out."""


class NoBinaryError(VehicleError):
    """No ArduPilot was named and none is on PATH; a run may fall back to the embedded vehicle."""


class UnusableBinaryError(VehicleError):
    """An ArduPilot binary was named, or found, and cannot be run."""


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


@dataclass(frozen=True)
class Launch:
    """How to start one vehicle, in its own directory and network namespace."""

    argv: list[str]
    pilot_port: int = PILOT_PORT
    agent_port: int = AGENT_PORT
    env: Mapping[str, str] = field(default_factory=dict)  # to be set on top of the orchestrator's own


class VehicleKind(Protocol):
    """A kind of vehicle: prepares a vehicle's directory and says how to start it."""

    @property
    def name(self) -> str: ...

    def launch(self, sysid: int, home: Home, speedup: float, directory: Path) -> Launch:
        """Prepare `directory`, which exists and is the vehicle's working directory, and say how to start it.

        `speedup` is simulated seconds per second. Raises VehicleError when the vehicle cannot be had like that.
        """


def check_launch(sysid: int, speedup: float) -> None:
    """Raise VehicleError for a system ID or a speedup that no vehicle can have."""
    if not 1 <= sysid <= MAX_SYSID:
        raise VehicleError(f"vehicle {sysid}: a MAVLink system ID is 1 to {MAX_SYSID}")
    if not (math.isfinite(speedup) and speedup > 0):
        raise VehicleError(f"vehicle {sysid}: speedup {speedup} is not a positive number")


def home_in_field(index: int, centre: Home) -> Home:
    """The home of the index-th vehicle (from 0): a sunflower's seeds, no two closer than about SPACING_M.

    Any number of vehicles fits, and adding one moves none of the others.
    """
    radius = SPACING_M * math.sqrt(index)
    bearing = index * math.pi * (3 - math.sqrt(5))  # the golden angle
    return centre.offset(radius * math.cos(bearing), radius * math.sin(bearing))
