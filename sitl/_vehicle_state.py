"""Store the last reported state of a vehicle."""

from __future__ import annotations

import collections
from dataclasses import dataclass, field


@dataclass(frozen=True)
class ReportedPosition:
    """A reported position in degrees, with its heights in metres above sea level and above home.

    The movement is in metres per second north, east and up. The heading is in degrees clockwise from north. It is None
    if unknown.
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
    """The voltage and the remaining share (0 to 1) of a battery. A value of None is unknown."""

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
    position: ReportedPosition | None = None  # as it last said while its estimate was good
    has_moved: bool = False  # it was armed and off its home
    battery: Battery | None = None
    time_s: float | None = None  # simulated, since boot
    item: int | None = None  # of the mission, where it is heading
    reached: int | None = None  # the last item of the mission that it says it has reached
    texts: collections.deque[str] = field(default_factory=lambda: collections.deque(maxlen=20))  # latest last
    messages: int = 0
    garbage: int = 0  # stretches of bytes that were no message
    log_error: str | None = None  # why the telemetry log ends early, when it does
