"""Test that packet captures of runs contain the frames that were sent and received."""

import json
import os
import signal
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from harness.archive.run_record import CapturedFrames
from harness.play.progress import SilentProgress
from harness.report.facts import gaps
from harness.run.run import run
from netem.frames import udp_broadcast
from tests.captured import CapturedFrame, comment, frames, statistics
from tests.harness.command import Running, harness, processes, sentences, write_scenario
from tests.harness.virtual import scenario
from ucp.messages import BlockAddRequest, CommitBlock, decode

PORT = 14600
SOURCE = slice(26, 30)
CHANGES = [
    {"at_s": 50, "partition": [[1, 2], [3]]},
    {"at_s": 150, "heal": True},
    {"at_s": 200, "pause": [2]},
    {"at_s": 300, "kill": [1]},
    {"at_s": 350, "resume": [2]},
    {"at_s": 400, "restart": [1]},
]
RUN: dict[str, Any] = {
    "agents": 3,
    "duration_s": 600,
    "network": {"loss": 0.1},
    "events": {"source": "random", "mean_s": 10},
    "vehicles": {"kind": "none"},
    "timeline": CHANGES,
    "final_reconcile": True,
}


def captured(out: Path) -> dict[int, list[CapturedFrame]]:
    return {int(path.stem): frames(path) for path in sorted((out / "capture").glob("*.pcapng"))}


