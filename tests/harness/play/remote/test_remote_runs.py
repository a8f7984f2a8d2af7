"""Test runs with an agent on another computer, which is a network namespace at the other end of a cable."""

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from harness.play.remote.secret_file import create_secret
from tests.harness.command import harness, sentences, write_scenario
from tests.harness.two_computers import FAR, LISTEN, TwoComputers, needs_two_computers, wait_until
from tests.machine import require_arm64
from ucp import contract

pytestmark = [pytest.mark.lab, *needs_two_computers]

DEADLINE_S = 120.0
EXAMPLES = Path(contract.__path__[0]) / "examples"


@pytest.fixture
def computers(tmp_path: Path) -> Iterator[TwoComputers]:
    create_secret(tmp_path / "lab.key")
    with TwoComputers(tmp_path) as both:
        yield both


def scenario(directory: Path, **keys: Any) -> Path:
    remote = {"agents": [2], "secret_file": "lab.key", "listen": LISTEN}
    usual = {"vehicles": {"kind": "none"}, "events": {"source": "random", "mean_s": 10}, "final_reconcile": True}
    return write_scenario(directory, **{"speedup": 20, **usual, "remote": remote, **keys})


def play(
    computers: TwoComputers, path: Path, *disturb: Any, far: subprocess.Popen[str] | None = None
) -> tuple[dict[str, Any], str]:
    """Play a run with agent 2 on the far computer. Return the content of run.json, and the output.

    `far` is the program with which the far computer joins, if it does not join with our agent.
    """
    far = far or computers.join("--service")
    run = computers.start("lab", "run", path, "--seed", 1, "--out", "run")
    for step in disturb:
        step()
    output, _ = run.communicate(timeout=DEADLINE_S)
    far.send_signal(signal.SIGTERM)
    far.communicate(timeout=DEADLINE_S)
    assert (computers.directory / "run/run.json").exists(), output
    record: dict[str, Any] = json.loads((computers.directory / "run/run.json").read_text())
    record["status"] = run.returncode
    return record, output


def verdicts(record: dict[str, Any]) -> dict[str, str]:
    judged = {**record["characteristics"], **{key: record[key] for key in ("steps", "records", "liveness")}}
    return {key: judgement["verdict"] for key, judgement in judged.items()}


GOOD = {**dict.fromkeys("123456", "holds"), "steps": "as specified", "records": "agree", "liveness": "finished"}


def left_behind(computers: TwoComputers) -> list[str]:
    """Return the processes of the far computer, except the process that keeps its network open."""
    pids = computers.on("far", "sh", "-c", "echo $PPID; readlink /proc/self/ns/net").split()
    own = pids[-1]
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                if str((entry / "ns/net").readlink()) == own:
                    found.append((entry / "comm").read_text().strip())
            except OSError:
                continue
    return [name for name in found if name not in ("sleep", "sh", "readlink")]


def test_remote_agent_is_paused_rebooted_and_killed_as_any_agent(computers: TwoComputers) -> None:
    path = scenario(
        computers.directory,
        duration_s=240,
        network={"loss": 0.1},
        capture=True,
        timeline=[
            {"at_s": 40, "pause": [2]},
            {"at_s": 60, "resume": [2]},
            {"at_s": 90, "reboot": [2], "down_s": 20, "disk": "kept"},
            {"at_s": 150, "kill": [2]},
            {"at_s": 170, "restart": [2]},
        ],
    )
    record, output = play(computers, path)
    assert (verdicts(record), record["status"]) == (GOOD, 0), output
    agent, remote = record["agents"]["2"], record["remote"]["2"]
    assert (agent["restarts"], agent["reboots"], agent["outcome"]) == (1, 1, "exported")
    assert agent["command"][-2:] == ["-m", "ucp.node"]
    assert (remote["host"], remote["cut_off"], remote["lost"]) == (FAR, [], 0)
    assert remote["incomplete"] == []
    assert remote["uncertainty_s"] < 1
    assert abs(remote["offset_s"]) <= remote["uncertainty_s"] + 0.01  # both computers have one clock
    assert "2" in record["datagrams"]
    assert '"computer_of":"2"' in (computers.directory / "run/lag.jsonl").read_text()
    assert "ran on the computer 192.168.7.2" in (computers.directory / "run/report.md").read_text()
    assert not (computers.directory / "run/join").exists()
    assert left_behind(computers) == []


def test_agent_on_an_arm64_processor_is_judged_as_any_agent(computers: TwoComputers) -> None:
    compiler, emulator = require_arm64()
    program = computers.directory / "ucp_agent"
    source = EXAMPLES / "ucp_agent.c"
    subprocess.run([compiler, "-O2", "-static", "-o", program, source, "-lm"], check=True)
    path = scenario(
        computers.directory,
        duration_s=160,
        network={"loss": 0.1},
        timeline=[{"at_s": 60, "reboot": [2], "down_s": 20, "disk": "kept"}],
    )
    record, output = play(computers, path, far=computers.join("--service", command=(emulator, program)))
    assert (verdicts(record), record["status"]) == (GOOD, 0), output
    assert record["agents"]["2"]["version"] == "ucp_agent.c, 1"


