"""Test `--nights`: each finished night is stored once, and other files in the directory are skipped and reported."""

import json
from pathlib import Path

import pytest

from harness.errors import RunDirectoryError
from harness.sweep.matrix import MatrixRecord, nights
from tests.harness.command import harness, sentences
from tests.harness.sweep.matrix.stub import judge, matrix, played


def night(started_at: str, **keys: object) -> MatrixRecord:
    record = played(matrix(), 1, judge).record
    return record.model_copy(update={"started_at": started_at, **keys})


def test_nights_are_kept_once_and_read_in_their_order(tmp_path: Path) -> None:
    directory = nights.opened(tmp_path / "all" / "nights")
    for day in (3, 1, 2, 3):
        nights.keep(night(f"2026-01-0{day}T02:17:00Z"), directory)
    assert sorted(path.name for path in directory.iterdir()) == [f"2026010{day}T021700Z.json" for day in (1, 2, 3)]
    found = nights.read(directory, matrix())
    assert [record.started_at[8:10] for record in found.records] == ["01", "02", "03"]
    assert (found.left_out, found.said_left_out) == ([], "")


def test_unfinished_night_is_not_stored_and_names_stay_in_the_directory(tmp_path: Path) -> None:
    directory = nights.opened(tmp_path / "nights")
    nights.keep(night("2026-01-01T00:00:00Z", outcome="interrupted"), directory)
    assert not list(directory.iterdir())
    nights.keep(night("../../T1"), directory)
    assert [path.name for path in directory.iterdir()] == ["T1.json"]


def test_files_that_are_no_night_of_this_matrix_are_named(tmp_path: Path) -> None:
    nights.keep(night("2026-01-01T00:00:00Z"), tmp_path)
    nights.keep(played(matrix(loss=(0.3,)), 1, judge).record, tmp_path)
    (tmp_path / "a.json").write_text("half a ni")
    (tmp_path / "b.json").write_text('{"schema": "ucp-matrix/2"}')
    (tmp_path / "c.json").mkdir()
    record = night("2026-01-02T00:00:00Z").to_json()
    record["cells"][0]["estimates"]["uniform"]["mean"] = float("nan")
    (tmp_path / "d.json").write_text(json.dumps(record))
    found = nights.read(tmp_path, matrix())
    assert [one.started_at for one in found.records] == ["2026-01-01T00:00:00Z"]
    said = " | ".join(found.left_out)
    assert "contains results of another matrix: `loss` differs" in said
    assert f"{tmp_path / 'a.json'}: not JSON at line 1" in said
    assert f"{tmp_path / 'b.json'} has schema ucp-matrix/2, and this version" in said
    assert f"{tmp_path / 'c.json'}: cannot be read: is a directory" in said
    assert "cannot read its `cells.0.estimates.uniform.mean`" in said
    assert found.said_left_out == f"5 files in {tmp_path} are not in the trend"


def test_only_the_last_nights_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nights, "LAST", 2)
    for day in range(1, 5):
        nights.keep(night(f"2026-01-0{day}T00:00:00Z"), tmp_path)
    assert [one.started_at[8:10] for one in nights.read(tmp_path, matrix()).records] == ["03", "04"]


def test_path_of_a_file_is_refused_as_directory(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(RunDirectoryError, match=r"cannot be created: .*; choose another --nights"):
        nights.opened(tmp_path / "file")


def test_command_stores_each_night_and_reports_unused_files(tmp_path: Path) -> None:
    asked, kept = tmp_path / "matrix.yaml", tmp_path / "nights"
    scenario = {"agents": 3, "duration_s": 100, "events": {"source": "random"}}
    asked.write_text(json.dumps({"name": "small", "scenario": scenario, "loss": [0.0], "seeds": 2}))
    first = harness("matrix", asked, "--nights", kept, "--out", tmp_path / "first")
    assert (first.returncode, sentences(first.stderr)) == (0, [])
    assert "nights has one night of this matrix" in (tmp_path / "first" / "report.html").read_text()
    (one,) = kept.iterdir()
    record = json.loads((tmp_path / "first" / "matrix.json").read_text())
    assert json.loads(one.read_text()) == record | {"results": []}
    (kept / "0.json").write_text("{}")
    again = harness("matrix", asked, "--nights", kept, "--out", tmp_path / "first")
    assert again.returncode == 0
    (said,) = sentences(again.stderr)
    assert said.startswith(f"1 file in {kept} is not in the trend; {kept / '0.json'} names no schema")
    assert len(list(kept.iterdir())) == 2
