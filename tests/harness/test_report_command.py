"""`ucp-harness report`: the report of a run, drawn again, whatever is left of the run."""

import shutil
import signal
from pathlib import Path

import pytest

from harness.progress import Silent
from harness.run import run
from tests.harness.command import Running, harness, sentences, write_scenario
from tests.harness.mission import edit
from tests.harness.virtual import scenario

PICTURES = ("report.html", "chains.svg")


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    out = tmp_path / "run"
    run(scenario(agents=3, duration_s=300), 1, out, Silent(), "sim")
    return out


def test_a_report_is_drawn_again_as_it_was(run_dir: Path) -> None:
    before = [(run_dir / name).read_bytes() for name in PICTURES]
    for name in PICTURES:
        (run_dir / name).unlink()
    done = harness("report", run_dir)
    assert (done.returncode, done.stdout, done.stderr) == (0, f"{run_dir / 'report.html'}\n", "")
    assert [(run_dir / name).read_bytes() for name in PICTURES] == before


def test_of_a_run_that_was_killed_there_is_what_is_left(tmp_path: Path) -> None:
    keys = {"duration_s": 1_000_000, "events": {"source": "random"}}
    running = Running(write_scenario(tmp_path, **keys), tmp_path / "run", "--backend", "sim")
    running.wait_for_mission(1)
    running.process.send_signal(signal.SIGKILL)
    assert running.end()[0] == -signal.SIGKILL
    done = harness("report", running.out)
    assert done.returncode == 0
    assert done.stdout == f"{running.out / 'report.html'}\n"
    assert sentences(done.stderr) == [
        "the run has not recorded its end: it is still going on, or it was killed",
        f"there is no verdict: `ucp-harness check {running.out}` judges what there is",
        *(f"agent {agent}: no usable export" for agent in (1, 2, 3)),
    ]
    assert all((running.out / name).stat().st_size for name in PICTURES)


def test_a_damaged_export_is_told_and_the_rest_is_drawn(run_dir: Path) -> None:
    (run_dir / "agents" / "2.chain.json").write_text("{")
    done = harness("report", run_dir)
    assert done.returncode == 0
    missing, damaged = sentences(done.stderr)
    assert missing == "agent 2: no usable export (exported)"
    assert "2.chain.json: truncated or damaged" in damaged
    assert "agent 2: no usable export" in (run_dir / "report.html").read_text()


@pytest.mark.parametrize("what", ["nowhere", "no record", "another record"])
def test_what_is_no_run_directory_is_status_2(run_dir: Path, what: str) -> None:
    if what == "nowhere":
        shutil.rmtree(run_dir)
    elif what == "no record":
        (run_dir / "run.json").unlink()
    else:
        edit(run_dir / "run.json", lambda record: record.update(schema="ucp-scale/1"))
    done = harness("report", run_dir)
    assert (done.returncode, done.stdout) == (2, "")
    (said,) = sentences(done.stderr)
    assert "run.json: " in said


def test_a_report_that_cannot_be_written_is_status_3(run_dir: Path) -> None:
    (run_dir / "report.html").unlink()
    (run_dir / "report.html").mkdir()
    done = harness("report", run_dir)
    assert done.returncode == 3
    assert "report.html: cannot be written" in sentences(done.stderr)[0]
