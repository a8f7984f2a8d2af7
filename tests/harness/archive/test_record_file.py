"""run.json read back: what is sound is used, what is not is told, and nothing is judged by half of what it needs."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from harness import checker
from harness.archive.archive import RunArchive
from harness.archive.record_file import MAX_VALUES, DamagedRecordError, RecordFile, read_record, validate_leniently
from harness.archive.run_record import RunRecord
from harness.play.progress import Silent
from harness.run.run import run
from tests.harness.mission import edit
from tests.harness.virtual import scenario


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run in virtual time in which a vehicle was lost."""
    asked = scenario(agents=3, duration_s=300, timeline=[{"at_s": 100, "kill": [3]}])
    return run(asked, 3, tmp_path_factory.mktemp("whole") / "run", Silent(), backend="sim").directory


def edited(whole: Path, tmp_path: Path, change: Any) -> RecordFile:
    shutil.copy(whole / "run.json", tmp_path)
    edit(tmp_path / "run.json", change)
    return read_record(tmp_path / "run.json")


def test_a_whole_record_is_read_as_it_was_written(whole: Path) -> None:
    file = read_record(whole / "run.json")
    assert file.problems == []
    assert file.judged is file.record
    assert file.record.to_json() == json.loads((whole / "run.json").read_text())


def test_keys_of_another_version_are_passed_over_and_may_be_missing(whole: Path, tmp_path: Path) -> None:
    def change(record: dict[str, Any]) -> None:
        record["weather"] = record["agents"]["1"]["mood"] = record["scenario"]["moon"] = "full"
        for key in ("cycle", "counters", "survival", "rogue", "steps", "versions"):
            del record[key]
        del record["scenario"]["schedule"], record["agents"]["1"]["handler_runs"]

    file = edited(whole, tmp_path, change)
    assert file.problems == []
    assert file.judged is not None
    assert file.record.scenario is not None
    assert file.record.scenario.duration_s == 300


@pytest.mark.parametrize(
    ("change", "where", "judged"),
    [
        (lambda record: record["figures"].update(blocks="many"), "figures.blocks", True),
        (lambda record: record["scenario"].update(duration_s=-1), "scenario.duration_s", True),
        (lambda record: record.update(seed="x"), "seed", True),
        (lambda record: record["faults"].append(7), "faults.1", False),
        (lambda record: record["faults"][0].update(at_s=float("nan")), "faults.0.at_s", False),
        (lambda record: record["agents"].update(x={"outcome": "exported"}), "agents.x", False),
        (lambda record: record["agents"]["1"].update(reconciles=[]), "agents.1.reconciles", False),
        (lambda record: record.update(mission_s=10**400), "mission_s", False),
    ],
)
def test_of_what_is_wrong_the_smallest_part_is_left_out_and_told(
    whole: Path, tmp_path: Path, change: Any, where: str, judged: bool
) -> None:
    before, file = read_record(whole / "run.json").record, edited(whole, tmp_path, change)
    (problem,) = file.problems
    assert problem.startswith(f"{tmp_path / 'run.json'}: `{where}` is wrong: ")
    assert problem.endswith("; it was edited or damaged")
    assert (file.judged is not None) == judged
    assert file.record.roster == before.roster
    assert file.record.characteristics == before.characteristics
    assert file.record.agents.keys() == before.agents.keys()
    assert file.record.scenario is not None


def test_an_entry_that_lacks_a_key_is_left_out(whole: Path, tmp_path: Path) -> None:
    file = edited(whole, tmp_path, lambda record: record["agents"]["1"].pop("outcome"))
    assert [*file.record.agents] == ["2", "3"]
    assert "`agents.1.outcome` is wrong: field required; " in file.problems[0]


def test_what_is_wrong_in_many_places_is_one_sentence_for_each_key(whole: Path, tmp_path: Path) -> None:
    file = edited(whole, tmp_path, lambda record: record.update(faults=[7] * 50, errors=[{}] * 3))
    assert [problem.split(": ", 1)[1].split(" is wrong")[0] for problem in file.problems] == [
        "`faults.0`",
        "`errors.0`",
    ]
    assert "(and 49 more)" in file.problems[0]


def test_what_is_mostly_wrong_is_refused_in_one_sentence(whole: Path, tmp_path: Path) -> None:
    path = tmp_path / "run.json"
    file = edited(whole, tmp_path, lambda record: record.update(faults=[7] * 30_000))
    assert file.problems == [f"{path}: 30000 errors in it; it was edited or damaged"]
    path.write_text(f'{{"faults": [{"7," * MAX_VALUES}7, 7]}}')
    file = read_record(path)
    assert file.problems == [f"{path}: more than 2000000 values, which is too many for the record of a run"]
    assert isinstance(file.error, DamagedRecordError)
    assert file.judged is None


def test_a_record_that_names_no_agents_says_so_and_is_not_judged_by(whole: Path, tmp_path: Path) -> None:
    file = edited(whole, tmp_path, lambda record: record.pop("roster"))
    assert file.judged is None
    assert "`roster` is missing" in file.problems[0]
    assert file.record.known_agents == [1, 2, 3]


def test_exports_are_checked_without_a_record_that_is_damaged_where_it_counts(whole: Path, tmp_path: Path) -> None:
    directory = tmp_path / "run"
    shutil.copytree(whole, directory)
    edit(directory / "run.json", lambda record: record["network"].append({"at_s": "soon"}))
    evidence = checker.gather(RunArchive(directory))
    assert evidence.record is None
    assert evidence.errors[0].endswith("; it was edited or damaged; the exports are checked without it")


def test_what_fits_nowhere_leaves_an_empty_record() -> None:
    record, invalid_parts = validate_leniently(
        RunRecord, {key: [[7]] for key in RunRecord.model_fields if key != "schema_"}
    )
    assert record == RunRecord(roster=[])
    assert {part.key for part in invalid_parts} == {key for key in RunRecord.model_fields if key != "schema_"}
