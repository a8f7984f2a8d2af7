"""Test that the command and the scenario in the report repeat the run exactly in virtual time."""

import html
import re
import shlex
from pathlib import Path

import pytest

from harness.archive.run_record import RunRecord
from harness.play.progress import SilentProgress
from harness.report import facts
from harness.run.run import run
from tests.harness.command import harness
from tests.harness.virtual import scenario


@pytest.mark.parametrize("all_delivered", [False, True])
def test_report_plays_the_run_again(tmp_path: Path, all_delivered: bool) -> None:
    asked = scenario(
        agents=3,
        duration_s=100,
        network={"loss": 0.3},
        timeline=[{"at_s": 40, "kill": [2]}],
        events={"source": "random", "mean_s": 5},
    )
    first = run(asked, 7, tmp_path / "first", SilentProgress(), backend="sim", delivers_all=all_delivered)
    page = (first.directory / "report.html").read_text()
    command, text = (html.unescape(part) for part in re.findall(r'<pre tabindex="0">(.*?)</pre>', page, re.DOTALL))
    (tmp_path / "scenario.yaml").write_text(text)
    program, *arguments = shlex.split(command)
    assert program == "ucp-harness"
    assert ("--watch" in arguments) is all_delivered
    assert "ucp-harness run RUN_DIRECTORY --backend sim" in (first.directory / "report.md").read_text()
    if all_delivered:
        return  # a page would wait for its reader
    again = harness(*arguments, "--out", tmp_path / "again", cwd=tmp_path)
    assert again.returncode in (0, 1), again.stderr
    for file in sorted((first.directory / "agents").iterdir()):
        assert file.read_bytes() == (tmp_path / "again" / "agents" / file.name).read_bytes()


def test_command_names_user_mode_linux() -> None:
    record = RunRecord(backend="process", seed=3, versions={"kernel": "6.1 (User Mode Linux)"})
    assert facts.command_again(record, "a b.yaml") == (
        "ucp-harness run 'a b.yaml' --backend process --seed 3 --kernel uml"
    )
