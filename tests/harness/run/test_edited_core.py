"""Test that the checker detects an error in an edited agent and names the handler. If the checker itself uses the
edited file, it names the file instead.

Each test edits a copy of `ucp`, as an engineer edits a clone, and plays a scenario with the copy.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

import harness
import ucp
from benchmarks.core_edits import Edit, read_edits

SCENARIO = {
    "name": "edited core",
    "duration_s": 800,
    "network": {"loss": 0.3, "duplicate": 0.1},
    "timeline": [{"at_s": at_s, "reconcile": [1, 2, 3, 4, 5]} for at_s in (150, 152)],
    "final_reconcile": True,
}


def edits(name: str) -> list[Edit]:
    return read_edits(Path(__file__).with_name(name))


def run_edited(edit: Edit, folder: Path, *command: str) -> subprocess.CompletedProcess[str]:
    """Run a command of the harness with a copy of `ucp` that has this edit."""
    shutil.copytree(Path(ucp.__file__).parent, folder / "ucp", ignore=shutil.ignore_patterns("__pycache__"))
    edit.make(folder)
    paths = os.pathsep.join([str(folder), str(Path(harness.__file__).parent.parent)])
    return subprocess.run(
        [sys.executable, "-m", "harness.cli", *command],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
        check=False,
    )


def verdict_after(edit: Edit, scenario: dict[str, Any], folder: Path, status: int = 1) -> list[str]:
    """Play the scenario with an edited copy of `ucp`. Return the sentences of the verdict on the steps."""
    (folder / "scenario.yaml").write_text(yaml.safe_dump(scenario), "utf-8")
    done = run_edited(edit, folder, "run", "scenario.yaml", "--backend", "sim", "--seed", "1", "--out", "out")
    assert done.returncode == status, done.stdout + done.stderr
    record = json.loads((folder / "out" / "run.json").read_text("utf-8"))
    assert record["versions"]["core"].endswith(f"(ucp/{edit.file})")
    return [record["outcome_detail"] or "", (record["steps"] or {}).get("reason", "")]


@pytest.mark.parametrize("edit", edits("edits_of_the_core.yaml"), ids=lambda edit: f"{edit.handler}: {edit.about}")
def test_edit_of_the_core_is_found_and_its_handler_named(edit: Edit, tmp_path: Path) -> None:
    found = verdict_after(edit, SCENARIO, tmp_path)
    assert any(edit.handler in sentence for sentence in found), found


@pytest.mark.parametrize("edit", edits("edits_of_shared_code.yaml"), ids=lambda edit: f"{edit.file}: {edit.about}")
def test_edit_of_shared_code_is_found_and_its_file_named(edit: Edit, tmp_path: Path) -> None:
    found = verdict_after(edit, {"name": "edited code", "duration_s": 100}, tmp_path)
    assert f"ucp/{edit.file} was edited and contradicts the agent contract" in found[1]


def test_explore_names_the_handler_that_makes_blocks_too_large(tmp_path: Path) -> None:
    """No message can carry such a block. The agents in memory nevertheless send it."""
    edit = Edit("not cleared", "commit.py", "    core.current_block.clear()\n", "", "build_data_block")
    mission = {"name": "edited", "agents": 2, "duration_s": 120, "events": {"source": "random", "mean_s": 3}}
    (tmp_path / "scenario.yaml").write_text(yaml.safe_dump(mission), "utf-8")
    done = run_edited(edit, tmp_path, "explore", "scenario.yaml", "--seeds", "1", "--jobs", "1", "--out", "found.yaml")
    assert done.returncode == 1, done.stdout + done.stderr
    assert "the first in Algorithm 1, build_data_block" in done.stdout


def test_matrix_names_the_file_of_an_edit_of_shared_code(tmp_path: Path) -> None:
    edit = edits("edits_of_shared_code.yaml")[0]
    matrix = {"name": "edited", "scenario": {"duration_s": 100}, "loss": [0.0], "seeds": 2}
    (tmp_path / "matrix.yaml").write_text(yaml.safe_dump(matrix), "utf-8")
    done = run_edited(edit, tmp_path, "matrix", "matrix.yaml", "--backend", "sim", "--out", "out", "--jobs", "1")
    assert done.returncode == 1, done.stdout + done.stderr
    assert f"steps deviate in 2 of 2 runs, seeds 1, 2; first in ucp/{edit.file} (2)" in done.stdout


def test_harmless_edit_of_shared_code_is_mentioned(tmp_path: Path) -> None:
    edit = Edit("a comment", "trace.py", "import base64\n", "import base64  # as RFC 4648\n")
    _, reason = verdict_after(edit, {"name": "edited code", "duration_s": 100}, tmp_path, status=0)
    assert reason.endswith("the judge uses ucp/trace.py too, which was edited and follows the test vectors")
