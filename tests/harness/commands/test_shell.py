"""Test `ucp-harness shell`, which opens a shell in the network of a vehicle of an active run."""

import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.harness.command import COMMAND, harness, sentences, write_scenario

DEADLINE_S = 60.0


@contextmanager
def active_run(tmp_path: Path, kind: str) -> Iterator[Path]:
    """Start a run, and yield its directory as soon as all agents are running. End the run afterwards."""
    out = tmp_path / "run"
    scenario = write_scenario(tmp_path, duration_s=100_000, vehicles={"kind": kind})
    with subprocess.Popen(
        [*COMMAND, "run", str(scenario), "--out", str(out)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as process:
        try:
            deadline = time.monotonic() + DEADLINE_S
            while harness("shell", out).stdout != f"{out}: vehicles 1, 2, 3\n":
                assert process.poll() is None and time.monotonic() < deadline
                time.sleep(0.1)
            yield out
        finally:
            process.terminate()


@pytest.mark.lab
@pytest.mark.parametrize("kind", ["embedded", "none"])
def test_shell_runs_a_command_in_the_network_of_a_vehicle(kind: str, tmp_path: Path) -> None:
    with active_run(tmp_path, kind) as out:
        assert f"{out}: vehicles 1, 2, 3\n" in harness("shell").stdout
        inside = harness("shell", out, 2, "--", "ip", "-brief", "address")
        assert "10.77.0.2/14" in inside.stdout
        assert harness("shell", out, 2, "--", "sh", "-c", "exit 7").returncode == 7
        unknown = harness("shell", out, 9)
        assert (unknown.returncode, sentences(unknown.stderr)) == (
            2,
            [f"vehicle 9 of {out} has no running process: choose one of 1, 2, 3"],
        )
        (out / "agents/9").mkdir()
        with subprocess.Popen(
            ["sleep", "60"], cwd=out / "agents/9"
        ) as visitor:  # a process outside the run that works in its directory
            assert harness("shell", out).stdout == f"{out}: vehicles 1, 2, 3\n"
            visitor.kill()


def test_shell_without_an_active_run_is_one_sentence(tmp_path: Path) -> None:
    done = harness("shell", tmp_path)
    assert done.returncode == 2
    assert f"{tmp_path} has no running vehicles: the run has ended, or has not begun;" in sentences(done.stderr)[0]
