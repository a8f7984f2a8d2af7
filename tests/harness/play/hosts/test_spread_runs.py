"""Test runs whose agents are on the workers of a Dask cluster, which are local processes."""

import contextlib
import json
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.harness.command import Running, harness, sentences, write_scenario
from tests.harness.dask_processes import Cluster, until

pytest.importorskip("distributed", reason="needs the extra `cluster`")
pytestmark = [
    pytest.mark.lab,
    pytest.mark.skipif(not os.access("/dev/net/tun", os.W_OK), reason="this user may not open /dev/net/tun"),
]

GOOD = {**dict.fromkeys("123456", "holds"), "steps": "as specified", "records": "agree", "liveness": "finished"}


class Hosts(Cluster):
    """Workers whose agents have their files in the directory `files`. An environment variable of the workers names
    it.
    """

    def __init__(self, directory: Path, stack: contextlib.ExitStack) -> None:
        super().__init__(directory, stack)
        self.files = directory / "files"
        self.files.mkdir()
        self.scheduler_address = self.start_scheduler()

    def start(self, name: str, **options: Any) -> Any:
        (self.files / name).mkdir()
        return self.start_worker(self.scheduler_address, name, TMPDIR=str(self.files / name), **options)

    def processes(self, name: str = "") -> dict[int, str]:
        """Return the agent processes of a worker, or of all workers, with their command lines."""
        found = {}
        for process in Path("/proc").iterdir():
            with contextlib.suppress(OSError):
                if process.name.isdigit() and str(self.files / name).encode() in (process / "environ").read_bytes():
                    found[int(process.name)] = (process / "cmdline").read_bytes().replace(b"\0", b" ").decode()
        return {pid: command for pid, command in found.items() if "dask_worker" not in command}

    def left_behind(self) -> list[str]:
        """Return the files and processes of agents that still exist."""
        return [*self.processes().values(), *(path.name for path in self.files.glob("*/*"))]


@pytest.fixture
def hosts(tmp_path: Path) -> Iterator[Hosts]:
    folder = tmp_path / "dask"
    folder.mkdir()
    with contextlib.ExitStack() as stack:
        yield Hosts(folder, stack)


def scenario(directory: Path, **keys: Any) -> Path:
    usual = {"vehicles": {"kind": "none"}, "events": {"source": "random", "mean_s": 10}, "speedup": 20}
    return write_scenario(directory, **{**usual, **keys})


def verdicts(record: dict[str, Any]) -> dict[str, str]:
    judged = {**record["characteristics"], **{key: record[key] for key in ("steps", "records", "liveness")}}
    return {key: judgement["verdict"] for key, judgement in judged.items()}


def losses(record: dict[str, Any]) -> tuple[int, int]:
    """Return the number of lost copies of messages, and the number of all copies."""
    receivers = record["counters"]["receivers"].values()
    lost = sum(receiver["lost"] for receiver in receivers)
    return lost, lost + sum(receiver["passed"] for receiver in receivers)


def record_of(out: Path) -> Any:
    return json.loads((out / "run.json").read_text())


def test_agents_on_two_workers_are_judged_as_on_one_machine(tmp_path: Path, hosts: Hosts) -> None:
    hosts.start("one")
    hosts.start("two", threads=2)
    path = scenario(
        tmp_path,
        agents=6,
        network={"loss": 0.15},
        timeline=[{"at_s": 60, "reboot": [2], "down_s": 20, "disk": "kept"}, {"at_s": 120, "kill": [5]}],
    )
    away, here = tmp_path / "away", tmp_path / "here"
    done = harness("run", path, "--seed", 1, "--scheduler", hosts.scheduler_address, "--out", away, deadline_s=240)
    assert done.returncode in (0, 4), done.stderr
    record = record_of(away)
    placed: dict[str, list[int]] = {}
    for agent, found in record["remote"].items():
        placed.setdefault(found["worker"], []).append(int(agent))
    assert sorted(map(len, placed.values())) == [2, 4], "in proportion to the threads"
    assert {found["lost"] for found in record["remote"].values()} == {0}
    assert (record["agents"]["2"]["reboots"], record["agents"]["5"]["outcome"]) == (1, "killed")
    for worker, agents in placed.items():
        words = f"{agents[0]} and {agents[1]}" if len(agents) == 2 else f"{agents[0]}\u2013{agents[-1]}"
        assert f"Agents {words} ran on the worker {worker}" in (away / "report.md").read_text()
    until(lambda: hosts.left_behind() == [])
    assert harness("run", path, "--seed", 1, "--out", here, deadline_s=240).returncode in (0, 4)
    counted = [losses(record), losses(record_of(here))]
    for lost, sent in counted:
        assert sent > 300
        assert abs(lost / sent - 0.15) < 4 * (0.15 * 0.85 / sent) ** 0.5, counted


