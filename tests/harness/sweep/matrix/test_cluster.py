"""Test a matrix on a Dask cluster, whose scheduler and workers are local processes."""

import contextlib
import json
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from harness.errors import HarnessError, MachineError
from harness.play.machine import dask_cluster
from harness.sweep.matrix._away import cluster
from tests.harness.command import COMMAND, DEADLINE_S, harness, sentences
from tests.harness.dask_processes import Cluster, until

pytest.importorskip("distributed", reason="needs the extra `cluster`")


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


def test_lost_scheduler_causes_one_sentence_and_the_matrix_can_continue(tmp_path: Path, dask: Cluster) -> None:
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
    assert sentence == f"the scheduler at {address} was lost: repeat the command with the same --out to continue"
    assert process.returncode == 3
    ended = (out / "results.jsonl").read_bytes()
    assert harness("matrix", asked, "--out", out).returncode == 0
    assert (out / "results.jsonl").read_bytes().startswith(ended)
    assert (out / "results.jsonl").read_bytes().count(b"\n") == 61


def refused(address: str) -> str:
    """Run the command, which must end with exit status 3. Return the sentence of its error."""
    with pytest.raises(MachineError) as error, cluster([1], abs, address) as outcomes:
        list(outcomes)
    assert "\n" not in str(error.value)
    assert error.value.exit_status == 3
    return str(error.value)


def test_scheduler_without_workers_causes_one_sentence(dask: Cluster) -> None:
    address = dask.start_scheduler()
    assert refused(address) == (f"the scheduler at {address} has no workers: start some with `dask worker {address}`")


@pytest.mark.parametrize("package", ["ucp_harness", "distributed"])
def test_scheduler_of_another_version_causes_one_sentence(tmp_path: Path, dask: Cluster, package: str) -> None:
    installed = tmp_path / f"{package}-0.0.1.dist-info"
    installed.mkdir()
    (installed / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 0.0.1\n")
    address = dask.start_scheduler(PYTHONPATH=str(tmp_path))
    dask.start_worker(address, "one")
    sentence = refused(address)
    assert sentence.startswith(
        f"the scheduler at {address} has {package.replace('_', '-')} 0.0.1, but this machine has "
    )
    assert sentence.endswith(": install the same version on both")


def test_missing_scheduler_causes_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dask_cluster, "CONNECT_S", 0.5)
    with socket.socket() as nobody_listens:
        nobody_listens.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{nobody_listens.getsockname()[1]}"
        assert refused(address).startswith(f"no Dask scheduler answers at {address} (")


@pytest.mark.parametrize("address", ["nowhere", "http://127.0.0.1:1", "tcp://127.0.0.1", "tcp://127.0.0.1:x", ""])
def test_invalid_address_is_refused_in_one_sentence(address: str) -> None:
    with pytest.raises(HarnessError) as error, cluster([1], abs, address):
        pass
    assert str(error.value) == f"--scheduler {address} is not an address such as tcp://127.0.0.1:8786"
    assert error.value.exit_status == 2


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


def of_processes(directory: Path, **keys: Any) -> Path:
    path = directory / "processes.yaml"
    scenario = {
        "agents": 2,
        "duration_s": 200,
        "speedup": 50,
        "vehicles": {"kind": "none"},
        "events": {"source": "random", "mean_s": 10},
    }
    scenario |= keys.pop("scenario", {})
    asked = {"name": "away", "scenario": scenario, "loss": [0.1], "backend": "process", "seeds": 4, "keep": "all"}
    path.write_text(json.dumps(asked | keys))
    return path


