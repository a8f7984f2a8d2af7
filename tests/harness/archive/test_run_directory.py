"""Test the run directory: it must be new or empty, and traces of restarted agents are appended."""

from pathlib import Path

import pytest

from harness.archive.directory import RunDirectory, claim
from harness.errors import RunDirectoryError


def test_run_directory_refuses_a_directory_with_files(tmp_path: Path) -> None:
    (tmp_path / "kept").touch()
    with pytest.raises(RunDirectoryError, match="is not empty: choose another --out"):
        claim(tmp_path)
    with pytest.raises(RunDirectoryError, match="is not a directory"):
        claim(tmp_path / "kept")
    claim(tmp_path / "new" / "one", tmp_path / "new" / "one" / "inner")
    assert (tmp_path / "new" / "one" / "inner").is_dir()


def test_trace_of_later_incarnation_follows_complete_lines(tmp_path: Path) -> None:
    rundir = RunDirectory(tmp_path / "run")
    first, second = rundir.agent(7), rundir.agent(7, incarnation=2)
    assert (first.name, second.name) == ("agents", "7-2")
    (first / "7.trace.jsonl").write_text("one\ntw")
    (second / "7.trace.jsonl").write_text("three\n")
    rundir.append_trace(7, second)
    assert (first / "7.trace.jsonl").read_text() == "one\nthree\n"
    assert (second / "7.trace.jsonl").read_text() == "three\n"
    rundir.append_trace(7, rundir.agent(7, incarnation=3))  # This incarnation was killed before it wrote a trace.
    assert (first / "7.trace.jsonl").read_text() == "one\nthree\n"


def test_trace_of_running_incarnation_is_appended_in_parts(tmp_path: Path) -> None:
    rundir = RunDirectory(tmp_path / "run")
    first, second = rundir.agent(7), rundir.agent(7, incarnation=2)
    (first / "7.trace.jsonl").write_text("one\n")
    (second / "7.trace.jsonl").write_text("two\nthr")
    copied_bytes = rundir.append_trace(7, second)
    (second / "7.trace.jsonl").write_text("two\nthree\n")
    copied_bytes += rundir.append_trace(7, second, copied_bytes)
    assert (first / "7.trace.jsonl").read_text() == "one\ntwo\nthree\n"
    assert rundir.append_trace(7, second, copied_bytes) == 0
