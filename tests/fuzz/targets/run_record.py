"""Fuzz target: run.json, which may be complete, truncated, or another document. The writer reproduces its valid
part.
"""

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from harness.archive.exports import RUN_FILE
from harness.archive.record_file import read_record
from tests.fuzz.finding import require, sound
from tests.fuzz.targets.home import came_home, in_its_run


def run(data: bytes) -> None:
    with TemporaryDirectory() as directory:
        path = Path(directory) / RUN_FILE
        path.write_bytes(data)
        read = read_record(path)
        for problem in read.problems:
            sound(problem)
        if read.error is None:
            path.write_text(read.record.model_dump_json(by_alias=True))
            again = read_record(path)
            require(again.error is None and again.record == read.record, "a record is written otherwise")
    came_home(RUN_FILE, data)
    in_its_run(RUN_FILE, data)


def seeds(flown: Path) -> Iterator[bytes]:
    yield (flown / RUN_FILE).read_bytes()
