"""Test run.json: valid parts are used, invalid parts are reported, and the checker judges only a file that contains all
keys.
"""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from harness import checker
from harness.archive.archive import RunArchive
from harness.archive.record_file import DamagedRecordError, RecordFile, read_record, validate_leniently
from harness.archive.run_record import RunRecord
from harness.play.progress import SilentProgress
from harness.run.run import run
from tests.harness.mission import edit
from tests.harness.virtual import scenario
from ucp.plain_file import MAX_JSON_WEIGHT


@pytest.fixture(scope="module")
def intact_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Play a run in virtual time in which a vehicle is lost."""
    asked = scenario(agents=3, duration_s=300, timeline=[{"at_s": 100, "kill": [3]}])
    return run(asked, 3, tmp_path_factory.mktemp("whole") / "run", SilentProgress(), backend="sim").directory


def edited(intact_run: Path, tmp_path: Path, change: Any) -> RecordFile:
    shutil.copy(intact_run / "run.json", tmp_path)
    edit(tmp_path / "run.json", change)
    return read_record(tmp_path / "run.json")


def test_reader_restores_the_written_record(intact_run: Path) -> None:
    file = read_record(intact_run / "run.json")
    assert file.problems == []
    assert file.judged is file.record
    assert file.record.to_json() == json.loads((intact_run / "run.json").read_text())


def test_unknown_keys_are_ignored_and_new_keys_may_be_missing(intact_run: Path, tmp_path: Path) -> None:
    def change(record: dict[str, Any]) -> None:
        record["weather"] = record["agents"]["1"]["mood"] = record["scenario"]["moon"] = "full"
        for key in ("cycle", "counters", "survival", "rogue", "steps", "versions"):
            del record[key]
        del record["scenario"]["schedule"], record["agents"]["1"]["handler_runs"]

    file = edited(intact_run, tmp_path, change)
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
def test_smallest_invalid_part_is_removed_and_reported(
    intact_run: Path, tmp_path: Path, change: Any, where: str, judged: bool
) -> None:
    before, file = read_record(intact_run / "run.json").record, edited(intact_run, tmp_path, change)
    (problem,) = file.problems
    assert problem.startswith(f"{tmp_path / 'run.json'}: `{where}` is wrong: ")
    assert problem.endswith("; it was edited or damaged")
    assert (file.judged is not None) == judged
    assert file.record.roster == before.roster
    assert file.record.characteristics == before.characteristics
    assert file.record.agents.keys() == before.agents.keys()
    assert file.record.scenario is not None


def test_entry_without_a_required_key_is_removed(intact_run: Path, tmp_path: Path) -> None:
    file = edited(intact_run, tmp_path, lambda record: record["agents"]["1"].pop("outcome"))
    assert [*file.record.agents] == ["2", "3"]
    assert "`agents.1.outcome` is wrong: field required; " in file.problems[0]


def test_many_errors_give_one_sentence_per_key(intact_run: Path, tmp_path: Path) -> None:
    file = edited(intact_run, tmp_path, lambda record: record.update(faults=[7] * 50, errors=[{}] * 3))
    assert [problem.split(": ", 1)[1].split(" is wrong")[0] for problem in file.problems] == [
        "`faults.0`",
        "`errors.0`",
    ]
    assert "(and 49 more)" in file.problems[0]


def test_record_with_too_many_errors_is_rejected(intact_run: Path, tmp_path: Path) -> None:
    path = tmp_path / "run.json"
    file = edited(intact_run, tmp_path, lambda record: record.update(faults=[7] * 30_000))
    assert file.problems == [f"{path}: 30000 errors in it; it was edited or damaged"]
    path.write_text(f'{{"faults": [{"7," * MAX_JSON_WEIGHT}7, 7]}}')
    file = read_record(path)
    assert file.problems == [f"{path}: truncated or damaged: too many values"]
    assert isinstance(file.error, DamagedRecordError)
    assert file.judged is None


def test_record_without_agents_is_reported_and_not_judged(intact_run: Path, tmp_path: Path) -> None:
    file = edited(intact_run, tmp_path, lambda record: record.pop("roster"))
    assert file.judged is None
    assert "`roster` is missing" in file.problems[0]
    assert file.record.known_agents == [1, 2, 3]


def test_checker_ignores_a_record_with_damaged_keys(intact_run: Path, tmp_path: Path) -> None:
    directory = tmp_path / "run"
    shutil.copytree(intact_run, directory)
    edit(directory / "run.json", lambda record: record["network"].append({"at_s": "soon"}))
    evidence = checker.gather(RunArchive(directory))
    assert evidence.record is None
    assert evidence.errors[0].endswith("; it was edited or damaged; the exports are checked without it")


def test_record_of_invalid_values_is_empty() -> None:
    record, invalid_parts = validate_leniently(
        RunRecord, {key: [[7]] for key in RunRecord.model_fields if key != "schema_"}
    )
    assert record == RunRecord(roster=[])
    assert {part.key for part in invalid_parts} == {key for key in RunRecord.model_fields if key != "schema_"}
