"""Fuzz target: flight logs of vehicles. The first byte of the input selects the suffix of the file name. The suffix
matters if the beginning of the log is damaged.
"""

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory

from harness.errors import HarnessError
from harness.field.depot.record_outputs import flown_tracks
from harness.field.flight_logs import read_flight_log
from harness.field.flight_logs._matching import changes, in_words, match_logs
from harness.report.logbook.positions import RoundedPosition
from tests.fuzz.finding import require, sound
from tests.harness.field import flight_log_files as files

FIXES = [
    (
        files.BOOT_UTC_US + (5 + second) * 1_000_000,
        RoundedPosition(round((files.LAT_DEG + second * 10 / 111_320) * 1e7), round(files.LON_DEG * 1e7), 130_000),
    )
    for second in range(0, 20, 4)
]


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
    for match in match_logs([log], {7: FIXES}):
        sound(in_words(match))
        for change in changes(match):
            sound(change.words)
        flown_tracks([match])
    for vehicle in log.vehicles:
        sound(repr(vehicle.latest_parameters())[:1000])
        for position in vehicle.positions:
            require(abs(position.lat_deg) <= 90 and abs(position.lon_deg) <= 180, f"impossible: {position}")
        for mode in vehicle.modes:
            sound(mode.name)


def seeds(flown: Path) -> Iterator[bytes]:
    yield b"\0" + files.dataflash_file(islice(files.flight_messages(), 23))
    yield b"\xff" + files.telemetry_file(islice(files.telemetry_messages(), 30))
