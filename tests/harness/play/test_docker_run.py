"""Test the Docker backend with real containers: its runs get the same verdicts as runs with processes, may contain
faults, and leave no containers or files behind.
"""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from harness.play.containers import ownership
from harness.play.keyring.key_directory import KeyDirectory
from tests.harness.command import Running, harness, processes, sentences, write_scenario
from tests.harness.docker import BreakableConnection, containers, foreign_container
from tests.harness.secure.secrets import leaks, left_in, secrets

pytestmark = pytest.mark.docker

SCENARIOS = Path(__file__).parents[3] / "scenarios"
ON_DOCKER = ("--backend", "docker", "--image-from-host")
NO_VEHICLES = {"vehicles": {"kind": "none"}}
IMPATIENT = (
    "import harness.play.containers.docker_engine as it; it.ANSWER_LIMIT_S = 6; import harness.cli as c; c.main()"
)
"""Code that runs `ucp-harness` with 6 s for each answer of the Docker engine. An undisturbed engine needs less."""


def on_docker(tmp_path: Path, *options: object, **keys: Any) -> subprocess.CompletedProcess[str]:
    return harness("run", write_scenario(tmp_path, **keys), "--out", tmp_path / "run", *ON_DOCKER, *options)


def long_run(tmp_path: Path, **keys: Any) -> Running:
    """Start a run that continues until the test ends it."""
    run = Running(write_scenario(tmp_path, duration_s=100_000, **NO_VEHICLES, **keys), tmp_path / "run", *ON_DOCKER)
    run.wait_for_mission(1, 2, 3)
    return run


@pytest.mark.parametrize("name", ["loss_15", "partition_heal"])
def test_scenarios_hold_in_containers(name: str, tmp_path: Path) -> None:
    out = tmp_path / "run"
    asked = ("--vehicles", "embedded", "--speedup", 40, "--seed", 1, "--out", out)
    done = harness("run", SCENARIOS / f"{name}.yaml", *ON_DOCKER, *asked)
    assert done.returncode == 0, done.stdout + done.stderr
    record = json.loads((out / "run.json").read_text())
    assert [one["verdict"] for one in record["characteristics"].values()] == ["holds"] * 6
    assert (record["backend"], record["outcome"], record["settled"]) == ("docker", "completed", True)
    assert record["figures"]["blocks"] > 20
    if name == "loss_15":
        for counted in record["counters"]["receivers"].values():
            assert 0.05 < counted["lost"] / (counted["lost"] + counted["passed"]) < 0.25, counted
    assert containers(out) == []


def test_agent_neither_reads_nor_changes_files_of_other_agents(tmp_path: Path) -> None:
    attack = "ls -R .. > 3.seen; echo x >> 1.trace.jsonl; cat 1.mission.json > 3.read; exec $0 -m ucp.node 3.*.json"
    timeline = [{"at_s": 60, "reboot": [1], "down_s": 10, "disk": "kept"}, {"at_s": 80, "kill": [2]}]
    command = {"3": ["sh", "-c", attack, sys.executable]}
    done = on_docker(tmp_path, agent_command=command, timeline=timeline, speedup=40, **NO_VEHICLES)
    assert done.returncode == 0, done.stdout + done.stderr
    agents = tmp_path / "run" / "agents"
    assert (agents / "3.seen").read_text().split() == [
        "..:",
        "agents",
        "../agents:",
        "3.log",
        "3.mission.json",
        "3.seen",
    ]
    assert (agents / "3.read").read_text() == ""
    assert [path.name for path in agents.iterdir() if path.is_symlink()] == []
    assert {path.name for path in agents.iterdir() if path.is_dir()} == {"1-2", "3-1"}


