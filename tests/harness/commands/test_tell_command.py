"""Test `ucp-harness tell`, which causes events in an active run from another terminal.

Test `ucp-harness shell`, which opens a shell in the network of a vehicle of an active run.
"""

import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from harness.play.request_socket import SOCKET
from tests.harness.command import COMMAND, Running, harness, sentences, write_scenario


@pytest.mark.any_user
def test_virtual_time_stays_paused_until_a_command_continues_it(tmp_path: Path) -> None:
    out = tmp_path / "run"
    active = Running(write_scenario(tmp_path), out, "--backend", "sim", "--by-hand", "--seed", "3")
    active.wait_for((out / SOCKET).exists, "its socket")
    events = [
        ("step 20", "20.000 s\n"),
        ("partition 1 2 | 3", "20.000 s\n"),
        ("1 does not reach 2", "20.001 s\n"),
        ("", "20.001 s, paused\n  {at_s: 20.0, partition: [[1, 2], [3]]}\n"),
        ("full speed", "20.001 s\n"),
        ("step 30 s", "50.001 s\n"),
    ]
    for sentence, answer in events:
        assert harness("tell", out, *sentence.split()).stdout.startswith(answer)
    for sentence, refusal in (
        ("kill 9", "kill names vehicle 9, which is not on the roster: use one of 1, 2, 3"),
        ("{lose: 0.5}", "`lose` is unknown: use one of "),
        ("1 log", "'1 log' is not a command: use `partition 1 2 | 3`"),
    ):
        done = harness("tell", out, *sentence.split())
        assert done.returncode == 2
        assert sentences(done.stderr)[0].startswith(refusal)
    assert harness("tell", out, "go on").returncode == 0
    assert active.end()[0] == 0
    assert [fault["by_hand"] for fault in active.record()["faults"]] == [True, True]
    again = tmp_path / "again"
    assert harness("run", out / "replay.yaml", "--backend", "sim", "--seed", "3", "--out", again).returncode == 0
    for agent in (1, 2, 3):
        trace = f"agents/{agent}.trace.jsonl"
        assert (again / trace).read_bytes() == (out / trace).read_bytes()


@pytest.mark.lab
@pytest.mark.any_user
def test_run_of_processes_accepts_events_and_cannot_pause(tmp_path: Path) -> None:
    out = tmp_path / "run"
    active = Running(write_scenario(tmp_path, duration_s=100_000), out, "--by-hand")
    active.wait_for_mission(1, 2, 3)
    active.wait_for(lambda: harness("tell", out, "partition", "1", "|", "2", "3").returncode == 0, "the mission")
    assert harness("tell", out, "reboot", "3").returncode == 2
    assert harness("tell", out, "{reboot: [3], down_s: 20, disk: kept}").returncode == 0
    assert "the time of real processes cannot be paused" in harness("tell", out, "pause").stderr
    assert harness("tell", out, "heal").returncode == 0
    active.wait_for(lambda: '"what":"boot"' in (out / "network.jsonl").read_text(), "the end of the reboot")
    active.process.send_signal(signal.SIGINT)
    status, _, complaints = active.end()
    assert status == 130, complaints
    events = [(fault["what"], fault["by_hand"]) for fault in active.record()["faults"]]
    assert [what for what, by_hand in events if by_hand] == ["partition", "reboot", "heal"]
    assert ("boot", False) in events
    assert "by hand" in (out / "replay.yaml").read_text()


@pytest.mark.any_user
def test_tell_without_an_active_run_causes_one_sentence(tmp_path: Path) -> None:
    done = harness("tell", tmp_path, "heal")
    assert done.returncode == 2
    assert sentences(done.stderr)[0].startswith(f"{tmp_path}: no active run here takes commands: start")


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


def test_shell_without_an_active_run_causes_one_sentence(tmp_path: Path) -> None:
    done = harness("shell", tmp_path)
    assert done.returncode == 2
    assert f"{tmp_path} has no running vehicles: the run has ended, or has not begun;" in sentences(done.stderr)[0]
