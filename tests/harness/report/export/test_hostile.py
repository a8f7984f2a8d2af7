"""Test that hostile run directories and full disks cause an error of one sentence and leave no partial file."""

import json
import os
import shutil
from pathlib import Path
from typing import Any

import pytest

from tests.harness.command import harness, sentences
from tests.harness.mission import edit


@pytest.fixture
def copy(run: Path, tmp_path: Path) -> Path:
    return shutil.copytree(run, tmp_path / "copy")


def test_unreadable_files_are_named_and_the_rest_is_exported(copy: Path, tmp_path: Path) -> None:
    (copy / "vehicles" / "1" / "telemetry.tlog").unlink()
    os.mkfifo(copy / "vehicles" / "1" / "telemetry.tlog")
    os.mkfifo(copy / "agents" / "7.log")
    lines = (copy / "network.jsonl").read_text().splitlines()
    lines.append(json.dumps({"at_s": 150, "what": "range", "losses": {"1-2": 7}}).replace("7", "NaN"))
    (copy / "network.jsonl").write_text("\n".join(lines))
    made = ("--mcap", tmp_path / "m", "--perfetto", tmp_path / "p", "--rosbag", tmp_path / "b")
    exported = harness("export", copy, *made)
    assert exported.returncode == 0
    assert sentences(exported.stderr) == [
        "vehicles/1/telemetry.tlog: cannot be read: it is not a file",
        "agents/7.log: cannot be read: is not a file",
    ]


def test_interrupted_run_is_exported_up_to_its_end(copy: Path, tmp_path: Path) -> None:
    def killed(record: dict[str, Any]) -> None:
        for key in ("characteristics", "mission_s", "steps", "records", "liveness"):
            del record[key]
        record["outcome"] = "running"

    edit(copy / "run.json", killed)
    trace = copy / "agents" / "1.trace.jsonl"
    trace.write_bytes(trace.read_bytes()[:-1000])
    (copy / "agents" / "1.chain.json").unlink()
    exported = harness("export", copy, "--perfetto", tmp_path / "p")
    assert exported.returncode == 0
    assert sentences(exported.stderr) == [
        "agents/1.trace.jsonl: truncated in the middle of a line; the part before is read",
        "the end of the run is not recorded: the run is still active, or it was killed",
    ]


def test_excessive_roster_is_refused(copy: Path, tmp_path: Path) -> None:
    edit(copy / "run.json", lambda record: record.update(roster=list(range(1, 5000))))
    refused = harness("export", copy, "--mcap", tmp_path / "m")
    assert refused.returncode == 2
    assert "4999 agents are named in it, but a run has at most 1000" in sentences(refused.stderr)[-1]
    assert not (tmp_path / "m").exists()


@pytest.mark.parametrize("name", ["mcap", "perfetto", "rosbag"])
def test_failed_export_leaves_no_file(name: str, run: Path, tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("mine")
    refused = harness("export", run, f"--{name}", file / "below")
    (sentence,) = sentences(refused.stderr)
    assert (refused.returncode, file.read_text()) == (2, "mine"), sentence
