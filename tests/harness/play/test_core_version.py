"""Test the version of the agent core: the recorded digests, and the effect of an edit."""

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

import harness
from harness.cli import app
from harness.play import core_version
from harness.run.provenance import versions
from harness.run.simulate import simulate
from tests.harness.play.test_simulation import digest
from tests.harness.virtual import scenario

ROOT = Path(harness.__file__).parent.parent


def test_recorded_digests_are_those_of_the_core() -> None:
    edited = core_version.edited_files()
    assert not edited, (
        f"{', '.join(edited)}: this core is not the released one. If the change is meant and all tests of steps and "
        "proofs pass, record it: python -m harness.play.core_version --record"
    )
    assert core_version.core_version().startswith("released ")


def test_core_is_all_that_an_agent_imports() -> None:
    shown = subprocess.run(
        [sys.executable, "-c", "import sys, ucp.agent, ucp.interest; print(*sys.modules)"],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
    )
    imported = {name.removeprefix("ucp.") for name in shown.stdout.split() if name.startswith("ucp.")}
    assert imported == set(core_version.FILES)


@pytest.fixture
def released_core(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Record the digests of the installed agent core as those of the released core."""
    recorded = tmp_path / "released_core.sha256"
    monkeypatch.setattr(core_version, "RELEASED", recorded)
    core_version.record()
    core_version.edited_files.cache_clear()
    yield recorded
    core_version.edited_files.cache_clear()


def edit(recorded: Path) -> None:
    """Record a wrong digest of `ucp/commit.py`, as if the file had been edited since."""
    lines = recorded.read_text("ascii").splitlines()
    edited = [f"{'0' * 64}  ucp/commit.py" if line.endswith(" ucp/commit.py") else line for line in lines]
    recorded.write_text("\n".join(edited), "ascii")
    core_version.edited_files.cache_clear()


def test_run_record_names_an_edited_core(released_core: Path) -> None:
    assert versions()["core"].startswith("released ")
    edit(released_core)
    assert core_version.edited_files() == ("ucp/commit.py",)
    assert versions()["core"].startswith("edited ")
    assert versions()["core"].endswith("(ucp/commit.py)")


def test_virtual_time_withholds_nothing_from_an_edited_core(released_core: Path) -> None:
    lossy = scenario(network={"loss": 0.2}, duration_s=200.0)
    withheld = digest(simulate(lossy, 1, tracing=True))
    delivered = digest(simulate(lossy, 1, tracing=True, deliver_all=True))
    edit(released_core)
    assert (digest(simulate(lossy, 1, tracing=True)) == delivered) and (delivered != withheld)


def test_proof_of_an_edited_core_does_not_reduce_states(released_core: Path) -> None:
    edit(released_core)
    proved = CliRunner().invoke(app, ["prove", "--agents", "2", "--blocks", "1", "--json"])
    assert "state reduction is disabled" in proved.stderr and "ucp/commit.py was edited" in proved.stderr
    assert json.loads(proved.stdout)["reduced"] is False
