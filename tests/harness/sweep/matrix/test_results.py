"""Test results.jsonl: each run is played only once, even if the matrix is interrupted several times."""

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from harness.checker import Result
from harness.errors import MachineError, RunDirectoryError
from harness.scenario import Scenario
from harness.sweep.matrix import MatrixRecord
from harness.sweep.matrix._results_file import FILE, opened
from tests.harness.sweep.matrix.stub import judge, matrix, played

Count = list[tuple[object, int]]


def counting(seen: Count, until: int | None = None) -> Callable[[Scenario, int], Result]:
    """Return a function that judges and records runs. It is interrupted after a number of runs."""

    def counted(scenario: Scenario, seed: int) -> Result:
        if len(seen) == until:
            raise KeyboardInterrupt
        seen.append((scenario.network.loss, seed))
        return judge(scenario, seed)

    return counted


def same(one: MatrixRecord, other: MatrixRecord) -> bool:
    machine = {"started_at", "wall_s"}
    return one.model_dump(exclude=machine) == other.model_dump(exclude=machine)


def test_interrupted_matrix_continues_where_it_stopped(tmp_path: Path) -> None:
    seen: Count = []
    broken_off = played(matrix(), 1, counting(seen, until=3), tmp_path).record
    assert (broken_off.outcome, broken_off.runs) == ("interrupted", 3)
    whole = played(matrix(), 1, counting(seen), tmp_path)
    assert len(seen) == len(set(seen)) == 8, "each run is played once"
    uninterrupted = played(matrix(), 1, judge)
    assert whole.runs == uninterrupted.runs
    assert same(whole.record, uninterrupted.record)
    assert whole.record.started_at == broken_off.started_at


def test_finished_matrix_is_not_played_again(tmp_path: Path) -> None:
    first, seen = played(matrix(), 2, judge, tmp_path), []
    again = played(matrix(), 2, counting(seen, until=0), tmp_path)
    assert again.runs == first.runs
    assert again.record.outcome == "completed"


def test_crashed_run_is_a_result(tmp_path: Path) -> None:
    def crashes(scenario: Scenario, seed: int) -> Result:
        if seed == 2:
            raise RuntimeError("no more")
        return judge(scenario, seed)

    first = played(matrix(), 2, crashes, tmp_path).record
    again = played(matrix(), 2, counting([], until=0), tmp_path).record
    assert [run.seed for run in again.failed] == [2, 2]
    assert again.failed == first.failed
    assert again.cells == first.cells


@pytest.mark.parametrize("done", [0, 3])
def test_directory_of_an_unplayable_matrix_remains_only_with_results(tmp_path: Path, done: int) -> None:
    def lacks(scenario: Scenario, seed: int) -> Result:
        if seed > done:
            raise MachineError("this machine lacks a program")
        return judge(scenario, seed)

    with pytest.raises(MachineError):
        played(matrix(), 1, lacks, tmp_path / "out")
    assert (tmp_path / "out").exists() == (done > 0)


@pytest.mark.parametrize("padding", [0, 5000])
def test_run_of_an_incomplete_last_line_is_played_again(tmp_path: Path, padding: int) -> None:
    whole = played(matrix(), 1, judge, tmp_path)
    path = tmp_path / FILE
    complete = path.read_bytes()
    path.write_bytes(complete[:-20] + b" " * padding)
    seen: Count = []
    assert played(matrix(), 1, counting(seen), tmp_path).runs == whole.runs
    assert seen == [(0.5, 4)]
    assert path.read_bytes() == complete


def test_each_line_is_there_as_soon_as_its_run_has_ended(tmp_path: Path) -> None:
    lines = []

    def looks(scenario: Scenario, seed: int) -> Result:
        lines.append((tmp_path / FILE).read_text().count("\n"))
        return judge(scenario, seed)

    played(matrix(), 1, looks, tmp_path)
    assert lines == list(range(1, 9))


def test_duplicate_run_counts_once(tmp_path: Path) -> None:
    whole = played(matrix(), 1, judge, tmp_path)
    path = tmp_path / FILE
    path.write_text(path.read_text() + path.read_text().splitlines()[-1] + "\n")
    assert played(matrix(), 1, judge, tmp_path).runs == whole.runs


def test_another_matrix_is_refused_and_nothing_changed(tmp_path: Path) -> None:
    played(matrix(), 1, judge, tmp_path)
    before = (tmp_path / FILE).read_bytes()
    with pytest.raises(RunDirectoryError, match="holds the results of another matrix file: choose another --out"):
        played(matrix(seeds=5), 1, judge, tmp_path)
    assert (tmp_path / FILE).read_bytes() == before


@pytest.mark.parametrize("content", ["", "half a word", "[]\n", '{"schema": "else/1"}\n'])
def test_file_of_another_program_is_not_changed(tmp_path: Path, content: str) -> None:
    (tmp_path / FILE).write_text(content)
    with pytest.raises(RunDirectoryError, match="is not empty: choose another --out"):
        played(matrix(), 1, judge, tmp_path)
    assert (tmp_path / FILE).read_text() == content


@pytest.mark.parametrize("change", [{"seed": 99}, {"loss": 0.25}, {"figures": []}])
def test_line_without_a_run_of_the_matrix_is_named(tmp_path: Path, change: dict[str, object]) -> None:
    played(matrix(), 1, judge, tmp_path)
    path = tmp_path / FILE
    lines = path.read_text().splitlines()
    lines[3] = json.dumps({**json.loads(lines[3]), **change})
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(
        RunDirectoryError, match=re.escape(f"{path} line 4 is not a run of this matrix: remove the line")
    ):
        played(matrix(), 1, judge, tmp_path)


def test_second_command_on_the_same_matrix_is_refused(tmp_path: Path) -> None:
    with opened(tmp_path, matrix()), pytest.raises(RunDirectoryError, match="another command works on the matrix in"):
        played(matrix(), 1, judge, tmp_path)


def test_unwritable_directory_causes_one_sentence(tmp_path: Path) -> None:
    (tmp_path / FILE).mkdir()
    with pytest.raises(RunDirectoryError, match=r"results\.jsonl cannot be written: Is a directory; choose another"):
        played(matrix(), 1, judge, tmp_path)


def test_full_disk_causes_one_sentence_with_a_solution(tmp_path: Path) -> None:
    (run,) = played(matrix(loss=(0.0,), seeds=1), 1, judge).runs
    with opened(tmp_path, matrix()) as results:
        results._file.close()
        with Path("/dev/full").open("r+b", buffering=0) as full:
            results._file = full
            with pytest.raises(
                MachineError, match=r"No space left on device; it has all finished runs: free some space"
            ):
                results.add(run)
    assert not results.runs
