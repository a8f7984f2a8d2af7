"""Fuzz target: ROS bags of both versions. The first bytes of the input determine the file name."""

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.fuzz.targets.home import came_home
from tests.harness.field.recordings import of_run, write_bag1, write_bag2

RECORDS = 12


def run(data: bytes) -> None:
    came_home("1.db3" if data.startswith(b"SQLite") else "1.mcap" if data.startswith(b"\x89MCAP") else "1.bag", data)


def seeds(flown: Path) -> Iterator[bytes]:
    with TemporaryDirectory() as directory:
        place = Path(directory)
        for compression in (None, "BZ2", "LZ4"):
            bag = write_bag1(place / f"{compression}.bag", islice(of_run(flown, ("sent",)), RECORDS), compression)
            yield bag.read_bytes()
        for storage in ("sqlite3", "mcap"):
            bag = write_bag2(place / storage, islice(of_run(flown, ("sent",)), RECORDS), storage)
            for path in bag.iterdir():
                if path.name != "metadata.yaml":
                    yield path.read_bytes()
