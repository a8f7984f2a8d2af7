"""Test the progress display while a run is judged. Ctrl-C ends it with a sentence and exit status 130."""

import io
from pathlib import Path
from typing import Any, NoReturn

import pytest
from rich.console import Console

from harness import checker, cli
from harness.archive.archive import RunArchive
from harness.errors import InterruptedRunError
from harness.play import progress
from harness.play.progress import ProgressLines, SilentProgress
from harness.run.run import run
from tests.harness.command import sentences
from tests.harness.virtual import scenario

SWARM = scenario(agents=3, duration_s=100)


class Judged(SilentProgress):
    """A display that records the steps of the checker. At one of the steps, it can act like Ctrl-C."""

    def __init__(self, interrupted_at: str | None = None) -> None:
        self.steps: list[str] = []
        self._interrupted_at = interrupted_at

    def show_judging(self, step: str) -> None:
        self.steps.append(step)
        if step == self._interrupted_at:
            raise KeyboardInterrupt


def test_run_shows_each_step_of_its_judging(tmp_path: Path) -> None:
    judged = Judged()
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
        run(SWARM, 1, out, Judged(step), "sim")
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