def test_lost_connection_cuts_the_vehicle_off_until_it_returns(computers: TwoComputers) -> None:
    """Break the connection to a remote agent, which continues to run. Its record is complete, and no check accuses it.

    First the cable loses everything for a while. Then the connection breaks, and another connection replaces it.
    """
    trace = computers.directory / "run/agents/2.trace.jsonl"
    changes = computers.directory / "run/network.jsonl"

    def wait_for_change(groups: str, number: int) -> None:
        detail = f'"detail":"{groups}"'
        wait_until(lambda: changes.read_text().count(detail) == number, f"change {number} to {groups}")

    def disturb() -> None:
        wait_until(lambda: trace.exists() and trace.read_text().count("\n") > 3, "the agent runs")
        for number, spoil in enumerate((computers.cut, computers.reset), 1):
            spoil()
            wait_for_change("1 3 | 2", number)
            computers.mend()
            wait_for_change("1 2 3", number)

    record, output = play(computers, scenario(computers.directory, duration_s=500, capture=True), disturb)
    assert (verdicts(record), record["status"]) == (GOOD, 0), output
    first, second = record["remote"]["2"]["cut_off"]
    assert 0 < first["from_s"] < first["until_s"] < second["from_s"] < second["until_s"]
    assert record["remote"]["2"]["joins"] > 1
    assert f"agent 2 was cut off from {first['from_s']:.0f} s to {first['until_s']:.0f} s" in output
    assert "2" not in record["datagrams"]  # its stand-in read datagrams that the remote agent did not get


def agents_of(computers: TwoComputers) -> list[int]:
    """Return the processes of agents that run on the far computer."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                words = (entry / "cmdline").read_bytes().split(b"\0")
                here = (entry / "cwd").resolve().is_relative_to(computers.directory)
            except OSError:
                continue
            if here and b"ucp.node" in words and b"join" not in words and b"2.mission.json" in words:
                found.append(int(entry.name))
    return found


@pytest.mark.parametrize("fault", ["kill", "reboot"])
def test_end_of_an_incarnation_that_is_cut_off_is_missing(computers: TwoComputers, fault: str) -> None:
    """Kill or reboot the vehicle while the connection is lost. The far agent continues until the connection is back.

    The connection returns after the restart of the rebooted agent.
    """
    trace = computers.directory / "run/agents/2.trace.jsonl"
    changes = computers.directory / "run/network.jsonl"
    struck: dict[str, Any] = {"kill": {"kill": [2]}, "reboot": {"reboot": [2], "down_s": 10, "disk": "kept"}}[fault]
    before: list[int] = []

    def disturb() -> None:
        wait_until(lambda: trace.exists() and trace.read_text().count("\n") > 3, "the agent runs")
        before.extend(agents_of(computers))
        computers.cut()
        wait_until(lambda: f'"what":"{fault}"' in changes.read_text(), "the fault")
        if fault == "reboot":
            wait_until((computers.directory / "run/agents/2-2/2.mission.json").exists, "the restart")
        assert agents_of(computers) == before
        computers.mend()
        wait_until(lambda: agents_of(computers) != before, "the far end has ended the agent")

    path = scenario(computers.directory, duration_s=220, capture=True, timeline=[{"at_s": 100, **struck}])
    record, output = play(computers, path, disturb)
    assert len(before) == 1
    found = verdicts(record)
    assert record["status"] == 0, output
    assert {key for key, verdict in found.items() if verdict == "not applicable"} >= {*"123", "steps", "records"}
    assert (found["4"], found["6"], found["liveness"]) == ("holds", "holds", "finished"), output
    assert found["5"] == ("holds" if fault == "reboot" else "not applicable")
    assert record["remote"]["2"]["incomplete"] == [1]
    assert record["agents"]["2"]["outcome"] == ("exported" if fault == "reboot" else "killed")
    assert "the trace of agent 2 is incomplete: the end of incarnation 1 is not on record" in output
    assert left_behind(computers) == []


RECORD = """
import socket, sys
with socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(3)) as cable, open("cable", "wb", 0) as file:
    cable.bind(("eth0", 0))
    while True:
        file.write(cable.recv(65536))
