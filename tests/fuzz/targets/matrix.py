"""Fuzz target: a matrix file in YAML. An input in JSON is a file of earlier results, with which a command continues."""

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from harness.errors import HarnessError
from harness.scenario.load import LIBRARY
from harness.sweep.matrix._comparison import compare
from harness.sweep.matrix._matrix_file import Matrix, load_matrix
from harness.sweep.matrix._results_file import FILE, opened
from harness.sweep.matrix.nights import load_baseline
from tests.fuzz.finding import require, sound
from tests.harness.sweep.matrix.stub import judge, matrix, played

MOST_TASKS = 10_000


def run(data: bytes) -> None:
    with TemporaryDirectory() as directory:
        for read in (_night, _results) if data.startswith(b"{") else (_matrix,):
            try:
                read(Path(directory), data)
            except HarnessError as error:
                sound(str(error))


def _matrix(directory: Path, data: bytes) -> None:
    path = directory / "fuzz.yaml"
    path.write_bytes(data)
    asked = load_matrix(path)
    again = Matrix.model_validate(asked.model_dump(mode="json"))
    require(again.model_dump(mode="json") == asked.model_dump(mode="json"), "a matrix on record is read otherwise")
    if len(asked.points) * len(asked.seed_list) < MOST_TASKS:
        require(len(asked.tasks) == len({*asked.tasks}), "a run is asked for twice")


def _night(directory: Path, data: bytes) -> None:
    path = directory / "matrix.json"
    path.write_bytes(data)
    night = load_baseline(path, matrix()).record
    if night is None:
        return
    night.to_json()
    list(compare(night.cells, night.cells))


def _results(directory: Path, data: bytes) -> None:
    path = directory / FILE
    path.write_bytes(data)
    with opened(directory, matrix()) as results:
        count = len(results.runs)
    with opened(directory, matrix()) as results:
        require(len(results.runs) == count, "results are read otherwise")


def seeds(flown: Path) -> Iterator[bytes]:
    for path in sorted(LIBRARY.glob("*_matrix.yaml")):
        yield path.read_bytes()
    yield b"name: Short\nloss: [0, 0.5]\nagents: [2, 3]\nseeds: [1, 2]\nscenario: {duration_s: 60}\n"
    with TemporaryDirectory() as directory:
        played(matrix(), 1, judge, Path(directory))
        yield (Path(directory) / FILE).read_bytes()
    yield played(matrix(), 1, judge).record.model_dump_json(by_alias=True).encode()
