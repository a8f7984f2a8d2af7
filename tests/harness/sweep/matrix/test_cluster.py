"""Test a matrix on a Dask cluster, whose scheduler and workers are local processes."""

import contextlib
import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from harness.errors import HarnessError, MachineError
from harness.sweep.matrix import _cluster as module
from harness.sweep.matrix._cluster import cluster
from tests.harness.command import COMMAND, DEADLINE_S, harness, sentences

pytest.importorskip("distributed", reason="needs the extra `cluster`")


class Cluster:
    """The processes of Dask. Their output is in `directory`."""

    def __init__(self, directory: Path, stack: contextlib.ExitStack) -> None:
        self._directory, self._stack = directory, stack
        self._file = directory / "scheduler.json"

    def start_scheduler(self, **env: str) -> str:
        """Start the scheduler and return its address. It waits two seconds for a lost worker instead of 30."""
        env["DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT"] = "2s"
        self.scheduler = self._start("scheduler", "scheduler", "--port", "0", "--scheduler-file", self._file, **env)
        until(lambda: self._file.exists() and self._file.stat().st_size > 0)
        address: str = json.loads(self._file.read_text())["address"]
        return address

    def start_worker(self, address: str, name: str) -> "subprocess.Popen[str]":
        options = ("--nthreads", "1", "--no-nanny", "--local-directory", self._directory / name)
        worker = self._start(name, "worker", address, *options)
        until(lambda: "Registered to" in (self._directory / f"{name}.log").read_text())
        return worker

    def _start(self, name: str, what: str, *options: object, **env: str) -> "subprocess.Popen[str]":
        log = self._stack.enter_context((self._directory / f"{name}.log").open("w"))
        command = [sys.executable, "-m", f"distributed.cli.dask_{what}", "--host", "127.0.0.1", "--no-dashboard"]
        process = subprocess.Popen(
            [*command, *map(str, options)], stdout=log, stderr=log, text=True, env={**os.environ, **env}
        )
        self._stack.callback(process.wait)
        self._stack.callback(process.kill)
        return process


def until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.fixture
def dask(tmp_path: Path) -> Iterator[Cluster]:
    folder = tmp_path / "dask"
    folder.mkdir()
    with contextlib.ExitStack() as stack:
        yield Cluster(folder, stack)


def written(directory: Path) -> Path:
    path = directory / "matrix.yaml"
    scenario = {"agents": 5, "events": {"source": "random"}}
    path.write_text(json.dumps({"name": "cluster", "scenario": scenario, "loss": [0.1, 0.3], "seeds": 30}))
    return path


