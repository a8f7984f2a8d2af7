"""Test `prove --against`: only violations that the original agent does not have count."""

import json
import subprocess
from pathlib import Path

import pytest

from tests.harness.command import harness, sentences
from tests.harness.proof.edited_core import ROOT, Bug, edited, with_core

HARMLESS = Bug("commit.py", "core.voters.clear()", "core.voters = set()")
PROPOSES_NOTHING = Bug(
    "reconcile.py",
    'core.reconcile_in_progress = False\n    core.trigger("Process Next Deque Block")',
    "core.reconcile_in_progress = False",
)
IN_STEP = ("--agents", 2, "--blocks", 3, "--losses", 1)
"""Bounds within which the published protocol itself has a livelock."""


def test_livelock_of_the_original_is_no_new_finding(tmp_path: Path) -> None:
    core = edited(tmp_path, HARMLESS)
    done = with_core(core, "prove", *IN_STEP, "--against", ROOT, "--out", "found.yaml", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "✘ violated, livelock" in done.stdout
    assert "- the original has it as well: a cycle without losses" in done.stdout
    assert "✔ no finding is new" in done.stdout


def test_violation_that_the_original_lacks_is_a_new_finding(tmp_path: Path) -> None:
    core = edited(tmp_path, PROPOSES_NOTHING)
    done = with_core(core, "prove", *IN_STEP, "--against", ROOT, "--json", cwd=tmp_path)
    assert done.returncode == 1, done.stderr
    document = json.loads(done.stdout)
    assert [*document["new_findings"]] == ["2"]
    assert document["shared_findings"] == {}
    assert [key.split()[0] for key in document["original"]["findings"]] == ["livelock"]


def test_original_with_the_same_bug_leaves_nothing_new_but_undecided(tmp_path: Path) -> None:
    """The search stops at the violation that both agents have. A later state may contain a new violation."""
    (tmp_path / "original").mkdir()
    original = edited(tmp_path / "original", PROPOSES_NOTHING)
    core = edited(tmp_path, PROPOSES_NOTHING, HARMLESS)
    done = with_core(core, "prove", *IN_STEP, "--against", original, cwd=tmp_path)
    assert done.returncode == 4, done.stderr
    assert "- the original has it as well: an idle agent has committed every block" in done.stdout
    assert "- not decided: the search ended early" in done.stdout


def test_original_can_be_a_commit(tmp_path: Path) -> None:
    if subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True).returncode:
        pytest.skip("the harness does not run from a git clone")
    done = harness("prove", "--agents", 1, "--blocks", 1, "--against", "HEAD", "--out", tmp_path / "found.yaml")
    assert done.returncode == 0, done.stderr
    assert "the original, HEAD:" in done.stdout


@pytest.mark.parametrize(
    ("original", "sentence"),
    [("no-such-commit", "no-such-commit"), ("tests", "the directory has no ucp/agent.py; name the top of a checkout")],
)
def test_unusable_original_is_refused_in_a_sentence(original: str, sentence: str, tmp_path: Path) -> None:
    done = harness("prove", "--blocks", 1, "--against", original, "--out", tmp_path / "found.yaml", cwd=ROOT)
    assert done.returncode == 2
    [said] = sentences(done.stderr)
    assert sentence in said


def test_original_that_does_not_start_is_refused_in_a_sentence(tmp_path: Path) -> None:
    core = edited(tmp_path, Bug("agent.py", "class Agent:", "class Another:"))
    done = harness("prove", "--blocks", 1, "--against", core, "--out", tmp_path / "found.yaml")
    assert done.returncode == 2
    assert "the prover cannot explore this core" in sentences(done.stderr)[-1]
