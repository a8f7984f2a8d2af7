"""Define the types of records in a flight log. The docstring of the package explains their times."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple, TypeAlias

LogKind = Literal["DataFlash", "telemetry"]


class Position(NamedTuple):
    """The position of the vehicle, as the autopilot estimated it."""

    at_us: int
    utc_us: int | None
    lat_deg: float
    lon_deg: float
    alt_m: float
    """Altitude above mean sea level."""
    relative_alt_m: float | None
    """Altitude above the home position."""


class ModeChange(NamedTuple):
    """A new flight mode, or the mode at the beginning of the log."""

    at_us: int
    utc_us: int | None
    number: int
    name: str
    """The name of the flight mode, or its number if the mode has no known name."""
    failsafe: str | None = None
    """The failsafe that caused the change of mode, such as "battery failsafe". Only DataFlash logs contain this cause.
    """


class ArmingChange(NamedTuple):
    """The arming or disarming of the vehicle, or its state at the beginning of the log."""

    at_us: int
    utc_us: int | None
    armed: bool


class Battery(NamedTuple):
    """The state of a battery. There is at most one record per second for each battery."""

    at_us: int
    utc_us: int | None
    instance: int
    voltage_v: float
    current_a: float | None
    remaining_percent: float | None


class GpsStatus(NamedTuple):
    """The state of a GPS receiver. There is at most one record per second while receiver and fix type stay the same."""

    at_us: int
    utc_us: int | None
    instance: int
    fix: int
    """GPS_FIX_TYPE: 0 or 1 no fix, 2 two dimensions, 3 three dimensions, 4 differential, 5 and 6 RTK."""
    satellites: int
    hdop: float | None


class EkfStatus(NamedTuple):
    """The state of the active position filter (EKF). There is at most one record per second while the flags stay the
    same.

    A variance is the square root of the normalised innovation test ratio. If a variance is above 1, the EKF rejects the
    measurement.
    """

    at_us: int
    utc_us: int | None
    flags: int
    """EKF_STATUS_FLAGS in bits 0 to 9. A DataFlash log may have more bits."""
    velocity_variance: float
    position_variance: float
    height_variance: float
    compass_variance: float


class GpsTime(NamedTuple):
    """The GPS time at a certain time of the log's clock. There is at most one record per second."""

    at_us: int
    utc_us: int
    """UTC according to this record alone. In all other records, `utc_us` is computed from the median of many GPS
    times.
    """
    week: int
    week_ms: int
    leap_seconds: int
    """GPS time minus UTC at this time, in seconds. The value comes from a table, because logs do not contain it."""


class RadioStatus(NamedTuple):
    """The state of a telemetry radio (SiK, RFD900). RSSI and noise have the unit of the radio, which is
    usually 0.5 dB.
    """

    at_us: int
    utc_us: int | None
    rssi: int
    remote_rssi: int
    noise: int
    remote_noise: int
    tx_buffer_percent: int
    """Free space in the transmit buffer."""
    rx_errors: int
    fixed: int
    """Number of packets that the radio repaired with error correction."""


class Parameter(NamedTuple):
    """The value of a parameter, at the beginning of the log and after each change."""

    at_us: int
    utc_us: int | None
    name: str
    value: float


class ClockJump(NamedTuple):
    """A jump of the log's clock. One record with an unexpected time is not yet a jump, because its time may be damaged.
    The reader records a jump when the time of the next record confirms the new time.

    The cause may be a restart of the autopilot, a correction of the computer's clock, or a pause of the log. The log
    does not show which. Only if the time decreases, the clock was certainly wrong.
    """

    at_us: int
    """The last time before the jump."""
    by_us: int


FlightRecord: TypeAlias = (
    Position | ModeChange | ArmingChange | Battery | GpsStatus | EkfStatus | GpsTime | RadioStatus | Parameter
)


@dataclass(frozen=True)
class VehicleLog:
    """The records of one vehicle in a flight log."""

    vehicle: int | None
    """The MAVLink system ID, or None if a DataFlash log does not contain the parameter with this ID."""
    mav_type: int | None
    """The type of the vehicle (MAV_TYPE): 1 plane, 2 quadcopter, 10 rover. A DataFlash log has 2 for every kind of
    copter.
    """
    positions: list[Position]
    modes: list[ModeChange]
    arming: list[ArmingChange]
    battery: list[Battery]
    gps: list[GpsStatus]
    ekf: list[EkfStatus]
    gps_times: list[GpsTime]
    parameters: list[Parameter]

    @property
    def type_name(self) -> str:
        """Return "plane", "copter" or "rover". Return "vehicle" for any other type and for an unknown type."""
        return _TYPE_NAMES.get(self.mav_type or 0, "vehicle")

    def latest_parameters(self) -> dict[str, float]:
        """Return the last value of each parameter."""
        return {parameter.name: parameter.value for parameter in self.parameters}


@dataclass(frozen=True)
class FlightLog:
    """The content of one flight log file."""

    path: Path
    kind: LogKind
    vehicles: list[VehicleLog]
    """The vehicles in the log. A DataFlash log has one vehicle. A telemetry log has one or more vehicles, in the order
    of their system IDs.
    """
    radio: list[RadioStatus]
    """The states of the radio at the autopilot (DataFlash), or at the recording computer (telemetry)."""
    clock_jumps: list[ClockJump]
    problems: list[str]
    """A sentence for each problem of the file. The sentences do not contain the name of the file."""


_TYPE_NAMES = {
    1: "plane",
    **dict.fromkeys((2, 3, 4, 13, 14, 15, 29), "copter"),
    **dict.fromkeys((10, 11), "rover"),
    **dict.fromkeys(range(19, 26), "plane"),
}