"""


def test_keys_of_a_secured_mission_travel_encrypted(computers: TwoComputers) -> None:
    """The agent reboots with its keys. After a kill, it starts again with other keys."""
    path = scenario(
        computers.directory,
        duration_s=240,
        security={"keys": "fresh"},
        timeline=[
            {"at_s": 90, "reboot": [2], "down_s": 20, "disk": "kept"},
            {"at_s": 150, "kill": [2]},
            {"at_s": 170, "restart": [2]},
        ],
    )
    computers.run("far", sys.executable, "-c", RECORD)
    wait_until((computers.directory / "cable").exists, "the cable is recorded")
    record, output = play(computers, path)
    assert (verdicts(record), record["status"]) == (GOOD, 0), output
    assert record["agents"]["2"]["reboots"] == record["agents"]["2"]["restarts"] == 1
    recorded = (computers.directory / "cable").read_bytes()
    assert b"UCPJOIN1" in recorded
    for word in (b"ucp-mission", b"bundle", b"private_key", b"epoch_us", b"handler"):
        assert word not in recorded


def test_far_computer_that_stays_away_is_named(computers: TwoComputers) -> None:
    trace = computers.directory / "run/agents/2.trace.jsonl"
    far = computers.join("--service")
    run = computers.start("lab", "run", scenario(computers.directory, duration_s=150), "--seed", 1, "--out", "run")
    wait_until(lambda: trace.exists() and trace.read_text().count("\n") > 3, "the agent runs")
    far.kill()
    output, _ = run.communicate(timeout=DEADLINE_S)
    assert run.returncode == 3
    assert "agent 2 was cut off from" in output
    assert "until the end, because the connection to its computer 192.168.7.2 was lost" in output
    record = json.loads((computers.directory / "run/run.json").read_text())
    assert "violated" not in verdicts(record).values()
    assert verdicts(record)["steps"] == verdicts(record)["6"] == "not applicable"
    assert record["remote"]["2"]["incomplete"] == [1]
    wait_until(lambda: left_behind(computers) == [], "nothing is left on the far computer")


def test_packets_lost_between_the_computers_are_no_losses_of_the_scenario(computers: TwoComputers) -> None:
    computers.lose(10)
    record, output = play(computers, scenario(computers.directory, duration_s=150))
    assert (verdicts(record), record["status"]) == (GOOD, 0), output
    assert record["remote"]["2"]["lost"] == 0
    read = record["datagrams"]
    assert read["1"]["read"] == read["2"]["read"] == read["3"]["read"]


def test_wrong_far_ends_are_refused_in_one_sentence_at_both_ends(computers: TwoComputers) -> None:
    create_secret(computers.directory / "other.key")
    run = computers.start("lab", "run", scenario(computers.directory, duration_s=9000), "--out", "run")
    first = computers.join("--service")
    wait_until(lambda: (computers.directory / "run/join").exists(), "it listens")

    def refused(**options: Any) -> str:
        wrong = computers.join(**options)
        output, _ = wrong.communicate(timeout=DEADLINE_S)
        assert wrong.returncode == 2
        assert output.count("\n") == 1, output
        return output

    # Agent 3 is on the roster, but its agent runs in the lab.
    assert "awaits agent 2, not agent 3: use --as 2" in refused(agent=3)
    assert "awaits agent 2, not agent 9: use --as 2" in refused(agent=9)
    assert "has another secret" in refused(key="other.key")
    trace = computers.directory / "run/agents/2.trace.jsonl"
    wait_until(trace.exists, "agent 2 has joined")
    assert f"agent 2 has joined from {FAR} already" in refused()
    run.send_signal(signal.SIGINT)
    output, _ = run.communicate(timeout=DEADLINE_S)
    for sentence in ("was refused: this mission awaits agent 2", "has another secret", "has joined from"):
        assert output.count(f"{FAR} {sentence}") + output.count(sentence) > 0, output
    first.send_signal(signal.SIGTERM)
    assert first.wait(DEADLINE_S) == 0


def test_far_end_ends_with_the_run(computers: TwoComputers) -> None:
    run = computers.start("lab", "run", scenario(computers.directory, duration_s=40), "--out", "run")
    wait_until(lambda: (computers.directory / "run/join").exists(), "it listens")
    far = computers.join()
    output, _ = far.communicate(timeout=DEADLINE_S)
    assert far.returncode == 0
    assert output.endswith("the run is over\n"), output
    run.communicate(timeout=DEADLINE_S)


def test_join_needs_a_harness_that_listens(computers: TwoComputers) -> None:
    far = computers.join()
    output, _ = far.communicate(timeout=DEADLINE_S)
    assert far.returncode == 2
    assert output == f"ucp-harness: no harness listens at {LISTEN}: start the run first, or add --service\n"


def test_far_computer_without_namespaces_is_refused(tmp_path: Path) -> None:
    create_secret(tmp_path / "lab.key")
    words = ["join", LISTEN, "--as", 2, "--secret-file", tmp_path / "lab.key", "--", shutil.which("true")]
    done = harness(*words, env={**os.environ, "PATH": "/nonexistent"})
    assert done.returncode == 3
    (sentence,) = sentences(done.stderr)
    assert sentence.startswith("This machine does not allow private networks (unshare is not installed)")
