"""Fuzz target: records of other programs in a CSV file."""

from collections.abc import Iterator
from itertools import islice
from pathlib import Path

from tests.fuzz.targets.home import came_home
from tests.harness.field.recordings import of_run, write_csv

RECORDS = 20


def run(data: bytes) -> None:
    came_home("all.csv", data)


def seeds(flown: Path) -> Iterator[bytes]:
    for kinds in (("trace", "export"), ("sent",)):
        path = write_csv(flown / "all.csv", islice(of_run(flown, kinds), RECORDS))
        yield path.read_bytes()
        path.unlink()
