"""Test `ucp-harness report`, which writes the report of a run again, even if the run is incomplete or damaged."""

import re
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from harness.play.progress import SilentProgress
from harness.run.run import run
from tests.harness.command import Running, harness, sentences, write_scenario
from tests.harness.mission import edit
from tests.harness.virtual import scenario

WRITTEN = ("report.html", "report.md", "junit.xml", "chains.svg")


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    out = tmp_path / "run"
    run(scenario(agents=3, duration_s=300), 1, out, SilentProgress(), "sim")
    return out


def test_report_writes_the_same_files_again(run_dir: Path) -> None:
    before = [(run_dir / name).read_bytes() for name in WRITTEN]
    for name in WRITTEN:
        (run_dir / name).unlink()
    done = harness("report", run_dir)
    assert (done.returncode, done.stdout, done.stderr) == (0, f"{run_dir / 'report.html'}\n", "")
    assert [(run_dir / name).read_bytes() for name in WRITTEN] == before


def test_report_of_a_killed_run_shows_the_remaining_files(tmp_path: Path) -> None:
    keys = {"duration_s": 1_000_000, "events": {"source": "random"}}
    running = Running(write_scenario(tmp_path, **keys), tmp_path / "run", "--backend", "sim")
    running.wait_for_mission(1)
    running.process.send_signal(signal.SIGKILL)
    assert running.end()[0] == -signal.SIGKILL
    done = harness("report", running.out)
    assert done.returncode == 0
    assert done.stdout == f"{running.out / 'report.html'}\n"
    assert sentences(done.stderr) == [
        "the end of the run is not recorded: the run is still active, or it was killed",
        f"the run has no verdict: `ucp-harness check {running.out}` judges the files that exist",
        "agents 1\u20133: no usable export",
    ]
    assert all((running.out / name).stat().st_size for name in WRITTEN)


def test_damaged_export_is_reported_and_the_rest_is_drawn(run_dir: Path) -> None:
    (run_dir / "agents" / "2.chain.json").write_text("{")
    done = harness("report", run_dir)
    assert done.returncode == 0
    missing, damaged = sentences(done.stderr)
    assert missing == "agent 2: no usable export (exported)"
    assert "2.chain.json: truncated or damaged" in damaged
    assert "agent 2: no usable export" in (run_dir / "report.html").read_text()


def cut(path: Path) -> None:
    """Cut off the end of a file within a line, as if the program that writes it had been stopped."""
    path.write_bytes(path.read_bytes()[:-40])


NO_VERDICT = "the run has no verdict: `ucp-harness check {run}` judges the files that exist"


@pytest.mark.parametrize(
    ("damage", "expected"),
    [
        (
            lambda run: (run / "run.json").unlink(),
            [NO_VERDICT, "run.json is missing: scenario, verdict and figures are unknown"],
        ),
        (
            lambda run: cut(run / "run.json"),
            [NO_VERDICT, "run.json: truncated or damaged: not JSON"],
        ),
        (
            lambda run: cut(run / "agents" / "2.trace.jsonl"),
            ["agents/2.trace.jsonl: truncated in the middle of a line; the part before is read"],
        ),
        (
            lambda run: (run / "agents" / "2.trace.jsonl").unlink(),
            ["agent 2: no trace, and so no lane in the timeline"],
        ),
        (
            lambda run: [path.unlink() for path in (run / "agents").glob("*.trace.jsonl")],
            ["no agent has a trace: there is no timeline"],
        ),
        (
            lambda run: (run / "agents" / "2.chain.json").unlink(),
            ["agent 2: no usable export (exported)"],
        ),
        (
            lambda run: (run / "network.jsonl").unlink(),
            ["network.jsonl is missing: the network conditions are unknown"],
        ),
        (
            lambda run: cut(run / "network.jsonl"),
            ["network.jsonl: 1 damaged or unknown line is left out"],
        ),
        (
            lambda run: edit(run / "run.json", lambda record: record.update(vehicles={"1": {"kind": "embedded"}})),
            ["tracks.jsonl is missing: the positions of the vehicles are unknown"],
        ),
    ],
)
def test_missing_or_truncated_file_is_reported_and_the_rest_is_drawn(
    run_dir: Path, damage: Callable[[Path], object], expected: list[str]
) -> None:
    damage(run_dir)
    done = harness("report", run_dir)
    assert (done.returncode, done.stdout) == (0, f"{run_dir / 'report.html'}\n")
    found = [re.sub(r" at line \d+$", "", sentence) for sentence in sentences(done.stderr)]
    assert found == [sentence.format(run=run_dir) for sentence in expected]
    page, short = ((run_dir / name).read_text() for name in ("report.html", "report.md"))
    assert expected[-1] in page
    assert expected[-1] in short
    assert "inception block" in page


@pytest.mark.parametrize("what", ["nowhere", "no run", "another record"])
def test_directory_without_a_run_has_status_2(run_dir: Path, what: str) -> None:
    if what != "another record":
        shutil.rmtree(run_dir)
    if what == "no run":
        (run_dir / "agents").mkdir(parents=True)
    if what == "another record":
        edit(run_dir / "run.json", lambda record: record.update(schema="ucp-matrix/1"))
    done = harness("report", run_dir)
    assert (done.returncode, done.stdout) == (2, "")
    (sentence,) = sentences(done.stderr)
    expected = {
        "nowhere": "does not exist",
        "no run": "neither a run directory",
        "another record": "run.json: its schema",
    }
    assert expected[what] in sentence


def test_unwritable_report_has_status_3(run_dir: Path) -> None:
    (run_dir / "report.html").unlink()
    (run_dir / "report.html").mkdir()
    done = harness("report", run_dir)
    assert done.returncode == 3
    assert "report.html: cannot be written" in sentences(done.stderr)[0]
