"""Test the comparison of a protocol variant with the original protocol. Both use the same seeds."""

import json
from pathlib import Path
from typing import Any

import pytest

from tests.harness.command import harness
from tests.harness.run.test_variant import CORE, HEAD, REFERENCE, write_variant

MATRIX = """
name: Ties
scenario: {agents: 4, duration_s: 600, events: {source: random, mean_s: 30}, vehicles: {kind: none}}
loss: [0, 0.3]
seeds: 4
"""


@pytest.fixture
def matrix(tmp_path: Path) -> Path:
    path = tmp_path / "matrix.yaml"
    path.write_text(MATRIX)
    return path


def compared(matrix: Path, variant: Path, out: Path) -> dict[float, dict[str, Any]]:
    """Return the row with each label, for each loss rate."""
    done = harness("matrix", matrix, "--variant", variant, "--out", out, "--jobs", 1, "--json")
    assert done.returncode == 0, done.stderr
    cells = json.loads(done.stdout)["cells"]
    return {cell["loss"]: {row["label"]: row for row in cell["rows"]} for cell in cells}


def test_variant_is_compared_with_the_original_seed_by_seed(matrix: Path, tmp_path: Path) -> None:
    variant = write_variant(tmp_path, HEAD + CORE + REFERENCE)
    rows = compared(matrix, variant, tmp_path / "out")
    assert rows[0]["messages"]["differing_seeds"] == [], "without losses there is no tie"
    assert rows[0.3]["messages"]["differing_seeds"], "with losses there is one"
    assert rows[0.3]["runs with a step that deviates"]["variant"] == 0
    page = (tmp_path / "out" / "comparison.md").read_text()
    assert page.startswith("# pops (Algorithm 11) beside the original\n")
    assert "| runs with a livelock | 4 |" in page
    (beside,) = [path for path in (tmp_path / "out").iterdir() if path.name.startswith("pops-")]
    assert json.loads((beside / "matrix.json").read_text())["versions"]["variant"].startswith("pops ")
    assert "variant" not in json.loads((tmp_path / "out" / "original" / "matrix.json").read_text())["versions"]


def test_variant_that_changes_nothing_has_no_difference(matrix: Path, tmp_path: Path) -> None:
    same = HEAD + CORE.replace("yes <= no", "yes < no") + REFERENCE.replace("yes > no", "yes >= no")
    rows = compared(matrix, write_variant(tmp_path, same), tmp_path / "out")
    assert [row["differing_seeds"] for cell in rows.values() for row in cell.values()] == [[]] * 22


def test_variant_excludes_other_comparisons(matrix: Path, tmp_path: Path) -> None:
    variant = write_variant(tmp_path, HEAD + CORE + REFERENCE)
    done = harness("matrix", matrix, "--variant", variant, "--nights", tmp_path / "nights")
    assert done.returncode == 2
    assert "--variant excludes" in " ".join(done.stderr.split())
