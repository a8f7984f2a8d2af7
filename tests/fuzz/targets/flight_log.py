"""Flight logs of vehicles. The first byte chooses the suffix of the file, which matters for a damaged beginning."""

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory

from harness.errors import HarnessError
from harness.field.flight_logs import read_flight_log
from tests.fuzz.finding import require, sound
from tests.harness.field import flight_log_files as files


def run(data: bytes) -> None:
    with TemporaryDirectory() as directory:
        path = Path(directory) / ("1.bin" if data[:1] < b"\x80" else "1.tlog")
        path.write_bytes(data[1:])
        try:
            log = read_flight_log(path)
        except HarnessError as error:
            sound(str(error))
            return
    for problem in log.problems:
        sound(problem)
    for vehicle in log.vehicles:
        sound(repr(vehicle.latest_parameters())[:1000])
        for position in vehicle.positions:
            require(abs(position.lat_deg) <= 90 and abs(position.lon_deg) <= 180, f"impossible: {position}")
        for mode in vehicle.modes:
            sound(mode.name)


def seeds(flown: Path) -> Iterator[bytes]:
    yield b"\0" + files.dataflash_file(islice(files.flight_messages(), 23))
    yield b"\xff" + files.telemetry_file(islice(files.telemetry_messages(), 30))
