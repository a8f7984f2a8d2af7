"""Test processes that an agent has started and that still run when the agent ends."""

import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from harness.play._child_processes import ChildProcesses
from tests.harness.command import harness, write_scenario

LEAVES_A_CHILD = f'setsid sleep 1000 </dev/null >/dev/null & exec {shlex.quote(sys.executable)} -P -m ucp.node "$0"'
AGENT = f"2=sh -c {shlex.quote(LEAVES_A_CHILD)}"


def test_children_outside_the_session_are_ended() -> None:
    processes = ChildProcesses()
    script = "setsid sleep 1000 & setsid sh -c 'sleep 1000 & wait' &"
    subprocess.run(["sh", "-c", script], env=processes.environment(os.environ), check=True)
    assert processes.end_left_behind() == ["sh", "sleep", "sleep"]
    assert not processes.pids()


def test_processes_of_another_agent_are_spared() -> None:
    processes, others = ChildProcesses(), ChildProcesses()
    with subprocess.Popen(["sleep", "1000"], env=others.environment(os.environ)) as child:
        assert not processes.end_left_behind()
        assert child.poll() is None
        others.end()


BACKENDS = [
    pytest.param(("process",), marks=pytest.mark.lab, id="process"),
    pytest.param(("docker", "--image-from-host"), marks=pytest.mark.docker, id="docker"),
    pytest.param(("sim",), id="sim"),
]


@pytest.mark.parametrize("backend", BACKENDS)
def test_run_ends_and_reports_what_an_agent_leaves_behind(backend: tuple[str, ...], tmp_path: Path) -> None:
    scenario = write_scenario(tmp_path, vehicles={"kind": "none"}, events={"source": "scripted"}, duration_s=50)
    out = tmp_path / "run"
    done = harness("run", scenario, "--backend", *backend, "--ucp-agent", AGENT, "--seed", "1", "--out", out)
    assert done.returncode == 0, done.stderr
    agents = json.loads((out / "run.json").read_text())["agents"]
    assert [agents[agent_id]["left_behind"] for agent_id in "123"] == [[], ["sleep"], []]
    assert "agent 2 ended and left processes running (sleep)" in " ".join(done.stderr.split())
