"""Read the telemetry logs of the vehicles, and skip damaged parts."""

import re
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

from pymavlink import mavutil

from harness.report.export._samples import MissionTime, TelemetrySample

NAME = "telemetry.tlog"
MAX_BYTES = 1024 * 1024 * 1024
MAX_FILES = 1000
_LIFE = re.compile(r"([1-9]\d{0,4})(?:-([1-9]\d{0,3}))?")


def telemetry_logs(directory: Path) -> list[tuple[int, Path]]:
    """Return the vehicle and the path of each telemetry log. A restarted vehicle has several logs."""
    logs = []
    for path in islice((directory / "vehicles").glob(f"*/{NAME}"), MAX_FILES):
        if named := _LIFE.fullmatch(path.parent.name):
            logs.append((int(named[1]), int(named[2] or 1), path))
    return [(vehicle, path) for vehicle, _, path in sorted(logs)]


def read_telemetry(vehicle: int, path: Path, time: MissionTime, problems: list[str]) -> Iterator[TelemetrySample]:
    """Yield the messages of a telemetry log. At the end, add sentences about damage in the log to `problems`."""
    damaged = untimed = 0
    if not path.is_file():
        problems.append(f"{path}: cannot be read: it is not a file")
        return
    try:
        if path.stat().st_size > MAX_BYTES:
            problems.append(
                f"{path}: larger than {MAX_BYTES // 1024**2} MiB, which is too large for a log of a "
                "flight; it is left out"
            )
            return
        log = mavutil.mavlogfile(str(path), robust_parsing=True)
    except OSError as error:
        problems.append(f"{path}: cannot be read: {error.strerror}")
        return
    try:
        while (message := log.recv_msg()) is not None:
            kind = message.get_type()
            if kind == "BAD_DATA":
                damaged += 1
            elif (at_ns := time.of_wall(message._timestamp)) is None:
                untimed += 1
            elif not kind.startswith("UNKNOWN_"):
                yield TelemetrySample(at_ns, vehicle, message)
    finally:
        log.f.close()
    if damaged:
        problems.append(f"{path}: damaged in {damaged} places; the messages between are read")
    if untimed:
        problems.append(f"{path}: {untimed} messages with an impossible time are left out")