def record(out: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((out / "run.json").read_text())
    return found


def files(out: Path) -> dict[str, bytes]:
    """Return the files of a run that must be the same with and without a packet capture."""
    kept = ("agents/*", "before-final-reconcile/*", "network.jsonl")
    return {str(path.relative_to(out)): path.read_bytes() for pattern in kept for path in out.glob(pattern)}


def test_capture_in_virtual_time_changes_nothing_else(tmp_path: Path) -> None:
    for name, capture in (("without", False), ("with", True)):
        finished = run(scenario(**RUN, capture=capture), 5, tmp_path / name, SilentProgress(), "sim")
        assert finished.played.outcome == "completed", finished.played.outcome_detail
    assert files(tmp_path / "without") == files(tmp_path / "with") != {}
    without, with_capture = record(tmp_path / "without"), record(tmp_path / "with")
    assert without["capture"] is None
    assert not (tmp_path / "without" / "capture").exists()
    for key in ("figures", "characteristics", "agents", "network"):
        assert without[key] == with_capture[key]


def test_virtual_captures_have_sent_and_received_frames(tmp_path: Path) -> None:
    run(scenario(**RUN, capture=True), 5, tmp_path / "run", SilentProgress(), "sim")
    found = captured(tmp_path / "run")
    recorded = record(tmp_path / "run")
    assert sorted(found) == [1, 2, 3]
    sent = {vehicle: [frame for frame in seen if frame.outbound] for vehicle, seen in found.items()}
    received = {vehicle: [frame for frame in seen if not frame.outbound] for vehicle, seen in found.items()}
    assert sum(map(len, sent.values())) == recorded["figures"]["messages"]
    for vehicle, seen in found.items():
        path = tmp_path / "run" / "capture" / f"{vehicle}.pcapng"
        assert comment(path) == {"ucp_harness": 1, "vehicle": vehicle, "epoch_us": 0, "speedup": 1.0}
        assert statistics(path) == {"received": len(seen), "dropped": 0} == recorded["capture"][str(vehicle)]
        assert seen == sorted(seen, key=lambda frame: frame.at_ns)
        for frame in seen:
            sender, _, _ = decode(frame.payload)
            assert frame.data == udp_broadcast(sender, PORT, frame.payload)
            assert frame.outbound == (sender == vehicle)
            before = [one.at_ns for one in sent[sender] if one.data == frame.data]
            assert frame.outbound or any(2e6 <= frame.at_ns - at_ns <= 50e6 for at_ns in before)
    # A paused or dead agent sends nothing. Its interface still receives frames.
    for vehicle, (silent_from, silent_until) in {2: (200, 350), 1: (300, 400)}.items():
        span = range(silent_from * 10**9, silent_until * 10**9)
        assert not [frame for frame in sent[vehicle] if frame.at_ns in span]
        assert [frame for frame in received[vehicle] if frame.at_ns in span]
    apart = range(int(50.05 * 10**9), 150 * 10**9)
    assert {decode(frame.payload)[0] for frame in received[3] if frame.at_ns in apart} == set()
    assert {decode(frame.payload)[0] for frame in received[2] if frame.at_ns in apart} == {1}


def test_scripted_loss_is_only_in_the_virtual_capture_of_the_sender(tmp_path: Path) -> None:
    fates = [{"message": "Commit Block", "receiver": 2, "drop": True}]
    run(scenario(**{**RUN, "timeline": []}, fates=fates, capture=True), 5, tmp_path / "run", SilentProgress(), "sim")
    commits = {
        vehicle: Counter(frame.outbound for frame in seen if isinstance(decode(frame.payload)[2], CommitBlock))
        for vehicle, seen in captured(tmp_path / "run").items()
    }
    assert commits[2][False] == 0
    assert all(commits[vehicle][True] and commits[vehicle][False] for vehicle in (1, 3))


@pytest.mark.lab
def test_capture_agrees_with_the_counters_of_the_kernel(tmp_path: Path) -> None:
    path = write_scenario(tmp_path, **{**RUN, "timeline": [{"at_s": 100, "kill": [3]}], "duration_s": 300})
    done = harness("run", path, "--capture", "--seed", 1, "--out", tmp_path / "run")
    assert done.returncode == 0, done.stdout + done.stderr
    recorded, found = record(tmp_path / "run"), captured(tmp_path / "run")
    assert recorded["scenario"]["capture"]
    assert sorted(found) == [1, 2, 3]
    trace = (tmp_path / "run" / "agents" / "1.trace.jsonl").read_text().splitlines()
    clock = json.loads(trace[0])["clock"]
    for vehicle, seen in found.items():
        path = tmp_path / "run" / "capture" / f"{vehicle}.pcapng"
        counts = {outbound: sum(frame.outbound == outbound for frame in seen) for outbound in (True, False)}
        assert counts[False] == recorded["counters"]["receivers"][str(vehicle)]["passed"]
        assert statistics(path) == {"received": len(seen), "dropped": 0} == recorded["capture"][str(vehicle)]
        assert comment(path) == {"ucp_harness": 1, "vehicle": vehicle, **clock}
        for frame in seen:
            sender, _, _ = decode(frame.payload)
            assert frame.outbound == (sender == vehicle)
            assert 0 <= (frame.at_ns - clock["epoch_us"] * 1000) / 1e9 * clock["speedup"] <= recorded["mission_s"] + 60
    assert sum(frame.outbound for seen in found.values() for frame in seen) >= recorded["figures"]["messages"]
    first = next(frame for frame in found[1] if frame.outbound)
    assert isinstance(decode(first.payload)[2], BlockAddRequest)
    assert first.data[SOURCE] == udp_broadcast(1, PORT, b"")[SOURCE]
    # Agent 3 is dead, and the interface of its vehicle still receives frames.
    killed_ns = (clock["epoch_us"] + 100 / clock["speedup"] * 10**6) * 1000 + 50e6
    assert [frame for frame in found[3] if frame.at_ns > killed_ns]
    assert not [frame for frame in found[3] if frame.at_ns > killed_ns and frame.outbound]


@pytest.mark.lab
def test_captures_of_a_killed_run_are_readable(tmp_path: Path) -> None:
    long_run = {**RUN, "timeline": [], "duration_s": 100_000}
    running = Running(write_scenario(tmp_path, **long_run), tmp_path / "run", "--capture")
    running.wait_for_mission(1, 2, 3)
    running.wait_for(lambda: all(len(seen) > 20 for seen in captured(tmp_path / "run").values()), "captured frames")
    running.process.kill()
    running.end()
    for seen in captured(tmp_path / "run").values():
        assert len(seen) > 20
        assert {decode(frame.payload)[0] for frame in seen} <= {1, 2, 3}


@pytest.mark.lab
@pytest.mark.any_user
def test_crashed_capture_ends_the_run_with_one_sentence_and_status_3(tmp_path: Path) -> None:
    long_run = {**RUN, "timeline": [], "duration_s": 100_000}
    running = Running(write_scenario(tmp_path, **long_run), tmp_path / "run", "--capture")
    running.wait_for_mission(1, 2, 3)
    (pid,) = [pid for pid, command in processes(tmp_path / "run").items() if "netem.tap" in command]
    os.kill(pid, signal.SIGKILL)
    status, _, err = running.end()
    assert status == 3
    assert sentences(err) == [
        "The capture of packets failed: SIGKILL; the chains and traces that were written are checked",
    ]
    recorded = running.record()
    assert recorded["outcome"] == "failed"
    assert recorded["capture"] is None
    assert {agent["outcome"] for agent in recorded["agents"].values()} == {"exported"}
    assert not processes(tmp_path / "run")


def test_report_shows_gaps_of_captures(tmp_path: Path) -> None:
    counts = {"1": {"received": 10, "dropped": 0}, "7": {"received": 20, "dropped": 4}}
    frames = {vehicle: CapturedFrames.model_validate(counted) for vehicle, counted in counts.items()}
    assert gaps(frames) == ("the capture lacks 4 of 30 frames, of vehicle 7, because this machine was too slow")
    assert gaps({"1": frames["1"]}) is None
    finished = run(scenario(**RUN, capture=True), 5, tmp_path / "run", SilentProgress(), "sim")
    path = tmp_path / "run" / "run.json"
    path.write_text(json.dumps({**record(tmp_path / "run"), "capture": counts}))
    assert "the capture lacks 4 of 30 frames" not in finished.report.read_text()
    done = harness("report", tmp_path / "run")
    assert done.returncode == 0, done.stderr
    assert "the capture lacks 4 of 30 frames" in finished.report.read_text()