@pytest.mark.lab
def test_killed_worker_loses_no_run_of_processes(tmp_path: Path, dask: Cluster) -> None:
    """Each worker plays whole runs in its own directory. The run directories are sent back with the results."""
    address = dask.start_scheduler()
    workers = {name: dask.start_worker(address, name) for name in ("one", "two")}
    asked, out = of_processes(tmp_path), tmp_path / "out"
    command = [*COMMAND, "matrix", str(asked), "--scheduler", address, "--out", str(out)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        until(lambda: any(tmp_path.glob("dask/*/**/agents/*.trace.jsonl")) or process.poll() is not None)
        (begun, *_) = tmp_path.glob("dask/*/**/agents/*.trace.jsonl")
        workers[begun.relative_to(tmp_path).parts[1]].kill()
        _, said = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 0, said
    assert all(line.endswith(" runs") for line in sentences(said)), "nothing but progress"
    runs = [json.loads(line) for line in (out / "results.jsonl").read_text().splitlines()[1:]]
    assert sorted(run["seed"] for run in runs) == [1, 2, 3, 4]
    assert {run["verdicts"]["4"] for run in runs} == {"holds"}
    for seed in (1, 2, 3, 4):
        (directory,) = (out / "runs").glob(f"*-process-seed-{seed}")
        assert harness("check", directory).returncode in (0, 4)


@pytest.mark.lab
def test_ctrl_c_ends_the_runs_of_workers(tmp_path: Path, dask: Cluster) -> None:
    address = dask.start_scheduler()
    dask.start_worker(address, "one")
    asked, out = of_processes(tmp_path, scenario={"duration_s": 100_000}), tmp_path / "out"
    command = [*COMMAND, "matrix", str(asked), "--scheduler", address, "--out", str(out)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            until(lambda: any(tmp_path.glob("dask/one/**/agents/*.trace.jsonl")) or process.poll() is not None)
            process.send_signal(signal.SIGINT)
            _, said = process.communicate(timeout=DEADLINE_S)
        finally:
            process.kill()  # otherwise a failed test waits for the whole mission
    assert process.returncode == 130, said
    until(lambda: not any(tmp_path.glob("dask/one/**/agents")))
    with cluster([-1], abs, address) as outcomes:
        assert list(outcomes) == [(-1, 1)]


@pytest.mark.lab
def test_failed_run_of_a_worker_names_its_directory_here(tmp_path: Path, dask: Cluster) -> None:
    address = dask.start_scheduler()
    dask.start_worker(address, "one")
    wrong = {"agent_command": {"1": ["python3", "-c", "raise SystemExit(7)"]}}
    asked, out = of_processes(tmp_path, scenario=wrong, seeds=1), tmp_path / "out"
    done = harness("matrix", asked, "--scheduler", address, "--out", out)
    assert done.returncode == 1
    (failed,) = json.loads((out / "matrix.json").read_text())["failed"]
    directory = Path(failed["reason"].split("; see ")[-1])
    assert directory.parent == out / "runs"
    assert (directory / "run.json").is_file()


def test_worker_that_cannot_play_a_run_ends_the_matrix(tmp_path: Path, dask: Cluster) -> None:
    address = dask.start_scheduler()
    dask.start_worker(address, "one", DOCKER_HOST="tcp://192.0.2.1:2375")
    asked, out = of_processes(tmp_path, backend="docker", seeds=1), tmp_path / "out"
    done = harness("matrix", asked, "--scheduler", address, "--out", out)
    assert done.returncode == 3
    assert re.match(r"the worker at tcp://\S+ cannot play a run: DOCKER_HOST is tcp", sentences(done.stderr)[-1])


def test_budget_limits_the_runs_of_a_cluster(tmp_path: Path, dask: Cluster) -> None:
    address = dask.start_scheduler()
    dask.start_worker(address, "one")
    out = tmp_path / "out"
    done = harness("matrix", written(tmp_path), "--scheduler", address, "--budget", "2s", "--out", out)
    assert done.returncode == 0, done.stderr
    record = json.loads((out / "matrix.json").read_text())
    assert (record["outcome"], record["budget_s"]) == ("completed", 2)
    assert record["cells"]
    assert {cell["loss"] for cell in record["cells"]} <= {0.1, 0.3}


def test_tasks_of_unknown_number_begin_when_a_worker_is_free(dask: Cluster) -> None:
    address = dask.start_scheduler()
    dask.start_worker(address, "one")
    begun: list[int] = []

    def tasks() -> Iterator[int]:
        for task in range(5):
            begun.append(task)
            yield task

    with cluster(tasks(), abs, address) as outcomes:
        for count, _ in enumerate(outcomes, 1):
            assert len(begun) == count
    assert begun == [0, 1, 2, 3, 4]