def test_containers_support_faults_of_agents_and_vehicles(tmp_path: Path) -> None:
    timeline = [
        {"at_s": 40, "pause": [1]},
        {"at_s": 60, "resume": [1]},
        {"at_s": 70, "pause": [2]},
        {"at_s": 80, "kill": [2]},
        {"at_s": 180, "restart": [2]},
        {"at_s": 200, "crash": [4]},
        {"at_s": 400, "reboot": [3], "down_s": 20, "disk": "kept"},
    ]
    done = on_docker(
        tmp_path, agents=4, duration_s=600, speedup=40, timeline=timeline, vehicles={"kind": "embedded"},
        final_reconcile=True, events={"mean_s": 10}, docker={"memory_mib": 256, "cpus": 1.5, "pids": 50},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    run = tmp_path / "run"
    agents = json.loads((run / "run.json").read_text())["agents"]
    assert {key: one["outcome"] for key, one in agents.items()} == {
        "1": "exported", "2": "exported", "3": "exported", "4": "killed"
    }  # fmt: skip
    assert (agents["2"]["restarts"], agents["3"]["reboots"]) == (1, 1)
    assert (run / "vehicles/2-2/telemetry.tlog").stat().st_size > 0
    assert "went on from a store" in (run / "agents/3-2/3.log").read_text()
    assert containers(run) == []


def test_captured_keys_work_in_containers_and_leave_no_secret(tmp_path: Path) -> None:
    """The attacker sends encrypted, forged and repeated datagrams. The test checks what agents drop and accept."""
    home = KeyDirectory.new(tmp_path / "home", [1, 2, 3], seals=True, epoch_s=30.0)
    timeline = [
        {"at_s": 40, "forge": {"message": "Commit Block", "sender": 2}},
        {"at_s": 45, "forge": {"message": "Commit Block", "sender": 3}},
        {"at_s": 50, "duplicate": {"for_s": 10}},
        {"at_s": 70, "kill": [3]},
        {"at_s": 72, "revoke": [3], "heard_by": [1]},
        {"at_s": 80, "forge": {"message": "Commit Block", "sender": 3}},
    ]
    security = {"keys": str(home.directory), "seal": True, "captured": 3}
    done = on_docker(
        tmp_path, agents=3, duration_s=100, speedup=10, security=security, timeline=timeline, events={"mean_s": 8},
        **NO_VEHICLES,
    )  # fmt: skip
    assert done.returncode == 1, done.stdout + done.stderr
    record = json.loads((tmp_path / "run/run.json").read_text())
    assert record["characteristics"]["1"]["verdict"] == "violated"
    assert all(
        "agent 3 never" in finding["detail"] for key in "14" for finding in record["characteristics"][key]["evidence"]
    )
    dropped = {reason for agent in record["agents"].values() for reason in agent["dropped"]}
    assert dropped >= {"not signed by its sender", "revoked sender"}
    left = [("its output", (done.stdout + done.stderr).encode()), *left_in(tmp_path / "run")]
    assert leaks(secrets(home, 14), left) == []
    assert containers(tmp_path / "run") == []


def test_clean_after_sigkill_removes_only_own_containers(tmp_path: Path) -> None:
    run = long_run(tmp_path)
    held = [f"{ownership.run_name(run.out)}-{role}-{number}" for role in ("agent", "network") for number in (1, 2, 3)]
    assert containers(run.out) == held
    with foreign_container(f"stranger-{os.getpid()}") as engine:
        assert harness("clean").returncode == 0
        assert containers(run.out) == held, "it goes on"
        run.process.kill()
        run.process.wait()
        assert processes(run.out), "containers are not the orchestrator's children"
        cleaned = harness("clean")
        assert cleaned.returncode == 0
        assert {f"removed {name}" for name in held} <= set(cleaned.stdout.splitlines())
        assert containers(run.out) == []
        assert engine.api.inspect_container(f"stranger-{os.getpid()}")["State"]["Running"]
    assert not processes(run.out)


def test_ctrl_c_leaves_nothing(tmp_path: Path) -> None:
    run = long_run(tmp_path)
    run.process.send_signal(signal.SIGINT)
    status, _, err = run.end()
    assert status == 130, err
    assert run.record()["outcome"] == "interrupted"
    assert (run.out / "agents/1.chain.json").exists()
    assert containers(run.out) == []
    assert not processes(run.out)


def test_ctrl_c_while_containers_start_leaves_nothing(tmp_path: Path) -> None:
    scenario = write_scenario(tmp_path, agents=20, duration_s=100_000, **NO_VEHICLES)
    run = Running(scenario, tmp_path / "run", *ON_DOCKER)
    run.wait_for(lambda: containers(run.out), "the first container")
    run.process.send_signal(signal.SIGINT)
    status, _, err = run.end()
    assert (status, sentences(err)[-1]) == (130, "the run was interrupted before its start")
    assert containers(run.out) == []


@pytest.mark.parametrize(
    ("hurt", "sentence"),
    [(BreakableConnection.silent, "stopped answering"), (BreakableConnection.cut, "the Docker engine has stopped")],
)
def test_stopped_engine_ends_the_run(hurt: Any, sentence: str, tmp_path: Path) -> None:
    way = BreakableConnection(tmp_path / "way.sock")
    scenario = write_scenario(tmp_path, duration_s=100_000, **NO_VEHICLES)
    out = tmp_path / "run"
    command = [sys.executable, "-c", IMPATIENT]
    env = {**os.environ, "DOCKER_HOST": f"unix://{way.path}"}
    run = Running(scenario, out, *ON_DOCKER, command=command, env=env)
    run.wait_for_mission(1, 2, 3)
    hurt(way)
    status, _, err = run.end()
    assert status == 3, err
    assert sentence in sentences(err)[0]
    assert "`ucp-harness clean`" in sentences(err)[0]
    assert run.record()["outcome"] == "failed"
    assert (out / "agents/1.chain.json").exists(), "agents answer as long as they live"
    assert not processes(out), "they have been killed without the engine"
    assert harness("clean").returncode == 0
    assert containers(out) == []


def test_used_container_name_causes_one_sentence(tmp_path: Path) -> None:
    name = f"{ownership.run_name(tmp_path / 'run')}-network-2"
    with foreign_container(name):
        done = on_docker(tmp_path, **NO_VEHICLES)
    assert done.returncode == 3
    assert sentences(done.stderr) == [
        f"the container {name} of another run in the same directory exists: if that run has ended, remove the "
        f"container with `ucp-harness clean`, otherwise with docker rm -f {name}"
    ]
    assert json.loads((tmp_path / "run/run.json").read_text())["outcome"] == "failed"
    assert containers(tmp_path / "run") == []


@pytest.mark.parametrize(
    ("keys", "status", "sentence"),
    [
        ({"docker": {"image": "no/such:image"}}, 3, "this machine has no image no/such:image: docker pull"),
        (
            {"docker": {"image": "ucp-harness-host:empty"}, "agent_command": ["/usr/bin/env", "python3"]},
            1,
            "agent 1 ended by itself with status 127: its image does not hold this program ([FATAL tini",
        ),
        ({"agent_command": ["/bin/false"]}, 1, "agent 1 ended by itself with status 1; its log is agents/1.log"),
        (
            {"docker": {"memory_mib": 6}},
            1,
            "agent 1 ended by itself with SIGKILL, out of memory: it may use 6 MiB (`docker.memory_mib`); its log is",
        ),
    ],
)  # fmt: skip
def test_agent_that_cannot_run_fails_the_run(keys: Any, status: int, sentence: str, tmp_path: Path) -> None:
    done = on_docker(tmp_path, agents=[1], **NO_VEHICLES, **keys)
    assert done.returncode == status, done.stderr
    assert sentences(done.stderr)[0].startswith(sentence)
    assert containers(tmp_path / "run") == []


def test_captures_contain_datagrams_of_containers(tmp_path: Path) -> None:
    done = on_docker(tmp_path, "--capture", events={"source": "random", "mean_s": 5}, **NO_VEHICLES)
    assert done.returncode == 0, done.stderr
    captured = json.loads((tmp_path / "run/run.json").read_text())["capture"]
    for vehicle in ("1", "2", "3"):
        assert captured[vehicle]["received"] > 0
        assert captured[vehicle]["dropped"] == 0
        assert (tmp_path / f"run/capture/{vehicle}.pcapng").stat().st_size > 1000


def test_output_of_a_program_is_in_its_log(tmp_path: Path) -> None:
    agent = tmp_path / "agent.sh"
    agent.write_text("#!/bin/sh\necho to $1\necho at home: $(ls /proc/self/fd | wc -l) >&2\nexit 4\n")
    agent.chmod(0o755)
    done = on_docker(tmp_path, agents=[7], agent_command=[str(agent)], **NO_VEHICLES)
    assert sentences(done.stderr)[0].startswith("agent 7 ended by itself with status 4")
    said = (tmp_path / "run/agents/7.log").read_text()
    assert "to 7.mission.json" in said
    assert "at home:" in said


def test_container_cannot_change_its_network(tmp_path: Path) -> None:
    """The container has no privileges, and its root directory is read-only."""
    agent = tmp_path / "agent.sh"
    agent.write_text("#!/bin/sh\ngrep Cap /proc/self/status\ngrep NoNewPrivs /proc/self/status\ntouch /x\nexit 4\n")
    agent.chmod(0o755)
    on_docker(tmp_path, agents=[7], agent_command=[str(agent)], **NO_VEHICLES)
    said = (tmp_path / "run/agents/7.log").read_text().split("\n")
    capabilities = [line.split()[1] for line in said if line.startswith("Cap")]
    assert capabilities == ["0000000000000000"] * 5
    assert "NoNewPrivs:\t1" in said
    assert any("Read-only file system" in line for line in said)
