"""Test `ucp-harness runs`, which lists past runs and opens a report."""

import json
import os
from pathlib import Path

import pytest

from tests.harness.command import harness, sentences
from tests.harness.mission import CONNECTED, fly, write_run


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """Write two runs. The newer one is damaged."""
    folder = tmp_path / "runs"
    folder.mkdir()
    air = fly(agents=3, duration_s=400)
    for name, at_s in (("older", 1), ("newer", 2)):
        write_run(air, folder / name, CONNECTED)
        os.utime(folder / name / "run.json", (at_s, at_s))
    return folder


def test_newest_run_is_listed_first(runs: Path) -> None:
    listed = harness("runs", cwd=runs.parent)
    assert listed.returncode == 0
    newer, older = (next(line for line in listed.stdout.splitlines() if name in line) for name in ("newer", "older"))
    assert newer.split()[0] == "1"
    assert older.split()[0] == "2"
    (only,) = json.loads(harness("runs", runs, "--last", "1", "--json").stdout)
    assert only["directory"] == str(runs / "newer")


def test_damaged_record_is_reported_and_the_others_are_listed(runs: Path) -> None:
    (runs / "older" / "run.json").write_text("{")
    listed = harness("runs", runs)
    assert "newer" in listed.stdout
    assert sentences(listed.stderr) == [f"{runs / 'older' / 'run.json'}: truncated or damaged: not JSON at line 1"]


def test_runs_opens_a_report_or_names_the_command_that_writes_it(runs: Path, tmp_path: Path) -> None:
    missing = harness("runs", runs, "--open", "2")
    assert missing.returncode == 2
    assert sentences(missing.stderr) == [
        f"{runs / 'older' / 'report.html'} does not exist: `ucp-harness report {runs / 'older'}` writes it"
    ]
    (runs / "older" / "report.html").write_text("<html>")
    browser = tmp_path / "browser"
    browser.write_text(f'#!/bin/sh\necho "$1" > {tmp_path / "opened"}\n')
    browser.chmod(0o755)
    assert harness("runs", runs, "--open", "2", env={**os.environ, "BROWSER": str(browser)}).returncode == 0
    assert (tmp_path / "opened").read_text() == f"{(runs / 'older' / 'report.html').as_uri()}\n"
    assert "has 2 runs, and no run 3" in harness("runs", runs, "--open", "3").stderr


def test_missing_folder_of_runs_causes_one_sentence(tmp_path: Path) -> None:
    refused = harness("runs", tmp_path / "none")
    assert refused.returncode == 2
    assert "`ucp-harness run` creates it" in refused.stderr
