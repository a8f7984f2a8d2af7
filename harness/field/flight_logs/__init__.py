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

from harness.field.flight_logs._reading import flight_log_kind, read_flight_log
from harness.field.flight_logs._records import (
    ArmingChange,
    Battery,
    ClockJump,
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

__all__ = [
    "ArmingChange",
    "Battery",
    "ClockJump",
    "EkfStatus",
    "FlightLog",
    "GpsStatus",
    "GpsTime",
    "LogKind",
    "ModeChange",
    "Parameter",
    "Position",
    "RadioStatus",
    "VehicleLog",
    "flight_log_kind",
    "read_flight_log",
]
