"""Read flight logs of ArduPilot: DataFlash logs (`.bin`), which the autopilot writes, and telemetry logs (`.tlog`),
which a ground station or the harness writes.

`read_flight_log` reads either format into a `FlightLog`, with the records of each vehicle in the order of the file:

    log = read_flight_log(Path("00000012.BIN"))
    for vehicle in log.vehicles:
        print(vehicle.vehicle, vehicle.type_name, len(vehicle.positions))

Two times belong to each record. `at_us` is the time on the clock of the log: since the boot of the autopilot (`.bin`),
or since the Unix epoch on the recording computer (`.tlog`). `utc_us` is the same moment by GPS, in microseconds since
the Unix epoch. It is None if the log has no GPS time. GPS time is late by the delay of the receiver or the link,
usually 0.1 to 0.3 s.

The readers of pymavlink index a whole file, print to the terminal, and may raise or loop for a damaged file. This
package therefore reads the files itself, in one pass, and uses only the message definitions of pymavlink. Bytes that
belong to no message are skipped and counted. The size of a file, and the numbers of messages, damaged parts and records
are limited. `FlightLog.problems` has a sentence for each problem.
"""

from pathlib import Path
from typing import TYPE_CHECKING

from harness.archive.bounded_file import BoundedFile
from harness.errors import FieldError
from harness.field.flight_logs._collecting import MAX_RECORDS, LogClock, RecordBudget, RecordCollector
from harness.field.flight_logs._dataflash import FMT, MAGIC, DataFlashReader
from harness.field.flight_logs._records import (
    ArmingChange,
    Battery,
    EkfStatus,
    FlightLog,
    GpsStatus,
    GpsTime,
    LogKind,
    ModeChange,
    Parameter,
    Position,
    RadioStatus,
    VehicleLog,
)
from harness.gc_pause import gc_paused
from ucp.telemetry import mode_name

if TYPE_CHECKING:
    from harness.field.flight_logs._collecting import DamagedBytes

__all__ = [
    "FlightLog",
    "GpsTime",
    "Position",
    "flight_log_kind",
    "read_flight_log",
]


MAX_LOG_BYTES = 1024 * 1024 * 1024
_BEGINNING_BYTES = 4096
_STAMP_BYTES = 8
"""Size of the time before each frame of a telemetry log."""
_FRAME_MARKS = (b"\xfd", b"\xfe")
"""The first byte of a MAVLink frame."""
_SUFFIXES: dict[str, LogKind] = {".bin": "DataFlash", ".tlog": "telemetry"}


def flight_log_kind(path: Path, beginning: bytes) -> LogKind | None:
    """Return the format of the flight log that begins with these bytes. Return None if the bytes do not begin a flight
    log.

    If the beginning is damaged, the format is recognised by the suffix of the file and by typical bytes of the format.
    """
    if beginning.startswith(MAGIC + bytes([FMT])):
        return "DataFlash"
    if beginning[_STAMP_BYTES : _STAMP_BYTES + 1] in _FRAME_MARKS and _begins_with_frame(beginning):
        return "telemetry"
    kind = _SUFFIXES.get(path.suffix.lower())
    marks = {"DataFlash": (MAGIC,), "telemetry": _FRAME_MARKS}
    return kind if kind is not None and any(mark in beginning for mark in marks[kind]) else None


def _begins_with_frame(beginning: bytes) -> bool:
    from harness.field.flight_logs._telemetry import begins_with_frame  # pymavlink takes 110 MiB and 0.5 s

    return begins_with_frame(beginning)


@gc_paused()
def read_flight_log(path: Path) -> FlightLog:
    """Read a flight log. The file may be compressed with gzip. Raises FieldError if the file cannot be read, or is not
    a flight log. The result reports every other problem as a sentence.
    """
    try:
        with BoundedFile(path, MAX_LOG_BYTES) as file:
            kind = flight_log_kind(path, file.peek(_BEGINNING_BYTES)[:_BEGINNING_BYTES])
            if kind is None:
                raise FieldError(
                    f"{path}: not a flight log, because it has no messages of DataFlash or MAVLink; give a .bin "
                    "or .tlog file"
                )
            log = (_read_dataflash if kind == "DataFlash" else _read_telemetry)(path, file)
            if file.problem:
                log.problems.append(file.problem)
            return log
    except OSError as error:
        raise FieldError(f"{path}: cannot be read: {error.strerror}; give a .bin or .tlog file") from None


def _read_dataflash(path: Path, file: BoundedFile) -> FlightLog:
    reader = DataFlashReader()
    reader.read(file)
    vehicle = _vehicle_log(reader.vehicle, reader.vehicle_id, reader.mav_type)
    problems = _problems(reader.problems, reader.damage, reader.clock, reader.budget)
    positions = reader.gps_positions.records_of(Position)
    if positions and not vehicle.positions:
        vehicle.positions.extend(positions)
        problems.append("the positions are those of the GPS receiver, because the log has no POS messages")
    if not reader.clock.has_time:
        problems.append("no message can be decoded; messages of type FMT at the beginning define all others")
    return FlightLog(path, "DataFlash", [vehicle], reader.vehicle.records_of(RadioStatus), reader.clock.jumps, problems)


def _read_telemetry(path: Path, file: BoundedFile) -> FlightLog:
    from harness.field.flight_logs._telemetry import TelemetryReader

    reader = TelemetryReader()
    reader.read(file)
    vehicles = [
        _vehicle_log(system.collector, system_id, system.mav_type)
        for system_id, system in sorted(reader.systems.items())
        if system.is_vehicle
    ]
    problems = _problems(reader.problems, reader.damage, reader.clock, reader.budget)
    if not vehicles:
        problems.append("no vehicle sent a heartbeat or a position")
    return FlightLog(path, "telemetry", vehicles, reader.radio.records_of(RadioStatus), reader.clock.jumps, problems)


def _vehicle_log(collector: RecordCollector, vehicle: int | None, mav_type: int | None) -> VehicleLog:
    modes = [
        change._replace(name=mode_name(change.number, mav_type or 0)) for change in collector.records_of(ModeChange)
    ]
    return VehicleLog(
        vehicle=vehicle,
        mav_type=mav_type,
        positions=collector.records_of(Position),
        modes=modes,
        arming=collector.records_of(ArmingChange),
        battery=collector.records_of(Battery),
        gps=collector.records_of(GpsStatus),
        ekf=collector.records_of(EkfStatus),
        gps_times=collector.records_of(GpsTime),
        parameters=collector.records_of(Parameter),
    )


def _problems(problems: list[str], damage: "DamagedBytes", clock: LogClock, budget: RecordBudget) -> list[str]:
    sentences = [*problems, *damage.sentences()]
    if budget.left < 0:
        sentences.append(f"only the first {MAX_RECORDS:,} records are kept")
    if clock.dropped:
        records = "1 record is" if clock.dropped == 1 else f"{clock.dropped:,} records are"
        sentences.append(f"{records} left out, because the time of each differs from the times before and after it")
    if clock.jumps:
        first = clock.jumps[0]
        times = "once" if len(clock.jumps) == 1 else f"{len(clock.jumps)} times"
        sentences.append(
            f"its clock jumps {times}, first by {first.by_us / 1e6:+,.1f} s (a restart, a correction or a pause)"
        )
    return sentences