def test_lost_worker_cuts_off_its_agents_and_the_run_goes_on(tmp_path: Path, hosts: Hosts) -> None:
    hosts.start("one")
    doomed = hosts.start("two")
    out = tmp_path / "run"
    path = scenario(tmp_path, agents=4, duration_s=400, final_reconcile=True)
    run = Running(path, out, "--scheduler", hosts.scheduler_address, "--seed", 1)
    run.wait_for_mission(1, 2, 3, 4)
    doomed.kill()
    _, errors = run.process.communicate(timeout=120)
    record = record_of(out)
    cut = {agent: found for agent, found in record["remote"].items() if found["cut_off"]}
    assert len(cut) == 2
    (worker,) = {found["worker"] for found in cut.values()}
    named = " and ".join(cut)
    assert f"agents {named} were cut off from" in errors
    assert f"until the end, because the connection to their worker {worker} was lost" in errors
    assert record["mission_s"] > 400, "the run went on"
    assert "violated" not in verdicts(record).values()
    assert run.process.returncode == 3
    until(lambda: hosts.left_behind() == [])


def test_paused_host_is_cut_off_and_returns(tmp_path: Path, hosts: Hosts) -> None:
    hosts.start("one")
    hosts.start("two")
    out = tmp_path / "run"
    path = scenario(tmp_path, duration_s=500, final_reconcile=True)
    run = Running(path, out, "--scheduler", hosts.scheduler_address, "--seed", 1)
    run.wait_for_mission(1, 2, 3)
    stopped = hosts.processes("two")
    for pid in stopped:
        os.kill(pid, signal.SIGSTOP)
    changes = out / "network.jsonl"
    run.wait_for(lambda: " | " in changes.read_text(), "its vehicles are cut off")
    for pid in stopped:
        os.kill(pid, signal.SIGCONT)
    _, errors = run.process.communicate(timeout=120)
    record = record_of(out)
    assert (verdicts(record), run.process.returncode) == (GOOD, 0), errors
    cut = {agent: found["cut_off"] for agent, found in record["remote"].items() if found["cut_off"]}
    assert cut
    assert all(each["until_s"] > each["from_s"] for times in cut.values() for each in times)
    assert "cut off from" in errors
    until(lambda: hosts.left_behind() == [])


def test_secured_mission_gives_good_verdicts_on_a_worker(tmp_path: Path, hosts: Hosts) -> None:
    pytest.importorskip("cryptography", reason="needs the extra `secure`")
    hosts.start("one")
    out = tmp_path / "run"
    path = scenario(tmp_path, security={"keys": "fresh"}, final_reconcile=True)
    done = harness("run", path, "--scheduler", hosts.scheduler_address, "--out", out, deadline_s=240)
    assert (verdicts(record_of(out)), done.returncode) == (GOOD, 0), done.stderr
    until(lambda: hosts.left_behind() == [])


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_nothing_is_left_behind_by_an_ended_command(tmp_path: Path, hosts: Hosts, number: int) -> None:
    hosts.start("one")
    out = tmp_path / "run"
    run = Running(scenario(tmp_path, duration_s=9000), out, "--scheduler", hosts.scheduler_address)
    run.wait_for_mission(1, 2, 3)
    assert len(hosts.left_behind()) > 3
    run.process.send_signal(number)
    run.process.communicate(timeout=120)
    until(lambda: hosts.left_behind() == [])


@pytest.mark.parametrize(
    ("keys", "options", "why"),
    [
        ({}, ["--backend", "sim"], "--scheduler does not work with --backend sim"),
        ({}, ["--listen", "127.0.0.1:14700"], "none joins at --listen"),
        ({}, ["--kernel", "uml"], "--scheduler does not work with --kernel uml"),
        ({"remote": {"agents": [2], "secret_file": "lab.key"}}, [], "`remote` does not work with --scheduler"),
        ({"vehicles": {"kind": "embedded"}, "events": {}}, [], "cannot read the telemetry of their vehicles"),
        ({}, [], "--scheduler nowhere is not an address"),
    ],
)
def test_unsuitable_requests_are_refused_in_one_sentence(
    tmp_path: Path, keys: dict[str, Any], options: list[str], why: str
) -> None:
    out = tmp_path / "run"
    done = harness("run", scenario(tmp_path, **keys), "--scheduler", "nowhere", "--out", out, *options)
    (sentence,) = sentences(done.stderr)
    assert why in sentence
    assert done.returncode == 2
    assert not out.exists()


def test_worker_without_private_networks_is_named_before_the_run(tmp_path: Path, hosts: Hosts) -> None:
    hosts.start("one", PATH="/nonexistent")
    out = tmp_path / "run"
    done = harness("run", scenario(tmp_path), "--scheduler", hosts.scheduler_address, "--out", out)
    (sentence,) = sentences(done.stderr)
    assert sentence.startswith("the worker at tcp://127.0.0.1:")
    assert "cannot play agents: This machine does not allow private networks" in sentence
    assert done.returncode == 3
    assert not out.exists()
