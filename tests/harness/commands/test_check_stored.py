"""Test that `check` compares its verdicts and versions with the stored verdicts and versions. The exit status is 4 for
a swarm that needs more time. Test the progress display while `check` judges a run. After Ctrl-C, `check` prints a
sentence and ends with exit status 130.
"""

import io
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import pytest
from rich.console import Console

from harness import checker, cli
from harness.archive.archive import RunArchive
from harness.errors import InterruptedRunError
from harness.play import progress
from harness.play.progress import ProgressLines, SilentProgress
from harness.run import provenance
from harness.run.code_state import ROOT
from harness.run.run import run
from tests.harness.command import harness, sentences
from tests.harness.mission import edit
from tests.harness.virtual import scenario


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    asked = scenario(agents=3, duration_s=100, events={"source": "random", "mean_s": 5})
    return run(asked, 1, tmp_path_factory.mktemp("stored") / "run", SilentProgress(), backend="sim").directory


@pytest.fixture
def directory(stored: Path, tmp_path: Path) -> Path:
    shutil.copytree(stored, tmp_path / "run")
    return tmp_path / "run"


EDITS: list[tuple[Callable[[dict[str, Any]], Any], str]] = [
    (lambda record: record["characteristics"]["3"].update(verdict="violated"), "'violated' for characteristic 3"),
    (lambda record: record["steps"].update(verdict="deviates"), "'deviates' for `every step`"),
    (lambda record: record["figures"].update(blocks=1), "1 as figure blocks"),
    (lambda record: record["survival"].update(completed=1), "another survival"),
]


@pytest.mark.parametrize(("change", "expected"), EDITS)
def test_check_reports_another_stored_verdict(
    directory: Path, change: Callable[[dict[str, Any]], Any], expected: str
) -> None:
    edit(directory / "run.json", change)
    assert expected in harness("check", directory).stderr


def test_run_edited_after_its_end_has_status_1(tmp_path: Path) -> None:
    """Outside a clone, the commit is unknown. The versions of the package and of the reference then identify the
    checker.
    """
    installed = tmp_path / "installed"
    installed.mkdir()
    for package in ("harness", "netem", "sitl", "ucp"):
        (installed / package).symlink_to(ROOT / package, target_is_directory=True)

    def command(*arguments: object) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-P", "-m", "harness.cli", *map(str, arguments)],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(installed)},
            capture_output=True,
            text=True,
            check=False,
        )

    asked = tmp_path / "short.yaml"
    asked.write_text("{name: short, agents: 2, duration_s: 60, events: {source: random, mean_s: 10}}")
    played = command("run", asked, "--backend", "sim", "--seed", 1, "--out", tmp_path / "run")
    assert played.returncode == 0, played.stdout + played.stderr
    assert command("check", tmp_path / "run").returncode == 0

    edit(tmp_path / "run" / "run.json", EDITS[0][0])
    checked = command("check", tmp_path / "run")
    assert checked.returncode == 1
    assert "run.json has 'violated' for characteristic 3, but its files give 'holds'" in checked.stderr
    assert "the same checker wrote run.json, so a file was edited after the run" in checked.stderr


def test_unaltered_run_has_its_stored_verdict(directory: Path) -> None:
    checked = harness("check", directory, "--json")
    assert (checked.returncode, checked.stderr) == (0, "")
    verdict = json.loads(checked.stdout)
    assert verdict["differs_from_stored"] == [] == verdict["differing_versions"]


def test_check_and_diff_name_differing_versions(directory: Path, stored: Path) -> None:
    edit(directory / "run.json", lambda record: record["versions"].update(reference="0123456789ab"))
    assert "differ in reference 0123456789ab and" in harness("check", directory).stdout
    assert "versions of A and B: reference" in harness("diff", stored, directory).stdout


def test_modified_clone_is_never_the_same_judge(monkeypatch: pytest.MonkeyPatch) -> None:
    versions = {"ucp-harness": "1", "commit": "abc-dirty", "reference": "def"}
    monkeypatch.setattr(provenance, "versions", lambda: versions)
    assert not provenance.same_judge(versions)
    monkeypatch.setattr(provenance, "versions", lambda: {**versions, "commit": "abc"})
    assert provenance.same_judge({**versions, "commit": "abc"})


def test_swarm_that_needs_more_time_has_status_4(tmp_path: Path) -> None:
    asked = tmp_path / "short.yaml"
    asked.write_text(
        "{name: short, agents: 3, duration_s: 60, events: {source: random, mean_s: 2}, settle: {limit_s: 1}}"
    )
    played = harness("run", asked, "--backend", "sim", "--seed", 1, "--out", tmp_path / "run")
    assert "not finished" in played.stdout
    assert played.returncode == 4
    assert harness("check", tmp_path / "run").returncode == 4


SWARM = scenario(agents=3, duration_s=100)


class StepDisplay(SilentProgress):
    """A display that records the steps of the checker. At one of the steps, it can act like Ctrl-C."""

    def __init__(self, interrupted_at: str | None = None) -> None:
        self.steps: list[str] = []
        self._interrupted_at = interrupted_at

    def show_judging(self, step: str) -> None:
        self.steps.append(step)
        if step == self._interrupted_at:
            raise KeyboardInterrupt


def test_run_shows_each_step_of_its_judging(tmp_path: Path) -> None:
    judged = StepDisplay()
    run(SWARM, 1, tmp_path / "run", judged, "sim")
    assert judged.steps == [
        *(f"judging the steps of agent {number}, trace {number} of 3" for number in (1, 2, 3)),
        "writing the report",
    ]


@pytest.mark.parametrize(
    "step", ["judging the steps of agent 1, trace 1 of 3", "judging the steps of agent 3, trace 3 of 3"]
)
def test_run_interrupted_while_judged_can_be_judged_later(tmp_path: Path, step: str) -> None:
    out = tmp_path / "run"
    with pytest.raises(InterruptedRunError) as raised:
        run(SWARM, 1, out, StepDisplay(step), "sim")
    assert str(raised.value) == (
        f"interrupted before the verdict; all files of the mission are in {out}: `ucp-harness check {out}` judges them"
    )
    assert raised.value.exit_status == 130
    record = RunArchive(out).record
    assert (record.outcome, record.characteristics) == ("completed", {})
    assert checker.check(RunArchive(out)).exit_status == 0


def test_interrupted_check_has_a_sentence_and_status_130(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt(archive: Any) -> NoReturn:
        raise KeyboardInterrupt

    (tmp_path / "run.json").write_text("{}")
    monkeypatch.setattr(checker, "gather", interrupt)
    monkeypatch.setattr("sys.argv", ["ucp-harness", "check", str(tmp_path)])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 130
    assert sentences(capsys.readouterr().err) == ["interrupted: `check` did not finish"]


def test_lines_of_judging_appear_every_ten_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    shown = io.StringIO()
    lines = ProgressLines(Console(file=shown))
    for step, now[0] in (("first", 100.0), ("second", 109.0), ("third", 110.0)):
        lines.show_judging(step)
    assert shown.getvalue().split() == ["first", "third"]
