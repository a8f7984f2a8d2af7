"""A run that goes on is told what happens, from another terminal."""

import signal
from pathlib import Path

import pytest

from harness.play.request_socket import SOCKET
from tests.harness.command import Running, harness, sentences, write_scenario


@pytest.mark.any_user
def test_virtual_time_stands_still_until_it_is_told_to_go_on(tmp_path: Path) -> None:
    out = tmp_path / "run"
    going = Running(write_scenario(tmp_path), out, "--backend", "sim", "--by-hand", "--seed", "3")
    going.wait_for((out / SOCKET).exists, "its socket")
    told = [
        ("step 20", "20.000 s\n"),
        ("partition 1 2 | 3", "20.000 s\n"),
        ("1 does not reach 2", "20.001 s\n"),
        ("", "20.001 s, paused\n  {at_s: 20.0, partition: [[1, 2], [3]]}\n"),
        ("full speed", "20.001 s\n"),
        ("step 30 s", "50.001 s\n"),
    ]
    for sentence, answer in told:
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
    assert going.end()[0] == 0
    assert [fault["by_hand"] for fault in going.record()["faults"]] == [True, True]
    again = tmp_path / "again"
    assert harness("run", out / "replay.yaml", "--backend", "sim", "--seed", "3", "--out", again).returncode == 0
    for agent in (1, 2, 3):
        trace = f"agents/{agent}.trace.jsonl"
        assert (again / trace).read_bytes() == (out / trace).read_bytes()


@pytest.mark.lab
def test_processes_are_told_and_do_not_stand_still(tmp_path: Path) -> None:
    out = tmp_path / "run"
    going = Running(write_scenario(tmp_path, duration_s=100_000), out, "--by-hand")
    going.wait_for_mission(1, 2, 3)
    going.wait_for(lambda: harness("tell", out, "partition", "1", "|", "2", "3").returncode == 0, "the mission")
    assert harness("tell", out, "reboot", "3").returncode == 2
    assert harness("tell", out, "{reboot: [3], down_s: 20, disk: kept}").returncode == 0
    assert "the time of real processes cannot be paused" in harness("tell", out, "pause").stderr
    assert harness("tell", out, "heal").returncode == 0
    going.wait_for(lambda: '"what":"boot"' in (out / "network.jsonl").read_text(), "the end of the reboot")
    going.process.send_signal(signal.SIGINT)
    status, _, complaints = going.end()
    assert status == 130, complaints
    told = [(fault["what"], fault["by_hand"]) for fault in going.record()["faults"]]
    assert [what for what, by_hand in told if by_hand] == ["partition", "reboot", "heal"]
    assert ("boot", False) in told
    assert "by hand" in (out / "replay.yaml").read_text()


@pytest.mark.any_user
def test_a_run_that_nobody_can_tell_anything_is_one_sentence(tmp_path: Path) -> None:
    done = harness("tell", tmp_path, "heal")
    assert done.returncode == 2
    assert sentences(done.stderr)[0].startswith(f"{tmp_path}: no active run here takes commands: start")
