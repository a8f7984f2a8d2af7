"""Test that the checker detects an error in an edited agent and names the handler.

Each test edits a copy of `ucp`, as an engineer edits a clone, and plays a scenario with the copy.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest
import yaml

import harness
import ucp

SCENARIO = {
    "name": "edited core",
    "duration_s": 800,
    "network": {"loss": 0.3, "duplicate": 0.1},
    "final_reconcile": True,
}


class Edit(NamedTuple):
    """An edit of a file of `ucp`, and the handler that it breaks."""

    about: str
    handler: str
    file: str
    old: str
    new: str


EDITS = [Edit(**edit) for edit in yaml.safe_load(Path(__file__).with_name("edits_of_the_core.yaml").read_text("utf-8"))]


@pytest.mark.parametrize("edit", EDITS, ids=lambda edit: f"{edit.handler}: {edit.about}")
def test_edit_of_the_core_is_found_and_its_handler_named(edit: Edit, tmp_path: Path) -> None:
    shutil.copytree(Path(ucp.__file__).parent, tmp_path / "ucp", ignore=shutil.ignore_patterns("__pycache__"))
    file = tmp_path / "ucp" / edit.file
    text = file.read_text("utf-8")
    assert edit.old in text, f"ucp/{edit.file} has changed: write this edit anew"
    file.write_text(text.replace(edit.old, edit.new, 1), "utf-8")
    (tmp_path / "scenario.yaml").write_text(yaml.safe_dump(SCENARIO), "utf-8")
    paths = os.pathsep.join([str(tmp_path), str(Path(harness.__file__).parent.parent)])

    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "harness.cli",
            "run",
            "scenario.yaml",
            "--backend",
            "sim",
            "--seed",
            "1",
            "--out",
            "out",
        ],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
        check=False,
    )

    assert done.returncode == 1, done.stdout + done.stderr
    record = json.loads((tmp_path / "out" / "run.json").read_text("utf-8"))
    assert record["versions"]["core"].endswith(f"(ucp/{edit.file})")
    found = [record["outcome_detail"] or "", (record["steps"] or {}).get("reason", "")]
    assert any(edit.handler in sentence for sentence in found), found
