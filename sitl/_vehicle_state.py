"""Store the last reported state of a vehicle."""

from __future__ import annotations

import collections
from dataclasses import dataclass, field


@dataclass(frozen=True)
class ReportedPosition:
    """A position that a vehicle has reported, in degrees. The heights are in metres above sea level and above home. The
    velocity is in metres per second to the north, to the east and upwards. The heading is in degrees clockwise from
    north, or None if the vehicle does not know its heading.
    """

    lat_deg: float
    lon_deg: float
    alt_m: float
    relative_alt_m: float
    north_ms: float = 0.0
    east_ms: float = 0.0
    up_ms: float = 0.0
    heading_deg: float | None = None


@dataclass(frozen=True)
class Battery:
    """The voltage of a battery, and the share of its charge that is left, from 0 to 1. A value is None if the vehicle
    did not report it.
    """

    voltage_v: float | None
    left: float | None


@dataclass(frozen=True)
class FirmwareVersion:
    """A firmware version such as "4.7.0-dev", and the first digits of its git commit if reported."""

    number: str
    commit: str | None = None

    @classmethod
    def of(cls, number: int, custom: bytes) -> FirmwareVersion:
        """Return the version in a MAVLink message AUTOPILOT_VERSION."""
        major, minor, patch, kind = number.to_bytes(4, "big")
        stages = {0: "-dev", 64: "-alpha", 128: "-beta", 192: "-rc"}
        stage = next((word for least, word in sorted(stages.items(), reverse=True) if kind >= least), "")
        commit = custom.rstrip(b"\0").decode("ascii", "replace")
        is_commit = commit.isalnum() and commit.isascii()
        return cls(f"{major}.{minor}.{patch}{'' if kind == 255 else stage}", commit if is_commit else None)


@dataclass
class VehicleState:
    """The state of a vehicle. None means that a value was not reported yet."""

    mode: int | None = None  # ArduPilot's custom_mode
    mav_type: int | None = None  # MAV_TYPE
    version: FirmwareVersion | None = None
    armed: bool = False
    ready_to_arm: bool | None = None
    position: ReportedPosition | None = None  # the last one with a good estimate
    has_moved: bool = False  # true if it was ever armed and away from its home
    battery: Battery | None = None
    time_s: float | None = None  # simulated seconds since boot
    item: int | None = None  # number of the mission item to which it flies
    reached: int | None = None  # number of the last mission item that it reported as reached
    texts: collections.deque[str] = field(default_factory=lambda: collections.deque(maxlen=20))  # the latest is last
    messages: int = 0
    garbage: int = 0  # number of byte sequences that were no message
    log_error: str | None = None  # reason if the telemetry log ended early
