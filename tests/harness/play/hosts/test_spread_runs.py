"""Test runs whose agents and vehicles are on the workers of a Dask cluster, which are local processes."""

import contextlib
import json
import os
import re
import signal
import socket
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from harness.play.hosts._vehicle_files import file_path
from harness.play.hosts._worker_task import why_not
from tests.harness.command import Running, harness, sentences, write_scenario
from tests.harness.dask_processes import Cluster, until

pytest.importorskip("distributed", reason="needs the extra `cluster`")
pytestmark = [
    pytest.mark.lab,
    pytest.mark.skipif(not os.access("/dev/net/tun", os.W_OK), reason="this user may not open /dev/net/tun"),
]

GOOD = {**dict.fromkeys("123456", "holds"), "steps": "as specified", "records": "agree", "liveness": "finished"}


class Hosts(Cluster):
    """Workers whose agents have their files in the directory `files`. An environment variable of the workers names this
    directory.
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
    done = harness("run", path, "--seed", 1, "--scheduler", hosts.scheduler_address, "--out", away)
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
    assert harness("run", path, "--seed", 1, "--out", here).returncode in (0, 4)
    counted = [losses(record), losses(record_of(here))]
    for lost, sent in counted:
        assert sent > 300
        assert abs(lost / sent - 0.15) < 4 * (0.15 * 0.85 / sent) ** 0.5, counted


def test_lost_worker_cuts_off_its_agents_and_the_run_continues(tmp_path: Path, hosts: Hosts) -> None:
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
    done = harness("run", path, "--scheduler", hosts.scheduler_address, "--out", out)
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


# Vehicle programs on workers

SITL = """#!{python}
# A stand-in for ArduPilot SITL: it reads the same options, and writes a parameter file and a flight log.
import pathlib, sys
option = dict(zip(sys.argv[1::2], sys.argv[2::2]))
sysid = next(line.split()[1] for line in open("vehicle.parm") if line.startswith("SYSID_THISMAV"))
pathlib.Path("eeprom.bin").write_bytes(bytes(16384))
pathlib.Path("logs").mkdir()
pathlib.Path("logs/00000001.BIN").write_bytes(b"log of " + sysid.encode() + bytes(3_000_000))
print("SITL of vehicle", sysid, flush=True)
sys.path.insert(0, {root!r})
from sitl import embedded
embedded.main(["--sysid", sysid, "--home=" + option["--home"], "--speedup", option["--speedup"]])
"""


def stand_in_for_sitl(path: Path) -> dict[str, Any]:
    """Write a stand-in for ArduPilot. Return the key `vehicles` of a scenario with this program."""
    path.write_text(SITL.format(python=sys.executable, root=str(Path(__file__).parents[4])))
    path.chmod(0o755)
    return {"kind": "ardupilot", "binary": str(path)}


def flights(directory: Path, vehicles: dict[str, Any], **keys: Any) -> Path:
    usual = {"events": {"position_interval_s": 10}, "speedup": 10, "duration_s": 100, "final_reconcile": True}
    return scenario(directory, vehicles=vehicles, **{**usual, **keys})


def test_vehicle_programs_run_on_the_workers_of_their_agents(tmp_path: Path, hosts: Hosts) -> None:
    hosts.start("one")
    hosts.start("two", threads=2)
    out = tmp_path / "run"
    vehicles = stand_in_for_sitl(tmp_path / "arducopter")
    path = flights(tmp_path, vehicles, timeline=[{"at_s": 50, "kill": [2]}, {"at_s": 60, "restart": [2]}])
    station = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    station.bind(("127.0.0.1", 0))
    gcs = f"127.0.0.1:{station.getsockname()[1]}"
    run = Running(path, out, "--scheduler", hosts.scheduler_address, "--seed", 1, "--gcs", gcs)
    run.wait_for_mission(1, 2, 3)
    placed = [sum("arducopter" in command for command in hosts.processes(name).values()) for name in ("one", "two")]
    assert sorted(placed) == [1, 2], "in proportion to the threads"
    _, errors = run.process.communicate(timeout=120)
    record = record_of(out)
    assert (verdicts(record), run.process.returncode) == (GOOD, 0), errors
    assert record["ground_station"]["sent"] > 10
    station.close()
    for incarnation in ("1", "2", "2-2", "3"):
        directory = out / "vehicles" / incarnation
        sysid = incarnation[0]
        assert f"SITL of vehicle {sysid}" in (directory / "output.log").read_text()
        log = (directory / "logs/00000001.BIN").read_bytes()
        assert (len(log), log[:8]) == (3_000_008, f"log of {sysid}".encode())
        assert (directory / "eeprom.bin").stat().st_size == 16384
        assert (directory / "telemetry.tlog").stat().st_size > 1000
    assert all(vehicle["armed"] and vehicle["altitude_m"] > 10 for vehicle in record["vehicles"].values())
    until(lambda: hosts.left_behind() == [])


def test_lost_worker_is_named_as_the_loss_of_its_vehicles(tmp_path: Path, hosts: Hosts) -> None:
    hosts.start("one")
    doomed = hosts.start("two")
    out = tmp_path / "run"
    path = flights(tmp_path, {"kind": "embedded"}, agents=4, duration_s=300)
    run = Running(path, out, "--scheduler", hosts.scheduler_address, "--seed", 1)
    run.wait_for_mission(1, 2, 3, 4)
    doomed.kill()
    _, errors = run.process.communicate(timeout=120)
    record = record_of(out)
    cut = {agent for agent, found in record["remote"].items() if found["cut_off"]}
    lost = {vehicle: found["lost_with"] for vehicle, found in record["vehicles"].items() if "lost_with" in found}
    assert len(cut) == 2
    assert set(lost) == cut, errors
    assert lost == {agent: record["remote"][agent]["worker"] for agent in cut}
    assert f"vehicles {' and '.join(sorted(cut))} were lost with their worker" in errors
    assert record["mission_s"] > 300, "the run went on"
    assert run.process.returncode == 3
    until(lambda: hosts.left_behind() == [])


def test_vehicle_that_exits_on_a_worker_ends_the_run_with_its_output(tmp_path: Path, hosts: Hosts) -> None:
    hosts.start("one")
    binary = tmp_path / "arducopter"
    binary.write_text("#!/bin/sh\necho bind failed >&2\nexit 1\n")
    binary.chmod(0o755)
    path = flights(tmp_path, {"kind": "ardupilot", "binary": str(binary)})
    done = harness("run", path, "--scheduler", hosts.scheduler_address, "--out", tmp_path / "run")
    said = sentences(done.stderr)[0]
    assert re.search(r"vehicle \d \(ardupilot\) ended by itself with status 1; its last output .*: bind failed", said)
    assert done.returncode == 2
    until(lambda: hosts.left_behind() == [])


def test_ended_command_leaves_no_vehicles_on_a_worker(tmp_path: Path, hosts: Hosts) -> None:
    hosts.start("one")
    vehicles = stand_in_for_sitl(tmp_path / "arducopter")
    path = flights(tmp_path, vehicles, duration_s=9000)
    run = Running(path, tmp_path / "run", "--scheduler", hosts.scheduler_address)
    run.wait_for_mission(1, 2, 3)
    assert sum("arducopter" in command for command in hosts.processes().values()) == 3
    run.process.kill()
    run.process.communicate(timeout=120)
    until(lambda: hosts.left_behind() == [])


@pytest.mark.parametrize("name", ["../7.tlog", "/etc/motd", "", "logs/../../x", "a\0b"])
def test_worker_cannot_write_outside_the_directory_of_a_vehicle(tmp_path: Path, name: str) -> None:
    with pytest.raises(ValueError, match="is not the name of a file"):
        file_path(tmp_path, name)


@pytest.mark.parametrize(
    ("binaries", "why"),
    [
        ({"/nowhere/arducopter": "00"}, "it has no program /nowhere/arducopter"),
        ({"/bin/sh": "00"}, "is another program"),
    ],
)
def test_worker_with_another_vehicle_program_is_refused(binaries: dict[str, str | None], why: str) -> None:
    assert why in str(why_not([], binaries, has_keys=False))


# Refusals


@pytest.mark.parametrize(
    ("keys", "options", "why"),
    [
        ({}, ["--backend", "sim"], "--scheduler does not work with --backend sim"),
        ({}, ["--listen", "127.0.0.1:14700"], "none joins at --listen"),
        ({}, ["--kernel", "uml"], "--scheduler does not work with --kernel uml"),
        ({"remote": {"agents": [2], "secret_file": "lab.key"}}, [], "`remote` does not work with --scheduler"),
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