def test_killed_worker_loses_no_task_and_duplicates_none(tmp_path: Path, dask: Cluster) -> None:
    address = dask.start_scheduler()
    doomed, _ = (dask.start_worker(address, name) for name in ("one", "two"))
    asked, out = written(tmp_path), tmp_path / "out"
    command = [*COMMAND, "matrix", str(asked), "--scheduler", address, "--out", str(out)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        until(lambda: (out / "results.jsonl").exists() and (out / "results.jsonl").read_bytes().count(b"\n") > 8)
        doomed.kill()
        assert (out / "results.jsonl").read_bytes().count(b"\n") < 50, "it is midway"
        _, said = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 0, said
    assert all(line.endswith(" runs") for line in sentences(said)), "nothing but progress"
    runs = [json.loads(line) for line in (out / "results.jsonl").read_text().splitlines()[1:]]
    assert len(runs) == len({(run["loss"], run["seed"]) for run in runs}) == 60
    harness("matrix", asked, "--out", tmp_path / "here")
    for name in ("matrix.csv", "runs.csv", "matrix.svg"):
        assert (out / name).read_bytes() == (tmp_path / "here" / name).read_bytes()


def test_lost_scheduler_is_one_sentence_and_the_matrix_can_continue(tmp_path: Path, dask: Cluster) -> None:
    address = dask.start_scheduler()
    dask.start_worker(address, "one")
    asked, out = written(tmp_path), tmp_path / "out"
    command = [*COMMAND, "matrix", str(asked), "--scheduler", address, "--out", str(out)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        until(lambda: (out / "results.jsonl").exists() and (out / "results.jsonl").read_bytes().count(b"\n") > 5)
        dask.scheduler.kill()
        _, said = process.communicate(timeout=DEADLINE_S)
    *progress, sentence = sentences(said)
    assert all(line.endswith(" runs") for line in progress)
    assert sentence == f"the scheduler at {address} was lost: the same command with the same --out goes on"
    assert process.returncode == 3
    ended = (out / "results.jsonl").read_bytes()
    assert harness("matrix", asked, "--out", out).returncode == 0
    assert (out / "results.jsonl").read_bytes().startswith(ended)
    assert (out / "results.jsonl").read_bytes().count(b"\n") == 61


def refused(address: str) -> str:
    """Return the sentence of an error that ends the command with exit status 3."""
    with pytest.raises(MachineError) as told, cluster([1], abs, address) as outcomes:
        list(outcomes)
    assert "\n" not in str(told.value)
    assert told.value.exit_status == 3
    return str(told.value)


def test_a_scheduler_without_workers_is_one_sentence(dask: Cluster) -> None:
    address = dask.start_scheduler()
    assert refused(address) == (f"the scheduler at {address} has no workers: start some with `dask worker {address}`")


@pytest.mark.parametrize("package", ["ucp_harness", "distributed"])
def test_a_scheduler_of_another_version_is_one_sentence(tmp_path: Path, dask: Cluster, package: str) -> None:
    installed = tmp_path / f"{package}-0.0.1.dist-info"
    installed.mkdir()
    (installed / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 0.0.1\n")
    address = dask.start_scheduler(PYTHONPATH=str(tmp_path))
    dask.start_worker(address, "one")
    sentence = refused(address)
    assert sentence.startswith(f"the scheduler at {address} has {package.replace('_', '-')} 0.0.1, and here is ")
    assert sentence.endswith(": install the same version on both")


def test_no_scheduler_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "CONNECT_S", 0.5)
    with socket.socket() as nobody_listens:
        nobody_listens.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{nobody_listens.getsockname()[1]}"
        assert refused(address).startswith(f"no Dask scheduler answers at {address} (")


@pytest.mark.parametrize("address", ["nowhere", "http://127.0.0.1:1", "tcp://127.0.0.1", "tcp://127.0.0.1:x", ""])
def test_invalid_address_is_refused_in_one_sentence(address: str) -> None:
    with pytest.raises(HarnessError) as told, cluster([1], abs, address):
        pass
    assert str(told.value) == f"--scheduler {address} is not an address such as tcp://127.0.0.1:8786"
    assert told.value.exit_status == 2


def test_missing_dask_gives_the_install_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert "pip install 'ucp-harness[cluster]'" in refused("tcp://127.0.0.1:1")


def test_cluster_gives_the_outcomes_and_failures_of_a_sweep(dask: Cluster) -> None:
    address = dask.start_scheduler()
    dask.start_worker(address, "one")
    with cluster([4, -1, 9], "abc".__getitem__, address) as outcomes:
        found = {task: str(outcome) for task, outcome in outcomes}
    assert set(found) == {4, -1, 9}
    assert found[-1] == "c"
    assert "IndexError" in found[4]


def test_runs_of_processes_are_refused_on_a_cluster(tmp_path: Path) -> None:
    done = harness(
        "matrix",
        written(tmp_path),
        "--backend",
        "process",
        "--scheduler",
        "tcp://127.0.0.1:1",
        "--out",
        tmp_path / "out",
    )
    assert done.returncode == 2
    assert sentences(done.stderr)[0].startswith("--scheduler is for virtual time: ")
